"""Joint limits in the references of hand paths: kept, or the path is refused with joint, time and amount."""

from __future__ import annotations

import re

import numpy as np
import pytest
from support.messages import raises

from dynsim import load_scenario
from dynsim.engine.prepare import prepare
from dynsim.errors import ModelError, UnreachableReference

ARM = """
duration_s: 2
plant:
  type: serial_arm
  link: {mass_kg: 0.2, length_m: 0.4, motor: {type: wang_minami}}
  chain:
    - {axis: y, initial_deg: 30}
    - {axis: y, initial_deg: 40, limit_deg: [-90, LIMIT]}
    - {axis: y, initial_deg: 30}
    - {axis: y, initial_deg: 30}
controller:
  type: joint_pd
  hand:
    joints: [joint_1, joint_2, joint_3, joint_4]
    path: {type: line, from_m: [START], to_m: [1.0, 0, 0.2], start_s: 0.2, duration_s: 1.5}
"""


@pytest.fixture
def arm(tmp_path):
    def write(limit: float, joints: str = "joint_1, joint_2, joint_3, joint_4"):
        degrees = np.radians(np.cumsum([30.0, 40.0, 30.0, 30.0]))
        start = 0.4 * np.sin(degrees).sum(), 0.0, 0.4 * np.cos(degrees).sum()
        path = tmp_path / "arm.yaml"
        text = ARM.replace("LIMIT", str(limit)).replace("START", ", ".join(map(repr, map(float, start))))
        path.write_text(text.replace("joint_1, joint_2, joint_3, joint_4", joints), encoding="utf-8")
        return load_scenario(path)

    return write


def references(scenario):
    prepared = prepare(scenario)
    pieces = list(prepared.control.positions(prepared.model.robot))
    times, q = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    hand = np.array([prepared.model.point_position(*prepared.model.robot.hand, posture) for posture in q])
    return times, q, np.abs(hand - prepared.control.path.position(times)).max()


def test_a_redundant_arm_keeps_its_limit_and_its_path(arm):
    """Without the limit the joint passes it; with it the others make up for it, and the hand is on its path."""
    _, free, _ = references(arm(170))
    reached = np.degrees(free[:, 1].max())
    limit = 0.5 * (40.0 + reached)
    assert reached > 42.0
    _, q, off = references(arm(limit))
    # Between knots the spline bends about the instant at which the joint comes to rest.
    assert np.degrees(q[:, 1].max()) <= limit + 0.05
    assert np.degrees(q[:, 1].max()) > limit - 1e-6
    assert off < 1e-4


def test_a_path_that_needs_more_is_refused_with_joint_time_and_amount(arm):
    """Two joints have no choice: what is said is what they would do without the limit."""
    times, free, _ = references(arm(170, "joint_1, joint_2"))
    limit = float(0.5 * (40.0 + np.degrees(free[:, 1].max())))
    with raises(UnreachableReference, "arm.yaml", "joint_2", re.compile(r"\bt = [\d.]+ s")) as refused:
        prepare_named(arm(limit, "joint_1, joint_2"))
    since, amount = (float(re.findall(number, str(refused.value))[-1]) for number in (r"t = ([\d.]+) s", r"([\d.]+)°"))
    beyond = np.degrees(free[:, 1]) - limit
    assert amount == pytest.approx(beyond.max(), rel=1e-2)
    assert since == pytest.approx(times[beyond > 0.0][0], abs=0.03)


def test_a_joint_that_starts_beyond_its_limit_is_refused(arm):
    with raises(ModelError, "joint_2", "40°", "35°"):
        prepare_named(arm(35))


def prepare_named(scenario):
    from dynsim import check

    return check(scenario)
