"""Contact points behind closed brakes: a braked joint is locked, and points that only such joints move are left out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import lines_with

import dynsim
from dynsim.scenario import scenario_from_resolved

# Motions of the same equations with other roundings, at rtol 1e-9 [rad; N]: measured up to 4e-12 and 5e-9.
SAME_MOTION, SAME_FORCE = 1e-9, 1e-7
INITIAL_DEG = [0.0, 45.0, 90.0, -90.0, 45.0, 45.0, -90.0, 45.0, -45.0, 45.0]
MOVING = ("joint_1", "joint_6", "joint_9", "joint_10")
TIP = [0.0, 0.0, 0.2]  # tip of the two links, in the frame of the second
# Joints 2 and 3 alone move elbow_4 along the normal of the floor.
BEHIND_BRAKES = [["joint_2", "joint_3"], ["joint_2", "joint_3", "joint_4"], ["joint_1", "joint_2", "joint_3"]]
MOVABLE = [["joint_5"], ["joint_5", "joint_8"], ["joint_3"]]


def braced_arm(folder: Path, law: str, method: str, lock: Sequence[str] = ()) -> dynsim.Scenario:
    """The published arm on its two elbows, with some joints locked."""
    published = dynsim.build_model(dynsim.load_scenario("elbow_comparison", "two_elbows"))
    (folder / "arm.urdf").write_text(published.to_urdf())
    angles = {f"joint_{k}": angle for k, angle in enumerate(INITIAL_DEG, 1)}
    free = [joint for joint in angles if joint not in lock]
    accuracy = {} if method == "time_stepping" else {"rtol": 1e-9, "atol": 1e-11}
    config: dict[str, Any] = {
        "name": "braked",
        "duration_s": 0.2,
        "plant": {
            "type": "urdf_arm",
            "file": "arm.urdf",
            "motors": {joint: {"type": "wang_minami"} for joint in free},
            "initial_deg": {joint: angles[joint] for joint in free},
            **({"lock_deg": {joint: angles[joint] for joint in lock}} if lock else {}),
        },
        "controller": {
            "type": "joint_pd",
            "joints": {
                joint: {"times_s": [0.02, 0.18], "angles_deg": [angles[joint], angles[joint] + 4.0]}
                for joint in MOVING
                if joint in free
            },
        },
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {
            "law": law,
            "friction": 0.1,
            **({"reference_tolerance_m": 1.0} if law == "bilateral" else {}),
            "points": {f"elbow_{k}": {"body": f"link_{k}", "surface": "floor"} for k in (4, 7)},
        },
        "integrator": {"method": method, **accuracy},
        "record": {"rate_hz": 200},
    }
    file = folder / "braked.yaml"
    file.write_text(json.dumps(config))
    return dynsim.load_scenario(str(file))


def braked(scenario: dynsim.Scenario, joints: list[str]) -> dynsim.Simulation:
    simulation = dynsim.Simulation(scenario)
    for joint in joints:
        simulation.set_brake(joint, True)
    return simulation


def column(record: dynsim.Record, signal: str, names: Any) -> np.ndarray:
    labels = list(record.labels[signal])
    return record[signal][:, [labels.index(name) for name in names]]


def left_out(warnings: list[str]) -> list[str]:
    return lines_with(warnings, phrase="behind brakes")


@pytest.mark.parametrize(
    ("law", "method"),
    [
        ("bilateral", "dopri5"),
        ("bilateral", "radau5"),
        ("unilateral", "dopri5"),
        ("unilateral", "radau5"),
        ("unilateral", "time_stepping"),
    ],
)
@pytest.mark.parametrize("joints", [*BEHIND_BRAKES, *MOVABLE])
def test_braked_joints_are_locked_joints(tmp_path: Path, law: str, method: str, joints: list[str]) -> None:
    """Glued elbow_4 had 76 N, a share of the brakes' 1e30 kg m², or the run stopped: "the step size fell to"."""
    simulation = braked(braced_arm(tmp_path, law, method), joints)
    simulation.advance(0.2)
    record, locked = simulation.record(), dynsim.simulate(braced_arm(tmp_path, law, method, joints))
    for signal, tolerance in (("q", SAME_MOTION), ("contact_normal_force", SAME_FORCE)):
        same = column(record, signal, locked.labels[signal])
        np.testing.assert_allclose(same, locked[signal], rtol=0.0, atol=tolerance)
    behind = joints in BEHIND_BRAKES
    assert column(record, "contact_normal_force", ["elbow_4"]).any() != behind
    sentences = left_out(record.summary["warnings"])
    assert [text.split(":")[0] for text in sentences] == (["contacts.points.elbow_4"] if behind else [])
    assert not lines_with(record.summary["warnings"], phrase="never")


