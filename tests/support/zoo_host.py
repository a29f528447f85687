"""A process that runs hostile FMUs one after the other, and says after each what has become of itself.

It reads a request of JSON a line, and answers with one. Its own death is the worst that a test can find, and no end of
the tests.
"""

import ctypes
import ctypes.util
import json
import os
import resource
import signal
import sys
import threading
import traceback
from pathlib import Path

ANSWERS = 700  # a descriptor that no FMU guesses


def look():
    """Return the parts of this process that an FMU in it could change."""
    libm = ctypes.CDLL(ctypes.util.find_library("m"))
    return {
        "folder": os.getcwd(),
        "files": sorted(os.listdir(os.getcwd())),
        "rounding": libm.fegetround(),
        "traps": libm.fegetexcept(),
        "mask": sorted(int(s) for s in signal.pthread_sigmask(signal.SIG_BLOCK, [])),
        "handlers": [str(signal.getsignal(s)) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD, signal.SIGSEGV)],
        "umask": _umask(),
        "path": "PATH" in os.environ and bool(ctypes.CDLL(None).getenv(b"PATH")),
        "limit": resource.getrlimit(resource.RLIMIT_NOFILE),
        "output": os.fstat(1).st_ino if _is_open(1) else None,
        "errors": os.fstat(2).st_ino if _is_open(2) else None,
    }


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _is_open(fd):
    try:
        os.fstat(fd)
    except OSError:
        return False
    return True


def children():
    """Return the states of the processes that come from this one: "Z" is a zombie."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        found[int(entry.name)] = (fields[0], int(fields[1]))
    mine, before = {os.getpid()}, 0
    while len(mine) != before:
        before = len(mine)
        mine |= {pid for pid, (_, parent) in found.items() if parent in mine}
    return {str(pid): found[pid][0] for pid in mine - {os.getpid()}}


def serve(request):
    """Run the FMU of a request in a diagram, and return what came of it."""
    from loopwright.blocks import Gain
    from loopwright.diagrams import Diagram
    from loopwright.fmus import Fmu
    from loopwright.fmus.isolation import Isolation

    options = dict(request["options"])
    if isinstance(options.get("isolate"), dict):
        options["isolate"] = Isolation(**options["isolate"])
    before, error, run = look(), None, None
    try:
        block = Fmu(request["file"], name="zoo", start={"u": 1.0, **request.get("start", {})}, **options)
        readers = [Gain(name="reader", gain=1.0)(block.y)] if request["read"] else []
        run = Diagram("d", block(), *readers).simulate(request["duration"], step=request["step"], progress=False)
    except Exception as found:
        error, run = found, getattr(found, "run", None)
    after, family = look(), children()
    return {
        "kinds": [kind.__name__ for kind in type(error).__mro__] if error else [],
        "text": str(error) if error else "",
        "fault": getattr(getattr(error, "fault", None), "value", None),
        "cause": getattr(getattr(error, "cause", None), "value", None),
        "call": getattr(error, "call", None),
        "at": getattr(error, "t", None),
        "t": [] if run is None else list(run.t),
        "y": [] if run is None else [float(v) for v in run["zoo.y"]],
        "messages": [] if run is None else list(run.messages),
        "changed": {name: [value, after[name]] for name, value in before.items() if after[name] != value},
        "children": family,
        "threads": threading.active_count(),
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    }


def main():
    """Answer until the requests end."""
    answers = os.fdopen(os.dup2(1, ANSWERS), "w")
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    for line in sys.stdin:
        try:
            answer = serve(json.loads(line))
        except Exception:
            answer = {"broken": traceback.format_exc()}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
