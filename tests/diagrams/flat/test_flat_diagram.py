"""A diagram is one CasADi function: interpreted, compiled and differentiated alike."""

import casadi as ca
import numpy as np
import pytest

from loopwright.blocks import CubicSpline, Pulse
from loopwright.diagrams import experiments
from loopwright.fmus.export.compiler import compile_shared

SPLINE = CubicSpline(
    points=[(0.8, 0.5), (0.65, 0.63), (0.35, 0.62), (0.2, 0.5), (0.35, 0.37), (0.66, 0.38)], closed=True
)


def columns(flat, run, k):
    """The arguments of the function at tick k, from what the run recorded."""
    return [run.t[k], run.data[k, flat.log.total :], run.data[k, : flat.plant_outputs.total], flat.p]


@pytest.fixture(scope="module")
def guided():
    experiment = experiments.hand_guiding()
    return experiment.diagram.flatten(), experiment.simulate(progress=False)


def compiled(function, folder):
    generator = ca.CodeGenerator("tick.c")
    generator.add(function)
    export = '#define CASADI_SYMBOL_EXPORT __attribute__((visibility("default")))\n'
    compile_shared({"tick.c": export + generator.dump()}, folder / "tick.so")
    return ca.external("tick", str(folder / "tick.so"))


def replay(function, flat, run, ticks):
    """Evaluate the function at recorded ticks, through its buffer interface."""
    buffer, trigger = function.buffer()
    ins = [np.zeros(function.numel_in(i)) for i in range(4)]
    outs = [np.zeros(function.numel_out(i)) for i in range(4)]
    for i in range(4):
        buffer.set_arg(i, memoryview(ins[i]))
        buffer.set_res(i, memoryview(outs[i]))
    results = []
    for k in ticks:
        for vector, value in zip(ins, columns(flat, run, k), strict=True):
            vector[:] = value
        trigger()
        results.append(np.concatenate(outs))
    return np.array(results)


def test_compiled_c_is_bit_identical_to_the_interpreted_function_over_all_of_c(guided, tmp_path):
    flat, run = guided
    ticks = range(len(run.t))
    library = replay(compiled(flat.function, tmp_path), flat, run, ticks)
    interpreted = replay(flat.function, flat, run, ticks)
    assert len(library) == 12001
    assert library.tobytes() == interpreted.tobytes()
    n = flat.states.total
    start = n + flat.plant_inputs.total
    assert np.array_equal(library[:, start:-1], run.data)  # the run itself went through the same numbers
    assert np.array_equal(library[:-1, :n], run.data[1:, flat.log.total :])
    assert np.all(library[:, -1] == 1)


@pytest.mark.slow
def test_a_path_with_tables_compiles_to_the_same_bits(tmp_path):
    experiment = experiments.path_following(path=SPLINE)
    run = experiment.diagram.simulate(2.0, progress=False)
    flat = experiment.diagram.flatten()
    ticks = range(0, len(run.t), 7)
    assert (
        replay(compiled(flat.function, tmp_path), flat, run, ticks).tobytes()
        == replay(flat.function, flat, run, ticks).tobytes()
    )


@pytest.mark.parametrize("tick", [731, 2750, 5230, 7100, 9111])
def test_its_jacobian_agrees_with_differences(guided, tick):
    flat, run = guided
    function = flat.function
    t, *vectors = columns(flat, run, tick)
    jacobian = function.jacobian()
    blocks = jacobian(t, *vectors, *[ca.DM(function.sparsity_out(i)) for i in range(4)])
    for which in (1, 2):  # with respect to the states and to the plant's outputs
        for out in (0, 1):  # of the next states and the plant's inputs
            exact = np.array(blocks[4 * out + which])
            for j in range(vectors[which - 1].size):
                h = 1e-5 * max(1.0, abs(vectors[which - 1][j]))
                ends = []
                for sign in (2, 1, -1, -2):
                    moved = [v.copy() for v in vectors]
                    moved[which - 1][j] += sign * h
                    ends.append(np.array(function(t, *moved)[out]).ravel())
                differences = (-ends[0] + 8 * ends[1] - 8 * ends[2] + ends[3]) / (12 * h)  # order 4
                # rounding in the largest output (1e3 N at 1e-16) over h, and the friction's width of 0.01 m/s in order 4
                scale = np.abs(np.array(ends)).max() + np.abs(exact[:, j]).max()
                assert np.max(np.abs(exact[:, j] - differences)) < 1e-7 * (1.0 + scale)


def test_the_flattened_function_is_shared_among_equal_blocks(guided):
    flat, _ = guided
    traced = flat.checked.traced
    pulses = [path for path, block in flat.table.blocks.items() if isinstance(block, Pulse)]
    assert len(pulses) == 7
    assert len({id(traced[path].function) for path in pulses}) == 1


def test_feedthrough_is_known_for_each_pair_of_ports(guided):
    traced = guided[0].checked.traced
    assert traced["controller.transverse_transform"].depends["eta"] == {"theta", "position", "velocity"}
    assert traced["controller.pid_par"].depends["v"] == {"x", "coordinate", "reference"}  # not the saturation's excess
    assert traced["controller.pid_par"].depends["next"] == {"x", "coordinate", "reference", "excess"}
    assert traced["sensors.force_sensor"].depends["measured"] == {"force", "contact_force"}  # no tool: no acceleration
