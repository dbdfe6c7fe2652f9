"""Impacts with two solutions, and the warning of them, in closed form.

A slide of mass M moves along x alone, on a point at a plane that leans by tan γ = 1/4: to −x it leaves the plane, and
moves nearly along it. A motor force F between the slide and a mass m on it drives m to −x and presses the slide to +x
onto the plane, until m hits its stop on the slide after the way d, at t = √(2 m d/F) with v = √(2 F d/m).

Without an impulse of the plane both go on with −m v/(M + m), and the point leaves. Impulses p along the normal and
λ p, |λ| ≤ μ, along the plane can also stop both if p (λ cos γ − sin γ) = m v: the plane jams the slide if μ > tan γ.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.messages import lines_with

from dynsim import load_scenario, simulate

MASS, SLIDER, FORCE, WAY = 3.0, 1.0, 2.0, 0.04
HITS = np.sqrt(2.0 * SLIDER * WAY / FORCE)
SPEED = np.sqrt(2.0 * FORCE * WAY / SLIDER)
SCENARIO = f"""
duration_s: 0.3
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  link: {{length_m: 0}}
  chain:
    - {{kind: prismatic, axis: x, mass_kg: {MASS}}}
    - {{kind: prismatic, axis: x, mass_kg: {SLIDER}, limit_m: [{-WAY}, 1], motor: {{type: torque}}}}
controller: {{type: joint_pd, torques: {{joint_2: {{times_s: [0, 1], torques_N_m: [{-FORCE}, {-FORCE}]}}}}}}
surfaces: {{slope: {{type: plane, normal: [-1, 0, 4]}}}}
contacts: {{law: unilateral, points: {{wedge: {{body: link_1, point_m: [0, 0, 0], surface: slope}}}}}}
integrator: {{method: dopri5}}
"""


@pytest.mark.parametrize(("friction", "jams"), [(0.5, True), (0.2, False)])
def test_a_point_that_leaves_in_an_impact_is_warned_of_if_it_could_jam(friction: float, jams: bool, tmp_path: Path):
    path = tmp_path / "wedge.yaml"
    path.write_text(SCENARIO, encoding="utf-8")
    record = simulate(load_scenario(path, overrides={"contacts.friction": friction}))
    lifts = [event for event in record.events if event.kind == "lift_off"]
    assert [event.name for event in lifts] == ["wedge"]
    assert lifts[0].time == pytest.approx(HITS, abs=1e-9)
    after = record.time > HITS + 1e-6
    np.testing.assert_allclose(record["v"][after, 0], -SLIDER * SPEED / (MASS + SLIDER), rtol=1e-8)
    np.testing.assert_allclose(record["q"][~after, 0], 0.0, atol=1e-12)
    said = lines_with(record.summary["warnings"], "wedge", f"{HITS:.6g} s", phrase="not unique")
    assert len(said) == jams
