"""SIMD right-hand sides in machine code: rates of four states at once equal those of each state alone, to rounding.

The cases reach the branches of the right-hand side, whose variants are in ``dynsim.integrators.simd.forms``; a branch
without a variant does not compile. A short run agrees between Python, SSE2 and AVX2.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.lane_cases import CASES, TIMED, Case, copies, random_case, random_plane
from support.random_robots import (
    CompiledSystem,
    assemble,
    braced,
    random_contacts,
    random_positions,
    random_robot,
)

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.rows import set_modes
from dynsim.dynamics.contact.unilateral import FROZEN, REFERENCE
from dynsim.dynamics.derivative import System, derivative
from dynsim.integrators.simd.forms import WIDTH, StageLanes, evaluate_four, has_forms, stage_lanes
from dynsim.jit.kernel import integers, kernel, reals

pytestmark = pytest.mark.long

# Relative tolerances of rates and of constraint forces.
ROUNDING, FORCES = 1e-15, 1e-11
# Roundings within a right-hand side, counted in those of its state.
ROUNDINGS = 4.0
# Tolerances of cases with ill-conditioned matrices, which amplify each rounding by as much.
AMPLIFIED = {"every joint": 1e-11, "sliding, held, held": 1e-9}


def spread(case: Case, count: int, rng: np.random.Generator) -> np.ndarray:
    """States about that of the case, (m, count)."""
    scale = np.where(np.arange(len(case.y)) < case.compiled.system.layout.tracked, 1.0, 0.0)
    return np.array([case.y + scale * rng.normal(size=len(case.y)) for _ in range(count)]).T.copy()


def alone(
    b: CompiledSystem, system: System, t: float, y: np.ndarray, kept: ka.Workspace
) -> tuple[np.ndarray, ka.Workspace]:
    """The derivative by a workspace of its own."""
    ws, dy = copies(kept), np.zeros(len(y))
    derivative(system, t, reals(y), ws, dy)
    return dy, ws


def rounded(b: CompiledSystem, y: np.ndarray, t: float) -> float:
    """What roundings of the state in its last bit change at most, of the largest rate: how ill-conditioned the tree is.

    Machine code of lanes contracts other products than that of one run where the processor has no 512-bit registers.
    """
    kept, worst = copies(b.ws), 0.0
    for k in range(WIDTH):
        rates, _ = alone(b, b.system, t, y[:, k], kept)
        for seed in range(8):
            bits = np.random.default_rng(seed).choice([-1.0, 1.0], len(y)) * np.finfo(float).eps
            other, _ = alone(b, b.system, t, y[:, k] * (1.0 + bits), kept)
            worst = max(worst, float(np.nanmax(np.abs(other - rates)) / np.nanmax(np.abs(rates))))
    return worst


@kernel
def evaluate(lanes: StageLanes, system: System) -> None:
    """:func:`evaluate_four`, for Python to call."""
    evaluate_four(lanes, system)


def compare(b: CompiledSystem, y: np.ndarray, t: float | np.ndarray, tolerance: float) -> ka.Workspace:
    """All lanes against runs of their own: NaN where they have it, else per largest entry."""
    kept, lanes = copies(b.ws), stage_lanes(b.ws, len(y), 0)
    lanes.t[:] = t
    np.copyto(lanes.y, y)
    evaluate(lanes, b.system)
    ws, dy = lanes.ws, lanes.f
    for k in range(WIDTH):
        expected, room = alone(b, b.system, float(lanes.t[k]), y[:, k], kept)
        np.testing.assert_array_equal(np.isnan(dy[:, k]), np.isnan(expected))
        assert np.nanmax(np.abs(dy[:, k] - expected)) <= tolerance * np.nanmax(np.abs(expected))
        forces, forces_alone = ws.rows[:, ka.FORCE, k], room.rows[:, ka.FORCE]
        largest = np.nanmax(np.abs(forces_alone), initial=1e-300)
        np.testing.assert_allclose(forces, forces_alone, rtol=0.0, atol=max(FORCES, tolerance) * largest)
        np.testing.assert_array_equal(ws.rows[:, ka.SIGN, k], room.rows[:, ka.SIGN])
    return ws


# A program of its own to compile.
SLOW = {"no choice of signs"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in (*CASES, *TIMED)]
)
def test_every_case_of_branches(name):
    """Lanes far apart, so that they take different branches wherever there are any."""
    case = (CASES | TIMED)[name]()
    if not has_forms(case.compiled.system):
        pytest.skip("goes without lanes")
    t = case.t + case.t_step * np.arange(WIDTH) if name in TIMED else case.t
    compare(case.compiled, spread(case, WIDTH, np.random.default_rng(99)), t, AMPLIFIED.get(name, ROUNDING))


@pytest.mark.parametrize("seed", range(12))
def test_random_trees(seed):
    """Motors, some at their limits, and contacts on planes and curved surfaces by both laws of friction."""
    rng = np.random.default_rng(seed)
    n, c = int(rng.integers(5, 12)), int(rng.integers(1, 4))
    robot = random_robot(rng, n)
    b = assemble(robot, random_contacts(rng, robot, random_positions(rng, robot), c))
    b.system.drives.motor[:, ka.U_MAX] = 15.0
    y = np.zeros((b.system.layout.size, WIDTH))
    for k in range(WIDTH):
        y[:, k] = b.state(random_positions(rng, robot), rng.normal(size=n))
        b.part(y[:, k], "current")[:] = rng.normal(size=len(robot.motors))
    compare(b, y, 0.3, max(ROUNDING, ROUNDINGS * rounded(b, y, 0.3)))


def test_the_cases_have_lanes_that_differ():
    """Signs of friction and limits of voltage are not the same in all lanes above."""
    case = CASES["dissipative"]()
    ws = compare(case.compiled, spread(case, WIDTH, np.random.default_rng(99)), 0.0, ROUNDING)
    assert {*ws.rows[:3, ka.SIGN].flat} == {-1.0, 1.0}
    assert np.ptp(ws.rows[:3, ka.SIGN], axis=1).max() > 0.0
    case = CASES["voltage limits"]()
    ws = compare(case.compiled, spread(case, WIDTH, np.random.default_rng(99)), 0.0, ROUNDING)
    held = np.abs(ws.motors[:, ka.VOLTAGE]) == 15.0
    assert np.any(held)
    assert not np.all(held)


@pytest.mark.parametrize("frozen", [0.0, 1.0])
def test_real_contact(frozen):
    """Points that slide either way, stick, and are off their planes; friction that depends on the speed."""
    rng = np.random.default_rng(12)
    b = assemble(random_robot(rng, 7), [random_plane(rng, f"body_{6 - k}") for k in range(4)], real=True)
    case = random_case(rng, b, 1.0)
    b.derivative(case.y, 0.0)
    modes = integers([ka.SLIDING, ka.STICKING, ka.OPEN, ka.SLIDING])
    set_modes(b.system.contacts, b.system.couplings, b.system.unilateral, b.ws, modes)
    real = b.system.unilateral
    real.slide[:, REFERENCE : REFERENCE + 3] = rng.normal(size=(4, 3))
    real.slide[0, FROZEN] = frozen
    law = b.system.contacts.law
    law[:, ka.STATIC], law[0, ka.STRIBECK], law[3, ka.VISCOUS] = 0.4, 0.5, 0.01
    y = spread(case, WIDTH, rng)
    ws = compare(b, y, 0.0, 1e-13)
    along = np.einsum("csk,cs->ck", ws.contacts[:, ka.SLIP_VELOCITY : ka.SLIP_VELOCITY + 3], real.slide[:, :3])
    assert {*np.sign(along[3])} == {-1.0, 1.0}


def short_run() -> np.ndarray:
    """Samples of RADAU5 with everything that it does on lanes."""
    b, q = braced(np.random.default_rng(3))
    y = b.state(q, np.zeros(len(b.robot.links)))
    return b.simulate(y, np.linspace(0.0, 0.01, 21), "radau5").sample


PLAIN = """
import sys
samples, tolerance, *folders = sys.argv[1:]
sys.path[:0] = folders
import numpy as np
from support.lane_cases import CASES
from test_lanes_compiled import compare, short_run, spread
for name in ("curved", "dissipative", "voltage limits") if float(tolerance) else ():
    case = CASES[name]()
    compare(case.compiled, spread(case, 4, np.random.default_rng(99)), 0.0, float(tolerance))
np.testing.assert_allclose(short_run(), np.load(samples), rtol=1e-9, atol=1e-9)
"""


@pytest.mark.parametrize(
    "environment",
    [
        pytest.param({"NUMBA_DISABLE_JIT": "1"}, id="python"),
        pytest.param({"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}, id="SSE2", marks=pytest.mark.slow),
        pytest.param({"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""}, id="AVX2", marks=pytest.mark.slow),
    ],
)
def test_other_processors_and_none(environment, tmp_path):
    """As plain Python, with the registers of two doubles that every such processor has, and with four."""
    folders = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]
    tolerance = "0.0" if "NUMBA_DISABLE_JIT" in environment else "1e-15"
    samples = tmp_path / "samples.npy"
    np.save(samples, short_run())
    subprocess.run(
        [sys.executable, "-c", PLAIN, str(samples), tolerance, *folders],
        env={**os.environ, **environment},
        check=True,
        timeout=600,
    )
