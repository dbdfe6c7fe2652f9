"""The screw joint of docs/dev/core.md, added to a copy of the package as the document says, and its dynamics."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Two tests that run in the copy: the nut of a vertical screw; and a tree with a screw joint against the same tree with
# a prismatic and a revolute joint instead, coupled by x = lead · q with a Lagrange multiplier.
SCREW = """
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from support.random_robots import assemble, random_inertia, random_robot_of, random_rotation, without_losses

import dynsim
from dynsim.compile.clearance import poses
from dynsim.model.description import Inertia, Link, Robot, in_rows
from dynsim.compile.model import Model

assert Path(dynsim.__file__).is_relative_to(sys.argv[1]), dynsim.__file__

m, g, lead, I = 0.8, 9.81, 0.05, 0.002
z = np.array([0.0, 0.0, 1.0])
inertia = Inertia(m, np.array([0.0, 0.0, 0.1]), I * np.eye(3))
nut = Robot("nut", (Link("nut", "screw", None, "screw", z, inertia, parameter=lead),), (), ("nut", np.zeros(3)))
rate = -m * g * lead / (I + m * lead**2)
model = Model(nut)
for q, v in ((0.0, 0.0), (2.0, -3.0)):
    np.testing.assert_allclose(model.forward_dynamics([q], [v], [0.0]), rate, rtol=1e-14)
b = assemble(nut)
times = np.linspace(0.0, 0.1, 6)
run = b.simulate(b.state([0.3], [2.0]), times, "dopri5", rtol=1e-8)
q, v = run.states("q")[:, 0], run.states("v")[:, 0]
# The method is exact for a parabola.
np.testing.assert_allclose(q, 0.3 + 2.0 * times + 0.5 * rate * times**2, rtol=0, atol=1e-12)
np.testing.assert_allclose(v, 2.0 + rate * times, rtol=0, atol=1e-12)
energy = [model.kinetic_energy([a], [c]) + model.potential_energy([a]) for a, c in zip(q, v)]
np.testing.assert_allclose(energy, energy[0], rtol=1e-13)

rng = np.random.default_rng(6)
for case in range(10):
    arm = without_losses(random_robot_of(rng, ["revolute", "revolute", "prismatic", "revolute"], branches=False)).links
    base = arm[1].name if case % 2 else None
    carrier = Link("nut", "screw", base, "screw", z, random_inertia(rng), random_rotation(rng), rng.normal(size=3))
    free = in_rows(carrier, [("slide", "prismatic", z), ("turn", "revolute", z)])
    screw = (replace(carrier, parameter=lead),)
    on_it = replace(arm[2], parent="nut")
    robots = [
        Robot("tree", (*arm[:2], *rows, on_it, arm[3]), (), (arm[3].name, np.zeros(3)), rng.normal(size=3))
        for rows in (screw, free)
    ]
    robots[1] = replace(robots[1], gravity=robots[0].gravity)
    coupled, loose = map(Model, robots)
    # Rates of the loose tree from those of the coupled one.
    T = np.zeros((6, 5))
    T[[0, 1, 3, 4, 5], range(5)], T[2, 2] = 1.0, lead
    q, v, tau = rng.normal(size=(3, 5))
    row = np.array([[0.0, 0.0, 1.0, -lead, 0.0, 0.0]])
    K = np.block([[loose.mass_matrix(T @ q), row.T], [row, np.zeros((1, 1))]])
    force = np.array([tau[0], tau[1], 0.0, *tau[2:]]) - loose.bias_forces(T @ q, T @ v)
    expected = np.linalg.solve(K, [*force, 0.0])[[0, 1, 3, 4, 5]]
    np.testing.assert_allclose(coupled.forward_dynamics(q, v, tau), expected, rtol=1e-9, atol=1e-11)
    scale = np.abs(coupled.bias_forces(q, v)).max() + np.abs(expected).max()
    np.testing.assert_allclose(coupled.inverse_dynamics(q, v, expected), tau, rtol=0, atol=1e-11 * scale)
    for link, R, p in poses(robots[0], q[None]):
        R_model, p_model = coupled.body_pose(link.name, q)
        np.testing.assert_allclose(R[..., 0], R_model, rtol=0, atol=1e-14)
        np.testing.assert_allclose(p[:, 0], p_model, rtol=0, atol=1e-14)
print("the screw turns")
"""


def extended(folder: Path) -> Path:
    """A copy of the package with the file and the branch of the document."""
    shutil.copytree(ROOT / "dynsim", folder / "dynsim", ignore=shutil.ignore_patterns("__pycache__"))
    text = (ROOT / "docs" / "dev" / "core.md").read_text(encoding="utf-8")
    section = text.split("\n## A joint\n")[1].split("\n## ")[0]
    file, branch = re.findall(r"```python\n(.*?)```", section, flags=re.DOTALL)
    (folder / "dynsim" / "model" / "joints" / "screw.py").write_text(file, encoding="utf-8")
    joints = folder / "dynsim" / "dynamics" / "tree" / "joints.py"
    kernel = joints.read_text(encoding="utf-8")
    before = "\n    elif kind == ka.ROLL:\n"
    assert kernel.count(before) == 1
    kernel = kernel.replace(before, f"\n{branch.rstrip()}{before}")
    joints.write_text(kernel, encoding="utf-8")
    return folder


def run(folder: Path, **environment: str) -> None:
    paths = os.pathsep.join([str(folder), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-c", SCREW, str(folder)],
        env={**os.environ, **environment, "PYTHONPATH": paths},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert "the screw turns" in done.stdout


def test_a_screw_as_the_document_adds_it(tmp_path):
    run(extended(tmp_path), NUMBA_DISABLE_JIT="1")


@pytest.mark.slow
def test_the_same_compiled(tmp_path):
    run(extended(tmp_path), NUMBA_CACHE_DIR=str(tmp_path / "cache"))
