"""Coefficients of methods of integration: those of SciPy's embedded methods, and of Radau IIA."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

T = (
    (0.094438762488975241487, -0.14125529502095420843, 0.030029194105147424492),
    (0.25021312296533331138, 0.204129352293799932, -0.3829421127572619378),
    (1.0, 1.0, 0.0),
)
"""The inverse of the coefficients A is T D T⁻¹: D has a block of one row and one of two; computed with 40 digits."""
T_INVERSE = (
    (4.1787185915519047273, 0.32768282076106238708, 0.52337644549944954804),
    (-4.1787185915519047273, -0.32768282076106238708, 0.47662355450055045196),
    (0.50287263494578687595, -2.5719269498556054292, 0.59603920482822492497),
)


@lru_cache(maxsize=3)
def tableau(name: str) -> dict[str, np.ndarray]:
    """Return the coefficients of an embedded method of SciPy, by the names that C has for them, as floats."""
    import scipy.integrate  # only a run between ticks needs it

    method: Any = getattr(scipy.integrate, name)
    found = {"A": np.zeros((method.n_stages, method.n_stages)), "B": method.B, "C": method.C}
    found["A"][:, : method.A.shape[1]] = method.A
    if name == "DOP853":
        found |= {"E": method.E5, "E3": method.E3, "P": method.D, "A_extra": method.A_EXTRA, "C_extra": method.C_EXTRA}
    else:
        found |= {"E": method.E, "P": method.P}
    return {letter: np.array(values, dtype=float) for letter, values in found.items()}


def error_exponent(name: str) -> int:
    """Return the order of the error estimate of an embedded method."""
    import scipy.integrate

    order: int = getattr(scipy.integrate, name).error_estimator_order
    return order


def radau_numbers() -> np.ndarray:
    """Return the numbers of the method, in the order in which C reads them.

    The nodes, the weights of the error (E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, IV.8), T and
    its inverse, the polynomial through the stages, and the eigenvalues of the inverse of A.
    """
    root, third = np.sqrt(6.0), 3.0 ** (1.0 / 3.0)
    nodes = [(4.0 - root) / 10.0, (4.0 + root) / 10.0, 1.0]
    weights = [(-13.0 - 7.0 * root) / 3.0, (-13.0 + 7.0 * root) / 3.0, -1.0 / 3.0]
    polynomial = [
        *((13.0 + 7.0 * root) / 3.0, (-23.0 - 22.0 * root) / 3.0, (10.0 + 15.0 * root) / 3.0),
        *((13.0 - 7.0 * root) / 3.0, (-23.0 + 22.0 * root) / 3.0, (10.0 - 15.0 * root) / 3.0),
        *(1.0 / 3.0, -8.0 / 3.0, 10.0 / 3.0),
    ]
    eigenvalues = [
        3.0 + third**2 - third,
        3.0 + 0.5 * (third - third**2),
        -0.5 * (3.0 ** (5.0 / 6.0) + 3.0 ** (7.0 / 6.0)),
    ]
    return np.array([*nodes, *weights, *np.ravel(T), *np.ravel(T_INVERSE), *polynomial, *eigenvalues])
