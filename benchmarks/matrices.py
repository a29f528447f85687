"""Time to build a diagram with one large matrix.

    python benchmarks/matrices.py

A product with a constant matrix, and a state space; medians of five, each with another matrix.
"""

import time
from statistics import median

import numpy as np

from loopwright.blocks import Constant, Gain, StateSpace
from loopwright.diagrams import Diagram


def make_product(A):
    return Diagram("product", Gain(gain=A)(Constant(value=np.ones(len(A)))))


def make_state_space(A):
    return Diagram("system", StateSpace(A=A, B=np.ones(len(A)), C=np.ones(len(A)))(Constant(value=1.0)))


if __name__ == "__main__":
    print(f"{'states':>8s}{'A @ x':>10s}{'StateSpace':>12s}   s")
    for n in (50, 100, 200, 500):
        row = []
        for make in (make_product, make_state_space):
            times = []
            for seed in range(5):
                A = np.random.default_rng(seed).standard_normal((n, n)) / n - np.eye(n)
                A[0, 1 + seed] = 0.0  # another structure, so that no trace is shared
                began = time.perf_counter()
                make(A)
                times.append(time.perf_counter() - began)
            row.append(median(times))
        print(f"{n:8d}{row[0]:10.3f}{row[1]:12.3f}")
