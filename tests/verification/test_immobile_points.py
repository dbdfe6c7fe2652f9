"""Contact points that no joint moves along the normal, in every posture or in one: they carry nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import lines_with, raises

import dynsim
from dynsim.errors import ModelError

EVENT_DRIVEN = ["dopri5", "radau5"]
METHODS = [*EVENT_DRIVEN, "time_stepping"]
MOTOR = {"type": "wang_minami"}
# Step size control sees the integrals of contact force and slip too. Should steps differ by that, motions differ by the
# tolerance (rtol 1e-6 by default), which controlled arms do not amplify [rad].
SAME_MOTION = 1e-7
# What the ledger promises without damping [share of the turnover].
LEDGER = 1e-6


def scenario(folder: Path, chain: list[dict[str, Any]], surface: dict[str, Any], **keys: Any) -> dynsim.Scenario:
    """An arm whose first joint follows ``to`` [deg], with a contact ``tip`` at the end of its last link."""
    start = chain[0].get("initial_deg", 0.0)
    point = keys.get("point", {"body": f"link_{len(chain)}", "point_m": [0.0, 0.0, chain[-1]["length_m"]]})
    path = {"times_s": [0.0, 0.5], "angles_deg": [start, keys.get("to", start)]}
    config = {
        "name": "immobile",
        "duration_s": 0.5,
        "plant": {"type": "serial_arm", "link": {"radius_m": 0.02, "motor": MOTOR}, "chain": chain},
        "controller": {
            "type": "joint_pd",
            "k_p_V_per_rad": 200.0,
            "k_d_V_s_per_rad": 8.0,
            **({"joints": {"joint_1": path}} if "to" in keys else {}),
        },
        "surfaces": {"wall": {"type": "plane", **surface}},
        "contacts": {
            "law": keys.get("law", "unilateral"),
            "friction": keys.get("friction", 0.1),
            "points": {"tip": {"surface": "wall", "enabled": keys.get("enabled", True), **point}},
        },
        "record": {"rate_hz": 1000.0},
        "integrator": {"method": keys.get("method", "dopri5"), "wall_limit_s": 60.0},
        **({"initial": keys["initial"]} if "initial" in keys else {}),
    }
    file = folder / "immobile.yaml"
    file.write_text(json.dumps(config))
    return dynsim.load_scenario(str(file))


def swing(start: float) -> list[dict[str, Any]]:
    """One link that stands upright at 0 degrees."""
    return [{"axis": "y", "length_m": 0.3, "initial_deg": start}]


# A yaw joint without length carries the shoulder, at the origin in every posture.
SHOULDER = [
    {"axis": "z", "length_m": 0.0},
    {"axis": "y", "length_m": 0.3, "initial_deg": 60.0},
    {"axis": "y", "length_m": 0.3, "initial_deg": 40.0},
]
ELBOW = {"body": "link_2", "radius_m": 0.00940720869}
SLANTED = {"point_m": [-0.01, 0.0, 0.0], "normal": [1.0, 0.2, 0.3]}
# The end of the upright link just touches this ceiling: it is immobile along the normal there.
CEILING = {"point_m": [0.0, 0.0, 0.3], "normal": [0.0, 0.0, -1.0]}


def both(folder: Path, *args: Any, **keys: Any) -> tuple[dynsim.Record, dynsim.Record]:
    """Records with the point, and without it."""
    return tuple(dynsim.simulate(scenario(folder, *args, enabled=enabled, **keys)) for enabled in (True, False))  # type: ignore[return-value]


def steps(record: dynsim.Record) -> int:
    return int(record.summary["steps"])


def carries_nothing(touching: dynsim.Record, free: dynsim.Record) -> None:
    """The point has no force and costs no steps, and the ledger closes."""
    assert not touching["contact_normal_force"].any()
    assert abs(steps(touching) - steps(free)) <= 0.1 * steps(free) + 10
    assert touching.summary["energy_residual_relative"] < LEDGER


def about_left_out(warnings: Any) -> list[str]:
    return lines_with(warnings, phrase="immobile")


@pytest.mark.parametrize("method", [pytest.param("dopri5", marks=pytest.mark.long), *METHODS[1:]])
def test_a_point_at_the_shoulder_changes_nothing(tmp_path: Path, method: str) -> None:
    """It began 6e-12 m below its surface: forces of 1e16 N, joints thrown by 1e5 rad, and 11 million steps."""
    touching, free = both(tmp_path, SHOULDER, SLANTED, point=ELBOW, to=40.0, method=method)
    np.testing.assert_allclose(np.degrees(touching["q"][0]), [0.0, 60.0, 40.0], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(touching["q"], free["q"], rtol=0.0, atol=SAME_MOTION)
    assert not touching["contact_normal_force"].any()
    assert not touching.events
    assert abs(steps(touching) - steps(free)) <= 0.1 * steps(free)
    assert touching.summary["energy_residual_relative"] < LEDGER
    (warning,) = about_left_out(touching.summary["warnings"])
    assert warning.startswith("contacts.points.tip: ")
    assert not lines_with(touching.summary["warnings"], phrase="never")


@pytest.mark.parametrize("method", EVENT_DRIVEN)
# A sphere has a program of its own to compile under the glued law.
@pytest.mark.parametrize("radius", [0.0, pytest.param(ELBOW["radius_m"], marks=pytest.mark.long)])
def test_a_glued_point_at_the_shoulder_changes_nothing(tmp_path: Path, method: str, radius: float) -> None:
    """Where it touches: at the origin, or on a sphere about it."""
    surface = SLANTED if radius else {**SLANTED, "point_m": [0.0, 0.0, 0.0]}
    point = {**ELBOW, "radius_m": radius}
    touching, free = both(tmp_path, SHOULDER, surface, point=point, to=40.0, method=method, law="bilateral")
    np.testing.assert_allclose(touching["q"], free["q"], rtol=0.0, atol=SAME_MOTION)
    assert not touching["contact_normal_force"].any()
    assert len(about_left_out(touching.summary["warnings"])) == 1


def test_check_warns_of_a_point_that_no_joint_moves(tmp_path: Path) -> None:
    start = dynsim.check(scenario(tmp_path, SHOULDER, SLANTED, point=ELBOW))
    assert len(about_left_out(start.warnings)) == 1
    assert not start.aloft
    moving = dynsim.check(scenario(tmp_path, swing(30.0), CEILING))
    assert not about_left_out(moving.warnings)


def test_a_point_of_a_sliding_body_is_not_left_out_on_a_box(tmp_path: Path) -> None:
    """Random postures see one face of the box only."""
    case = scenario(tmp_path, SHOULDER, SLANTED, point=ELBOW)
    file = tmp_path / "immobile.yaml"
    config = json.loads(file.read_text())
    config["plant"]["chain"] = [{"kind": "prismatic", "axis": "x", "length_m": 0.3, "initial_m": -5.0}]
    config["surfaces"]["wall"] = {"type": "box", "edges_m": [0.1, 0.1, 0.3], "center_m": [40.0, 0.0, 0.0]}
    config["contacts"]["points"]["tip"] = {"body": "link_1", "surface": "wall"}
    del config["controller"]
    file.write_text(json.dumps(config))
    assert case
    assert not about_left_out(dynsim.check(dynsim.load_scenario(str(file))).warnings)


def test_error_of_an_immobile_point_below_its_surface_does_not_offer_another_posture(tmp_path: Path) -> None:
    deep = {**ELBOW, "radius_m": 0.02}
    with raises(ModelError, "contacts.points.tip", "-0.01059 m", "wall") as caught:
        dynsim.check(scenario(tmp_path, SHOULDER, SLANTED, point=deep))
    assert "on_surface" not in str(caught.value)
    with raises(ModelError, "initial.on_surface", "'tip'", "wall", "-0.01059 m"):
        dynsim.check(scenario(tmp_path, SHOULDER, SLANTED, point=deep, initial={"on_surface": ["tip"]}))


@pytest.mark.parametrize(("chain", "surface", "point"), [(SHOULDER, SLANTED, ELBOW), (swing(0.0), CEILING, None)])
def test_equilibrium_puts_no_force_on_an_immobile_point(
    tmp_path: Path, chain: list[dict[str, Any]], surface: dict[str, Any], point: dict[str, Any] | None
) -> None:
    from dynsim.engine.prepare import prepare

    keys = {} if point is None else {"point": point}
    prepared = prepare(scenario(tmp_path, chain, surface, initial={"equilibrium": True}, **keys))
    assert prepared.balance is not None
    assert prepared.balance.normal_forces == {}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("start", "to"), [(-40.0, 40.0), (0.0, 40.0)])
def test_an_arm_swings_through_the_posture_in_which_its_tip_grazes(
    tmp_path: Path, method: str, start: float, to: float
) -> None:
    touching, free = both(tmp_path, swing(start), CEILING, to=to, method=method)
    np.testing.assert_allclose(touching["q"], free["q"], rtol=0.0, atol=SAME_MOTION)
    # Time stepping lists a point at its surface as closed for a step, without a force.
    assert not touching.events or method == "time_stepping"
    carries_nothing(touching, free)


@pytest.mark.parametrize("method", METHODS)
def test_a_point_immobile_at_the_start_does_not_move_the_arm(tmp_path: Path, method: str) -> None:
    """The horizontal link pierces a wall by 6e-12 m, and its mobility is 1e-33: projection threw it by 2e5 rad."""
    wall = {"point_m": [0.3 - 6e-12, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
    touching, free = both(tmp_path, swing(90.0), wall, to=130.0, method=method)
    assert touching["q"][0, 0] == pytest.approx(np.pi / 2.0, abs=1e-12)
    np.testing.assert_allclose(touching["q"], free["q"], rtol=0.0, atol=SAME_MOTION)
    carries_nothing(touching, free)


@pytest.mark.parametrize("method", METHODS)
def test_a_nearly_immobile_point_below_its_surface_does_not_move_the_arm(tmp_path: Path, method: str) -> None:
    """At a depth of 1e-7 m and a lever of 1.6e-7 m a projection would turn the link by 0.6 rad."""
    wall = {"point_m": [0.3 - 1e-7, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
    touching, free = both(tmp_path, swing(90.00003), wall, to=130.0, method=method)
    assert np.degrees(touching["q"][0, 0]) == pytest.approx(90.00003, abs=1e-9)
    np.testing.assert_allclose(touching["q"][-1], free["q"][-1], rtol=0.0, atol=1e-5)


# A second link, folded back onto the first. From there its end comes below the floor if the first joint turns alone,
# and above it if the second one does: the gap has a saddle, at zero.
FOLDED = [
    {"axis": "y", "length_m": 0.3},
    {"axis": "y", "length_m": 0.2, "initial_deg": 180.0},
]
FLOOR = {"point_m": [0.0, 0.0, 0.1], "normal": [0.0, 0.0, 1.0]}


@pytest.mark.parametrize("method", METHODS)
def test_a_point_lands_once_the_arm_has_left_its_singular_posture(tmp_path: Path, method: str) -> None:
    case = scenario(tmp_path, FOLDED, FLOOR, to=10.0, method=method)
    record = dynsim.simulate(case)
    landings = [event for event in record.events if event.kind == "landing"]
    assert len(landings) == 1
    assert len(record.events) <= 3
    assert landings[0].time < 0.02
    # From then on it is held up, by a branch of the gap's saddle: −0.15 q₁² + 0.1 (q₁ + δ₂)² = 0, to second order. The
    # terms of fourth order change the ratio by about q₁² = 0.03.
    first, second = record["q"][-1, 0], record["q"][-1, 1] - np.pi
    assert first > 0.1
    assert (first + second) / first == pytest.approx(np.sqrt(1.5), rel=0.03)
    assert np.abs(record["contact_gap"]).max() < (1e-9 if method in EVENT_DRIVEN else 1e-6)
    # Momentum along the chain: the torques of motors, weight and contact accelerate the joints, from the record alone.
    assert record["contact_normal_force"].min() >= 0.0
    # M v̇ + h + g = τ + Jᵀ f, with v̇ from differences of the record: at 1 kHz they are good to some 1e-5 of the largest
    # torque (h² v⁗/6), once the jolt of the landing has died away.
    model, late = dynsim.build_model(case), np.flatnonzero(record.time > 0.2)[:-1]
    vdot = np.gradient(record["v"], record.time, axis=0)
    for k in late[::10]:
        J = model.point_jacobian("link_2", (0.0, 0.0, 0.2), record["q"][k])
        needed = model.inverse_dynamics(record["q"][k], record["v"][k], vdot[k])
        supplied = record["torque"][k] + J.T @ record["contact_force"][k, 0]
        np.testing.assert_allclose(supplied, needed, rtol=0.0, atol=1e-3 * np.abs(record["torque"]).max())
    assert record.summary["energy_residual_relative"] < LEDGER


@pytest.mark.parametrize("method", METHODS)
def test_an_upright_link_on_a_floor_at_its_end_is_locked(tmp_path: Path, method: str) -> None:
    """Every rotation takes its end into the floor. It lands at 2e-10 m or, of time stepping, within a step."""
    floor = {"point_m": [0.0, 0.0, 0.3], "normal": [0.0, 0.0, 1.0]}
    record = dynsim.simulate(scenario(tmp_path, swing(0.0), floor, to=10.0, method=method))
    # 0.3 (1 − cos q) = 2e-10 at q = 3.7e-5; time stepping goes as deep as its landings do.
    assert np.abs(record["q"]).max() < (4e-5 if method in EVENT_DRIVEN else 1e-3)
    # It creeps to rest, and does not chatter: 200 events a second would.
    assert len(record.events) <= 20
    assert record.summary["energy_residual_relative"] < LEDGER


def test_a_glued_point_in_its_singular_posture_has_no_force(tmp_path: Path) -> None:
    """Rounding decided about the force, 1e15 N, and ended the run as Painlevé's paradox."""
    glued, free = both(tmp_path, FOLDED, FLOOR, law="bilateral", to=0.0)
    np.testing.assert_allclose(glued["q"], free["q"], rtol=0.0, atol=1e-9)
    assert np.abs(glued["contact_normal_force"]).max() < 1.0
    assert glued.summary["energy_residual_relative"] < LEDGER
