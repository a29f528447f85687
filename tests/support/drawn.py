"""Quick part of a test that is a full product of cases: the diagonal, which has each value of each parameter once."""


def identify(item):
    """Give what tells the values of each parametrization apart; they are the same objects in all cases."""
    named = [mark.args[0] for mark in item.iter_markers("parametrize")]
    groups = [name.replace(" ", "").split(",") if isinstance(name, str) else list(name) for name in named]
    groups += [[name] for name in item.callspec.params if not any(name in group for group in groups)]
    return tuple(tuple(id(item.callspec.params[name]) for name in group) for group in groups)


def draw(cases, count=None):
    """Give the places of the quick cases, or of ``count`` of them, evenly spread; a case is a tuple of its values.

    Case i of the diagonal has value i of every parameter; a parameter with fewer values begins anew.
    """
    values = [list(dict.fromkeys(column)) for column in zip(*cases, strict=True)]
    diagonal = {tuple(column[i % len(column)] for column in values) for i in range(max(map(len, values)))}
    places = [i for i, case in enumerate(cases) if case in diagonal]
    if count is None or count >= len(places):
        return places
    return [places[round(k * (len(places) - 1) / max(count - 1, 1))] for k in range(count)]
