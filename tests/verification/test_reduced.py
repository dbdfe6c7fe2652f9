"""Linear systems of RADAU5's Newton method: the scalar and the SIMD solve against each other and the full matrix."""

from __future__ import annotations

import numpy as np
import pytest
from support.lane_cases import copies
from support.random_robots import CompiledSystem, assemble, random_positions, random_robot, random_robot_of

from dynsim.integrators.radau5.step import factor_both, solve_both
from dynsim.integrators.radau5.tables import ALPHA_RADAU, BETA_RADAU, GAMMA_RADAU
from dynsim.integrators.run import Run
from dynsim.jit.kernel import kernel


@kernel
def solve_compiled(system, ws, y, r, h):
    """Factorise and solve the real and the complex system, as a step of RADAU5 does."""
    factor_both(system, r, h)
    solve_both(system, ws, y, r, h)


def driven() -> CompiledSystem:
    return assemble(random_robot(np.random.default_rng(0), 8))


def every_joint() -> CompiledSystem:
    kinds = ["ball", "rolling", "planar", "floating", "wheeled", "prismatic", "revolute"]
    return assemble(random_robot_of(np.random.default_rng(1), kinds))


def started(b: CompiledSystem, y: np.ndarray, lanes: bool) -> Run:
    """Return a run of RADAU5 with a Jacobian, with or without lanes."""
    run = b.advance(b.new_run(y, np.array([1.0]), "radau5"), 2)
    assert run.newton.lanes is not None
    return run if lanes else run._replace(newton=run.newton._replace(lanes=None))


@pytest.mark.parametrize("make", [driven, every_joint])
@pytest.mark.parametrize("h", [1e-4, 0.1])
def test_scalar_and_simd_solutions_agree(make, h):
    rng, b = np.random.default_rng(2), make()
    y = b.state(random_positions(rng, b.robot), rng.normal(size=len(b.robot.links)))
    run = started(b, y, lanes=True)
    tracked = b.system.layout.tracked
    run.newton.one[:] = rng.normal(size=tracked)
    run.newton.two[:] = rng.normal(size=tracked) + 1j * rng.normal(size=tracked)
    scalar, lanes = copies(run.newton)._replace(lanes=None), copies(run.newton)
    solve_compiled(b.system, b.ws, run.y, scalar, h)
    solve_compiled(b.system, b.ws, run.y, lanes, h)
    # Each has worked in its own arrays.
    assert scalar.real_inverse.any()
    assert lanes.circuit.any() or lanes.over.any()
    assert not np.array_equal(scalar.direct, lanes.direct)
    for expected, solved in ((scalar.one, lanes.one), (scalar.two, lanes.two)):
        assert np.abs(solved - expected).max() <= 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("lanes", [False, True])
def test_solutions_are_those_of_the_full_matrix(lanes):
    """(g I − J) u = r with J in full, by blocks, for a robot whose positions are its angles."""
    rng, b, h = np.random.default_rng(2), driven(), 0.01
    y = b.state(random_positions(rng, b.robot), rng.normal(size=len(b.robot.links)))
    run = started(b, y, lanes)
    r, layout, n = run.newton, b.system.layout, len(b.robot.links)
    J = np.zeros((layout.tracked, layout.tracked))
    J[layout.q : layout.q + n, layout.v : layout.v + n] = np.eye(n)
    J[layout.v : layout.v + n, :] = r.along.T
    for a, (driven_joint, _, circuit, *_) in enumerate(b.system.drives.table):
        row = J[layout.current + circuit]
        row[layout.q + driven_joint], row[layout.v + driven_joint] = r.linear[a, 3], r.linear[a, 4]
        row[layout.current + circuit] = r.linear[a, 5]
    real_part, two = (
        rng.normal(size=layout.tracked),
        rng.normal(size=layout.tracked) + 1j * rng.normal(size=layout.tracked),
    )
    r.one[:], r.two[:] = real_part, two
    solve_compiled(b.system, b.ws, run.y, r, h)
    for g, right, solved in (
        (GAMMA_RADAU / h, real_part, r.one),
        (complex(ALPHA_RADAU / h, BETA_RADAU / h), two, r.two),
    ):
        expected = np.linalg.solve(g * np.eye(layout.tracked) - J, right)
        assert np.abs(solved - expected).max() <= 1e-9 * np.abs(expected).max()
