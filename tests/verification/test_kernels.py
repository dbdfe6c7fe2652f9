"""Compilation of kernels: one signature each, direct kernels, and agreement with plain Python."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import config, typeof, types
from support.random_robots import assemble, random_contacts, random_robot

from dynsim.compile.model import Model
from dynsim.dynamics import derivative as system
from dynsim.dynamics import ledger
from dynsim.dynamics.tree import articulated, joints, sweep
from dynsim.integrators import driver, steps
from dynsim.jit.kernel import FixedSignature, _traits, reals

PLAIN_PYTHON = """
import sys
import numpy as np
from support.random_robots import assemble, random_contacts, random_robot

rng = np.random.default_rng(5)
robot = random_robot(rng, 4)
q, v, i = rng.normal(size=4), rng.normal(size=4), rng.normal(size=len(robot.motors))
contacts = random_contacts(rng, robot, q, 1)
rows = []
for m_star in (False, True):
    b = assemble(robot, contacts, m_star=m_star)
    rows.append(b.derivative(b.state(q, v, i)))
free = assemble(robot)
rows += [free.simulate(free.state(q, v, i), np.array([4e-3]), m, step=1e-3).y for m in ("dopri5", "radau5")]
np.savez(sys.argv[1], *rows)
"""


def run_everything() -> None:
    rng = np.random.default_rng(5)
    robot = random_robot(rng, 4)
    q = rng.normal(size=4)
    contacts = random_contacts(rng, robot, q, 1)
    for m_star in (False, True):
        b = assemble(robot, contacts, m_star=m_star)
        b.derivative(b.state(q, np.zeros(4)))
    free = assemble(robot)
    free.simulate(free.state(q, np.zeros(4)), np.array([1e-3]), "dopri5", step=1e-3)
    free.simulate(free.state(q, np.zeros(4)), np.array([1e-3]), "radau5")
    model = Model(robot)
    model.mass_matrix(list(q))
    model.forward_dynamics(q, q, q)
    model.inverse_dynamics(q[::-1], q, np.broadcast_to(1.0, 4))
    model.point_jacobian("body_3", [0, 0, 1], q.astype(np.float32))
    model.kinetic_energy(q, q)
    model.potential_energy(q)


def default_programs(kernel: Any) -> list[Any]:
    """Compiled signatures for systems without the tables that are None by default, but for ``dense``.

    Other tests of the same process bring systems with these, each with a program of its own.
    """
    programs = []
    for signature in kernel.signatures:
        system_type = signature[0]
        part = dict(zip(system_type.fields, system_type.types, strict=True))
        absent = [part[name] for name in ("shapes", "unilateral")]
        for other in signature[1:]:
            run = dict(zip(getattr(other, "fields", ()), getattr(other, "types", ()), strict=True))
            absent += [run[name] for name in ("stepping",) if name in run]
        if all(kind == types.none for kind in absent):
            programs.append(signature)
    return programs


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_every_public_kernel_has_one_compiled_signature():
    run_everything()
    # Every one was called above, from Python: none at all would mean that this test looks at the wrong function.
    assert len(default_programs(system.derivative)) == 2  # one program per solver
    for kernel in (driver.advance_dopri5, driver.advance_radau5):
        assert 1 <= len(default_programs(kernel)) <= 2, kernel  # for m_star in long tests only
    for kernel in (
        sweep.newton_euler,
        sweep.mass_matrix,
        articulated.forward_dynamics,
        joints.point_position,
        joints.point_jacobian,
        ledger.kinetic_energy,
        ledger.potential_energy,
    ):
        assert len(kernel.signatures) == 1, kernel


def test_a_direct_kernel_is_the_kernel():
    """Also with other arrays than those of the first call."""
    direct = FixedSignature(steps.finite)
    for values in ([1.0, 2.0], [1.0, np.nan, 3.0], []):
        assert direct(reals(values)) == steps.finite(reals(values)) == bool(np.isfinite(values).all())


def test_values_with_equal_traits_have_the_same_numba_type():
    grid = np.zeros((3, 4))
    fixed = grid.copy()
    fixed.flags.writeable = False
    arrays = (
        grid,
        grid.T,
        grid[:, ::2],
        grid[0],
        fixed,
        np.zeros((3, 4), dtype=np.int64),
        np.zeros(25)[1:].reshape(4, 6),
    )
    values = (*arrays, 1, 1.0, True, None, (grid,), (grid, 1), (fixed,), ((grid,),), steps.finite)
    for a, b in combinations(values, 2):
        assert _traits(a) != _traits(b) or typeof(a) == typeof(b), (a, b)
    # The traits distinguish no more than this, so that runs share the compiled signatures.
    assert _traits((grid, 1, 2.0)) == _traits((np.ones((7, 2)), 5, 0.0))


def test_kernels_run_as_plain_python(tmp_path):
    """NUMBA_DISABLE_JIT=1 gives the compiled numbers to rounding (compiled code contracts a·b + c)."""
    results = []
    for disable in ("0", "1"):
        out = tmp_path / f"{disable}.npz"
        paths = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disable, "PYTHONPATH": os.pathsep.join(paths)}
        subprocess.run([sys.executable, "-c", PLAIN_PYTHON, str(out)], env=environment, check=True, timeout=300)
        results.append(np.load(out))
    for key in results[0].files:
        compiled, plain = results[0][key], results[1][key]
        # Rounding; and where Newton's method of radau5 ends, by a Jacobian of finite differences.
        np.testing.assert_allclose(compiled, plain, rtol=0, atol=1e-9 * (1.0 + np.abs(plain).max()))
