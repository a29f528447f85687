"""Steps of FMUs, counted: Python takes them at the request of the loop in C."""

from loopwright.fmus.calls import FmuInstance


def counted_steps(monkeypatch):
    """Return the list into which every step of an FMU is written, as (t, h)."""
    steps, bind = [], FmuInstance.bind

    def watched(self, inputs, outputs):
        bind(self, inputs, outputs)
        step = self.step
        self.step = lambda t, h: (steps.append((t, h)), step(t, h))[1]

    monkeypatch.setattr(FmuInstance, "bind", watched)
    stepped_by_python(monkeypatch)
    return steps


def stepped_by_python(monkeypatch):
    """Let Python take all steps of FMUs in this process."""
    monkeypatch.setattr(FmuInstance, "native", None)