@pytest.mark.parametrize(
    ("law", "method"), [("bilateral", "radau5"), ("unilateral", "radau5"), ("unilateral", "time_stepping")]
)
def test_a_contact_comes_back_when_brakes_open(tmp_path: Path, law: str, method: str) -> None:
    simulation = dynsim.Simulation(braced_arm(tmp_path, law, method))
    simulation.set_wrench("link_4", force=[0.0, 0.0, -50.0])
    simulation.advance(0.0501)
    before = simulation.snapshot()
    for joint in ("joint_2", "joint_3"):
        simulation.set_brake(joint, True)
    simulation.advance(0.1201)
    for joint in ("joint_2", "joint_3"):
        simulation.set_brake(joint, False)
    simulation.advance(0.2)
    record = simulation.record()
    force = column(record, "contact_normal_force", ["elbow_4"])[:, 0]
    braking = (record.time > 0.0501) & (record.time < 0.1201)
    assert not force[braking].any()
    assert force[record.time < 0.0501].min() > 10.0
    assert force[record.time > 0.1201].min() > 10.0
    assert np.abs(column(record, "contact_gap", ["elbow_4"])).max() < 1e-9
    assert len(left_out(record.summary["warnings"])) == 1
    simulation.restore(before)
    simulation.advance(0.2)
    unbraked = simulation.record()
    assert not left_out(unbraked.summary["warnings"])
    assert column(unbraked, "contact_normal_force", ["elbow_4"]).min() > 10.0


@pytest.mark.parametrize("method", ["dopri5", "radau5", "time_stepping"])
def test_a_stop_has_no_force_behind_a_closed_brake(tmp_path: Path, method: str) -> None:
    """The brake carries all of the load of its joint; in time stepping the stop used to carry all of it."""
    link = {"axis": "y", "length_m": 0.3, "mass_kg": 0.3, "radius_m": 0.02, "motor": {"type": "wang_minami"}}
    config = {
        "name": "stopped",
        "duration_s": 0.3,
        "plant": {"type": "serial_arm", "chain": [{**link, "initial_deg": 90.0, "limit_deg": [-10, 90]}, link]},
        "controller": {
            "type": "joint_pd",
            "k_p_V_per_rad": 200.0,
            "k_d_V_s_per_rad": 8.0,
            "joints": {"joint_1": {"times_s": [0.05, 0.15], "angles_deg": [90, 95]}},
        },
        "contacts": {"law": "unilateral"},
        "integrator": {"method": method},
        "record": {"rate_hz": 200},
    }
    file = tmp_path / "stopped.yaml"
    file.write_text(json.dumps(config))
    simulation = dynsim.Simulation(dynsim.load_scenario(str(file)))
    for until, closed in ((0.1, True), (0.2, False), (0.3, False)):
        simulation.advance(until)
        simulation.set_brake("joint_1", closed)
    record = simulation.record()
    force, time = record["stop_force"][:, 0], record.time
    assert not force[(time > 0.105) & (time < 0.195)].any()
    # Pressed against it by the motor, after the first moments.
    assert (np.abs(force[(time > 0.06) & (time < 0.095)]) > 1.0).all()
    assert (np.abs(force[time > 0.21]) > 1.0).all()
    assert [event.kind for event in record.events] == ["stop_left", "stop_hit"]


def two_links(method: str, law: str = "unilateral") -> dynsim.Scenario:
    """Two links under a shoulder 0.3 m above a floor, whose tip touches it 0.05 m to the side of the shoulder."""
    link = {"axis": "y", "mass_kg": 0.3, "length_m": 0.2}
    config = {
        "name": "pole",
        "duration_s": 0.2,
        "plant": {
            "type": "serial_arm",
            "base": {"position_m": [0, 0, 0.3]},
            "chain": [{**link, "initial_deg": 130}, {**link, "initial_deg": 81}],
        },
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {
            "law": law,
            "friction": 0.3,
            "points": {"tip": {"body": "link_2", "point_m": TIP}},
        },
        "initial": {"on_surface": ["tip"]},
        "integrator": {"method": method},
    }
    return scenario_from_resolved(config)


