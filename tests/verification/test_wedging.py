"""A contact that friction can wedge by itself, in closed form.

A body of mass m slides along x and z alone, on a plane with the normal (0, n_y, n_z). Forces across its motion, along
y, move nothing. They lie in the friction cone if μ ≥ n_z/n_y: then friction can hold the body against every load. It
slips otherwise if the load along x is above μ m g/n_z.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with

from dynsim import Record, load_scenario, simulate
from dynsim.dynamics.tables import SLIDING, STICKING
from dynsim.engine.force_indeterminacy import least_coefficient

# n_z/n_y, g along z, and a load along x that is more than friction of 2.1 holds without a wedge: 2.1 · 10/0.894 = 23.5.
LEAST, WEIGHT, LOAD = 2.0, 10.0, 30.0
SCENARIO = """
duration_s: 0.05
plant:
  type: serial_arm
  gravity_m_s2: [{load}, 0, -10]
  link: {{length_m: 0}}
  chain:
    - {{kind: prismatic, axis: x, mass_kg: 0}}
    - {{kind: prismatic, axis: z, mass_kg: 1}}
surfaces: {{slope: {{type: plane, normal: {normal}}}}}
contacts:
  law: unilateral
  friction: {friction}
  points: {{foot: {{body: link_2, point_m: [0, 0, 0], surface: slope}}}}
integrator: {{method: {method}}}
"""


def slide(folder: Path, friction: float, load: float, normal: str = "[0, 1, 2]", method: str = "dopri5") -> Record:
    path = folder / "slide.yaml"
    path.write_text(SCENARIO.format(friction=friction, load=load, normal=normal, method=method), encoding="utf-8")
    return simulate(load_scenario(path))


def said(record: Record) -> list[str]:
    return lines_with(record.summary["warnings"], phrase="not unique")


@pytest.mark.parametrize("method", ["dopri5", "time_stepping"])
def test_a_contact_that_friction_can_wedge_is_warned_of(method: str, tmp_path: Path):
    (warning,) = said(slide(tmp_path, 2.1, LOAD, method=method))
    check_message(warning, "foot", "slope", "2", "2.1")
    assert not said(slide(tmp_path, 1.9, LOAD, method=method))


def test_a_contact_that_sticks_without_a_wedge_has_one_motion(tmp_path: Path):
    record = slide(tmp_path, 2.1, 0.7 * 2.1 * WEIGHT / np.sqrt(0.8))
    assert (record["contact_mode"] == STICKING).all()
    assert not said(record)


def test_a_plane_that_does_not_lean_sideways_wedges_nothing(tmp_path: Path):
    record = slide(tmp_path, 2.1, LOAD, normal="[0.2, 0, 1]")
    assert (record["contact_mode"] == SLIDING).all()
    assert not said(record)


def test_least_coefficient_is_the_tangent_of_the_angle_to_the_blocked_directions():
    normal = np.array([0.0, 0.6, 0.8])
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    for rows, least in (
        (np.eye(3), np.inf),
        (np.eye(3)[[0, 2]], LEAST * 2.0 / 3.0),
        # A joint along x and one along the slope: all forces that they leave are along the normal.
        (np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6]]), np.inf),
        # One joint along z: of all directions across it, y is nearest to the normal.
        (np.eye(3)[[2]], LEAST * 2.0 / 3.0),
        # One joint at 30° from the normal.
        (np.array([[0.5, np.sqrt(0.75) * 0.6, np.sqrt(0.75) * 0.8]]), np.sqrt(3.0)),
        (np.zeros((2, 3)), np.inf),
    ):
        assert least_coefficient(turn @ rows.T, turn @ normal)[0] == pytest.approx(least, rel=1e-12)
