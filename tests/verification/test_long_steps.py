"""What happens within long steps of the implicit method, in the summary and its warnings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.messages import lines_with

from dynsim import load_scenario, simulate

PUSHED = """
duration_s: 3.0
plant:
  type: serial_arm
  link: {length_m: 0.5, mass_kg: 1.0, damping_N_m_s_per_rad: 0.5, motor: {type: wang_minami}}
  chain: [{axis: y, initial_deg: 90}]
controller: {type: joint_pd}
surfaces: {floor: {type: plane}}
contacts: {friction: 0.0, points: {tip: {body: link_1, point_m: [0, 0, 0.5]}}}
loads:
  push:
    type: samples
    body: link_1
    point_m: [0, 0, 0.5]
    times_s: [1.0, 1.125, 1.625, 1.75]
    force_N: [[0, 0, 0], [0, 0, 4], [0, 0, 4], [0, 0, 0]]
"""


def test_a_contact_that_pulls_within_a_step_is_counted(tmp_path: Path) -> None:
    """A step of the arm at rest spans the whole push; the warning said that the floor pulls for 0.0 % of the run."""
    path = tmp_path / "pushed.yaml"
    path.write_text(PUSHED, encoding="utf-8")
    record = simulate(load_scenario(path))
    (tip,) = record.summary["contacts"]
    pulling = record["contact_normal_force"][:, 0] < 0.0
    assert pulling.any()
    assert tip["pulling_fraction"] == pytest.approx(pulling.mean(), abs=2.0 / len(record))
    fine = simulate(load_scenario(path, overrides={"integrator.method": "dopri5"}))
    assert tip["pulling_fraction"] == pytest.approx(fine.summary["contacts"][0]["pulling_fraction"], abs=0.003)
    assert tip["normal_force_min_N"] == np.min(record["contact_normal_force"])


PULLED = """
duration_s: 1.5
plant:
  type: serial_arm
  base: {position_m: [50, 50, 50]}
  chain: [{kind: prismatic, axis: x, mass_kg: 1.0, length_m: 0.1}]
contacts: {law: unilateral, friction: 0.3}
surfaces: {floor: {type: plane}}
objects: {ball: {mass_kg: 0.5, shape: sphere, radius_m: 0.1, position_m: [0, 0, 0.1]}}
loads:
  lift:
    type: samples
    body: ball
    times_s: [1.0, 1.01, 1.03, 1.04]
    force_N: [[0, 0, 0], [0, 0, 4.8], [0, 0, 4.8], [0, 0, 0]]
"""


def test_a_lift_off_between_the_knots_of_a_load_is_found(tmp_path: Path) -> None:
    """The load passes the weight between its knots, within one step; the record had forces down to -1.5 N."""
    path = tmp_path / "pulled.yaml"
    path.write_text(PULLED, encoding="utf-8")
    short = {"integrator.method": "dopri5", "integrator.step_max_s": 2e-4}
    runs = [simulate(load_scenario(path, overrides=changed)) for changed in ({}, short)]
    times = [[event.time for event in record.events if event.kind in ("lift_off", "landing")] for record in runs]
    assert len(times[1]) == 2
    np.testing.assert_allclose(times[0], times[1], rtol=0.0, atol=1e-6)
    for record in runs:
        assert record["contact_normal_force"].min() > -1e-3
        assert not lines_with(record.summary["warnings"], phrase="pulls in a step")
