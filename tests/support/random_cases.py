"""Random cases by Hypothesis: a few, always the same, in the quick set; many in the slow one."""

import inspect

import pytest
from hypothesis import HealthCheck, given, settings


def random_cases(quick, many, *strategies, reaching=None, fresh=False, **named):
    """Decorate a test of random cases, as `hypothesis.given` does with the strategies.

    Parameters
    ----------
    quick : int, optional
        Number of cases in the quick set; None if there are none.
    many : int
        Number of cases in the slow set.
    *strategies, **named
        Strategies of Hypothesis, from the right, or by name.
    reaching : float, optional
        Least share of the cases that reach the assertions; the test returns True for those that do.
    fresh : bool
        Whether the many cases of the slow set are new ones in each run.
    """

    def decorate(test):
        names = list(inspect.signature(test).parameters)
        random = {*named, *names[len(names) - len(strategies) :]}
        others = [name for name in names if name not in random]

        def run(examples, **fixtures):
            tried, reached = 0, 0

            def case(**values):
                nonlocal tried, reached
                tried += 1
                reached += bool(test(**fixtures, **values))

            all_named = {**named, **dict(zip(names[len(names) - len(strategies) :], strategies, strict=True))}
            options = settings(
                max_examples=examples,
                deadline=None,
                derandomize=not (fresh and examples == many),
                database=None,
                suppress_health_check=list(HealthCheck),
            )
            options(given(**all_named)(case))()
            if reaching is not None:
                assert reached >= reaching * tried, f"only {reached} of {tried} cases reach the assertions"

        parameters = [inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY) for n in ("examples", *others)]
        run.__signature__ = inspect.Signature(parameters)
        run.__name__, run.__module__, run.__doc__ = test.__name__, test.__module__, test.__doc__
        run.pytestmark = list(getattr(test, "pytestmark", []))
        few = [] if quick is None else [quick]
        return pytest.mark.parametrize("examples", [*few, pytest.param(many, marks=pytest.mark.slow)])(run)

    return decorate
