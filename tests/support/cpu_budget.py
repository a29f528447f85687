"""Processor time of tests, for people who ask: ``pytest --budget 0.5`` lists the functions that take more.

Nothing is asserted: the time of a test depends on the machine and on what else runs there. It is the processor time of the
test and of the child processes that have ended in it, with its fixtures; with several workers it is summed over them.
"""

import os
import time
from collections import defaultdict

import pytest


def seconds():
    """Return the processor time of this process and of its children that have ended, in s."""
    children = os.times()  # 0 on Windows
    return time.process_time() + children.children_user + children.children_system


class Budget:
    """Plugin that sums the processor time of each test function over its cases."""

    def __init__(self, budget):
        self.budget, self.began = budget, 0.0
        self.taken, self.cases = defaultdict(float), defaultdict(int)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self, item):
        self.began = seconds()
        return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_teardown(self, item):
        try:
            return (yield)
        finally:
            item.user_properties.append(("cpu", seconds() - self.began))  # which a worker sends with its report

    def pytest_runtest_logreport(self, report):
        if report.when == "teardown":
            function = report.nodeid.partition("[")[0]
            self.taken[function] += dict(report.user_properties).get("cpu", 0.0)
            self.cases[function] += 1

    def pytest_terminal_summary(self, terminalreporter):
        write, folders = terminalreporter.write_line, defaultdict(float)
        for function, taken in self.taken.items():
            folders["/".join(function.partition("::")[0].split("/")[:3])] += taken
        terminalreporter.section(f"processor time, {sum(folders.values()):.0f} s")
        for folder, taken in sorted(folders.items(), key=lambda one: -one[1]):
            write(f"{taken:8.1f} s  {folder}")
        over = {function: taken for function, taken in self.taken.items() if taken > self.budget}
        terminalreporter.section(f"{len(over)} functions beyond {self.budget:g} s")
        for function, taken in sorted(over.items(), key=lambda one: -one[1]):
            write(f"{taken:8.2f} s  {function}, {self.cases[function]} case{'s' * (self.cases[function] > 1)}")