def sliding_on(scenario: dynsim.Scenario, speed: float) -> dynsim.Simulation:
    """The two links, their tip sliding along the floor; the faster joint has this speed [rad/s]."""
    simulation = dynsim.Simulation(scenario)
    q = simulation.state.q
    normal = np.asarray(simulation.model.point_jacobian("link_2", TIP, q))[2]
    along = np.array([normal[1], -normal[0]])
    return dynsim.Simulation(scenario, state=dynsim.State(0.0, q, speed * along / np.abs(along).max(), np.zeros(0)))


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_what_a_glued_point_takes_as_a_brake_closes_is_in_the_ledger(method: str) -> None:
    """Behind the brake one joint is left, which the floor stops: all kinetic energy is lost at that instant."""
    simulation = sliding_on(two_links(method, "bilateral"), 1.0)
    state = simulation.advance(0.01)
    kinetic = 0.5 * state.v @ simulation.model.mass_matrix(state.q) @ state.v
    before = simulation.record()["loss_joint"][-1]
    simulation.set_brake("joint_2", True)
    simulation.advance(0.1)
    record = simulation.record()
    assert kinetic > 1e-3
    assert np.abs(record["v"][record.time > 0.01]).max() < 1e-9
    assert record["loss_joint"][-1] - before == pytest.approx(kinetic, rel=1e-6)
    assert record.summary["energy_residual_relative"] < 1e-7
    assert not lines_with(record.summary["warnings"], phrase="ledger")


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize(("sign", "leaves"), [(1.0, False), (-1.0, True)])
def test_what_separates_as_a_brake_closes_leaves(method: str, sign: float, leaves: bool) -> None:
    """A sliding tip that the brake's impulse lifts, where its friction would be beyond Painlevé's limit."""
    simulation, tip = sliding_on(two_links(method), sign), np.array(TIP)
    simulation.advance(0.01)
    simulation.set_brake("joint_2", True)
    state = simulation.state
    rate = np.asarray(simulation.model.point_jacobian("link_2", tip, state.q))[2] @ state.v
    assert (rate > 0.01) == leaves
    simulation.advance(0.1)
    first = simulation.record().events[0]
    assert (first.time, first.kind) == (0.01, "lift_off" if leaves else "slip_stop")


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_the_ledger_has_what_a_brake_takes_while_a_coupled_arm_rests_on_a_stop(method: str, tmp_path: Path) -> None:
    """A closing brake stops its joint by a row of a coupling, whose loss was in no part of the ledger (8.6 % open)."""
    parts, parent = ['<robot name="r"><link name="world"/>'], "world"
    for k in range(4):
        lower, height = (-0.05, 0.25) if k == 1 else (-100.0, 0.25 * (k > 0))
        mimic = '<mimic joint="j0" multiplier="-0.7" offset="0"/>' if k == 3 else ""
        parts.append(
            f'<link name="b{k}"><inertial><origin xyz="0.02 0.01 0.12"/><mass value="0.5"/><inertia ixx="1e-3" '
            f'iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{k}" type="revolute">'
            f'<parent link="{parent}"/><child link="b{k}"/><origin xyz="0 0 {height}"/><axis xyz="0 1 0"/>'
            f'<limit lower="{lower}" upper="100" effort="0" velocity="0"/>{mimic}</joint>'
        )
        parent = f"b{k}"
    (tmp_path / "arm.urdf").write_text("\n".join([*parts, "</robot>"]))
    data = {
        "name": "coupled",
        "duration_s": 0.4,
        "plant": {
            "type": "urdf_arm",
            "file": str(tmp_path / "arm.urdf"),
            "gravity_m_s2": [2, 0, -9.81],
            "initial_deg": {"j0": 30, "j1": 0, "j2": -60},
        },
        "contacts": {"law": "unilateral"},
        "loads": {"push": {"type": "constant", "body": "b1", "torque_N_m": [0, -3, 0]}},
        "integrator": {"method": method, "rtol": 1e-9},
    }
    simulation = dynsim.Simulation(scenario_from_resolved(data))
    simulation.advance(0.2)
    simulation.set_brake("j2", True)
    simulation.advance(0.4)
    record = simulation.record()
    assert record.summary["energy_residual_relative"] < 1e-7
    assert record["loss_impact"][-1] > 0.1
