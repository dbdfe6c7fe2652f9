"""Friction, restitution and compliance between two moving bodies, against a floor and against closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from verification.test_between import FLOOR, ball, leaning, run

from dynsim import Record, load_scenario, simulate
from dynsim.errors import DynsimError
from dynsim.scenario import build

G = 9.81
HEAVY = {"size_m": [4, 4, 1], "mass_kg": 1e9, "position_m": [0, 0, -0.5]}
BODIES: dict[str, dict[str, Any]] = {
    "sphere": ball(0.5, 0.05, [0, 0, 0.05]),
    "box": {"size_m": [0.2, 0.15, 0.1], "mass_kg": 2.0, "position_m": [0, 0, 0.05]},
    "capsule": {
        "shape": "cylinder",
        "radius_m": 0.03,
        "length_m": 0.2,
        "mass_kg": 0.5,
        "position_m": [0, 0, 0.03],
        "rpy_deg": [0, 90, 0],
    },
}
# Friction, push in weights, height of the fall, and further keys of the contact law.
CASES: dict[str, tuple[float, float, float, dict[str, float]]] = {
    "slides": (0.3, 0.6, 0.0, {}),
    "rests": (0.5, 0.2, 0.0, {}),
    "bounces": (0.2, 0.1, 0.05, {"restitution": 0.6}),
    "deforms": (0.3, 0.4, 0.0, {"stiffness_N_per_m": 1e4, "damping_N_s_per_m": 20.0}),
}
ADAPTIVE = {"rtol": 1e-9, "atol": 1e-11}


def load(body: str, force: np.ndarray | list[float], torque: tuple[float, ...] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    return {"type": "constant", "body": body, "force_N": [float(x) for x in force], "torque_N_m": list(torque)}


def integrator(method: str, step: float = 1e-3) -> dict[str, Any]:
    return {"method": method} | ({"step_s": step} if method == "time_stepping" else ADAPTIVE)


def coordinates(record: Record, body: str) -> np.ndarray:
    return record["q"][:, [label.startswith(f"{body}.") or label == body for label in record.labels["q"]]]


def pressed(tmp_path, body: str, case: str, method: str, acceleration: list[float] | None) -> np.ndarray:
    """Pose over time, (T, 7), of a body that loads press on a floor, or on a heavy body that accelerates with it."""
    friction, push, height, law = CASES[case]
    own = BODIES[body] | {"position_m": np.add(BODIES[body]["position_m"], [0, 0, height]).tolist()}
    common = np.array(acceleration or [0.0] * 3)
    loads = {"own": load("body", own["mass_kg"] * (np.array([push * G, 0.0, -G]) + common))}
    objects, law = {"body": own}, {"law": "unilateral", "friction": friction, **law}
    if acceleration is not None:
        objects["heavy"], law = HEAVY, law | {"between": [{"bodies": ["body", "heavy"]}]}
        loads["heavy"] = load("heavy", HEAVY["mass_kg"] * common)
    record = run(
        tmp_path,
        objects,
        contacts=law,
        loads=loads,
        surfaces={} if acceleration else FLOOR,
        duration_s=0.4,
        integrator=integrator(method),
    )
    pose = coordinates(record, "body").copy()
    if acceleration:
        pose[:, :3] -= coordinates(record, "heavy")[:, :3] - np.array(HEAVY["position_m"])
    return pose


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("body", BODIES)
def test_a_heavy_moving_body_is_a_floor(tmp_path, body, case):
    """Corners of boxes that touch bodies are 1 mm inside; compliant ones tilt less, and touch halfway in between."""
    floor, heavy = (pressed(tmp_path, body, case, "time_stepping", a) for a in (None, [1.0, 0.5, 0.3]))
    assert np.ptp(floor[:, :3], axis=0).max() > (1e-4 if case != "rests" or body == "sphere" else -1.0)
    assert np.abs(heavy[:, :3] - floor[:, :3]).max() < 1e-8
    assert np.abs(heavy[:, 3:] - floor[:, 3:]).max() < (3e-5 if case == "deforms" else 1e-8)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize("case", [case for case in CASES if case != "deforms"])
def test_a_heavy_moving_body_is_a_floor_with_events(tmp_path, case, method):
    floor, heavy = (pressed(tmp_path, "sphere", case, method, a) for a in (None, [1.0, 0.5, 0.3]))
    assert np.ptp(floor[:, 0]) > 1e-2
    assert np.abs(heavy - floor).max() < 1e-7


MU, RIDER, CART = 0.4, 1.0, 4.0


def ridden(tmp_path, acceleration: float, method: str, rider: str, **more: Any) -> tuple[np.ndarray, np.ndarray]:
    """Displacements over time of a rider and of the cart below it, which a force accelerates while both are together.

    A box stands on a surface that the cart carries; a sphere touches the cart as a body.
    """
    cart = {"size_m": [2.0, 0.5, 0.1], "mass_kg": CART, "position_m": [0, 0, -0.05], "slide": {"axis": [1, 0, 0]}}
    own = {"size_m": [0.2, 0.2, 0.04], "mass_kg": RIDER, "position_m": [0, 0, 0.02]}
    record = run(
        tmp_path,
        {"rider": own if rider == "box" else ball(RIDER, 0.05, [0, 0, 0.05]), "cart": cart},
        surfaces={"top": {"type": "plane", "point_m": [0, 0, 0.05], "on": "cart"}} if rider == "box" else {},
        between=[] if rider == "box" else [{"bodies": ["rider", "cart"]}],
        loads={"pull": load("cart", [(CART + RIDER) * acceleration, 0.0, 0.0])},
        weight=True,
        friction=MU,
        duration_s=0.4,
        integrator=integrator(method) | more,
    )
    assert record.summary["energy_residual_relative"] < 1e-7
    return coordinates(record, "rider")[:, 0], coordinates(record, "cart")[:, 0]


@pytest.mark.parametrize("method", ["time_stepping", "dopri5", "radau5"])
@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_rider_sticks_up_to_its_friction(tmp_path, method, share):
    """The anchor of a contact at rest moves with the cart; beyond µ g the rider slips at µ g."""
    a, t = share * MU * G, 0.4
    rider, cart = ridden(tmp_path, a, method, "box")
    if share < 1.0:
        assert np.abs(rider - cart).max() < 1e-9
        assert rider[-1] == pytest.approx(0.5 * a * t**2, rel=1e-6)
    else:
        assert rider[-1] == pytest.approx(0.5 * MU * G * t**2, rel=1e-6)
        assert cart[-1] == pytest.approx(0.5 * ((CART + RIDER) * a - RIDER * MU * G) / CART * t**2, rel=1e-6)


@pytest.mark.parametrize("method", ["time_stepping", "dopri5", "radau5"])
def test_a_sphere_rolls_on_an_accelerated_cart(tmp_path, method):
    """Its acceleration is 2/7 of the acceleration of the cart, which moves two sevenths of the sphere's mass, too."""
    rider, cart = ridden(tmp_path, 2.0, method, "sphere")
    a = (CART + RIDER) * 2.0 / (CART + 2.0 / 7.0 * RIDER)
    assert cart[-1] == pytest.approx(0.5 * a * 0.4**2, rel=1e-6)
    assert rider[-1] == pytest.approx(2.0 / 7.0 * cart[-1], rel=1e-6)


@pytest.mark.parametrize("method", ["time_stepping", "dopri5", "radau5"])
def test_a_rider_on_a_turntable_slips_at_its_friction(tmp_path, method):
    """A small box at radius r sticks until r √(α² + ω⁴) exceeds µ g; its anchor turns with the table.

    Time stepping keeps rates, not positions, of sticking contacts: the box drifts in second order of the step.
    """
    radius, alpha = 0.3, 3.0
    slips = (((MU * G / radius) ** 2 - alpha**2) ** 0.5) ** 0.5 / alpha
    record = run(
        tmp_path,
        {
            "rider": {"size_m": [0.004, 0.004, 0.002], "mass_kg": 1e-3, "position_m": [radius, 0, 0.001]},
            "table": {"size_m": [1.0, 1.0, 0.1], "mass_kg": 10.0, "position_m": [0, 0, -0.05], "hinge": {}},
        },
        surfaces={"top": {"type": "plane", "point_m": [0, 0, 0.05], "on": "table"}},
        between=[],
        loads={"turn": load("table", [0.0] * 3, (0.0, 0.0, 10.0 / 6.0 * alpha))},
        weight=True,
        friction=MU,
        duration_s=1.3 * slips,
        integrator=integrator(method, 5e-4),
    )
    angle = coordinates(record, "table")[:, 0]
    assert angle[-1] == pytest.approx(0.5 * alpha * record.time[-1] ** 2, rel=1e-3)
    turned = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    away = np.linalg.norm(coordinates(record, "rider")[:, :2] - turned, axis=1)
    assert away[record.time < 0.98 * slips].max() < (1e-6 if method == "time_stepping" else 1e-9)
    assert away[record.time > 1.1 * slips].min() > 1e-4


@pytest.mark.parametrize("method", ["time_stepping", "dopri5"])
def test_a_rider_on_a_tilting_table_slips_at_the_angle_of_friction(tmp_path, method):
    """Its tangents turn with the table: it slips at tan φ = µ, and its normal force is the force along the normal."""
    record = run(
        tmp_path,
        {
            "rider": {"size_m": [0.004, 0.004, 0.002], "mass_kg": 1e-3, "position_m": [0, 0, 0.001]},
            "table": {
                "size_m": [1, 1, 0.02],
                "mass_kg": 10.0,
                "position_m": [0, 0, -0.01],
                "hinge": {"axis": [0, 1, 0]},
            },
        },
        surfaces={"top": {"type": "plane", "point_m": [0, 0, 0.01], "on": "table"}},
        between=[],
        loads={"turn": load("table", [0.0] * 3, (0.0, 10.0 / 12.0 * (1.0 + 0.02**2) * 0.5, 0.0))},
        weight=True,
        friction=0.6,
        duration_s=1.6,
        integrator=integrator(method),
    )
    slips = min(event.time for event in record.events if event.kind == "slip_start")
    angle = np.interp(slips, record.time, coordinates(record, "table")[:, 0])
    assert angle == pytest.approx(math.atan(0.6), abs=5e-3)
    normal = np.sum(record["contact_force"] * record["contact_normal"], axis=-1)
    sticks = record.time < slips
    # With time stepping, forces are along the normal at the middle of the step.
    rtol = 1e-3 if method == "time_stepping" else 1e-6
    np.testing.assert_allclose(record["contact_normal_force"][sticks], normal[sticks], rtol=rtol, atol=1e-8)


@pytest.mark.long
@pytest.mark.parametrize("method", ["dopri5", pytest.param("radau5", marks=pytest.mark.slow)])
@pytest.mark.parametrize("rider", ["box", "sphere"])
@pytest.mark.parametrize("share", [0.9, 1.3])
def test_m_star_agrees_between_bodies(tmp_path, method, rider, share):
    """The dense system and the sweeps, for surfaces of bodies and for bodies that touch; a sphere rolls or slips."""
    acceleration = share * MU * G * (3.5 if rider == "sphere" else 1.0)
    sweeps, dense = (
        np.stack(ridden(tmp_path, acceleration, method, rider, solver=solver)) for solver in ("articulated", "m_star")
    )
    assert np.abs(sweeps[:, -1]).min() > 0.05
    assert np.abs(sweeps - dense).max() < 1e-10


@pytest.mark.long
@pytest.mark.parametrize("method", ["dopri5", pytest.param("radau5", marks=pytest.mark.slow)])
def test_m_star_agrees_where_a_ball_falls_on_an_arm(tmp_path, method):
    sweeps, dense = (leaning(method, 0.0, 0.3, tmp_path, solver=solver)["q"] for solver in ("articulated", "m_star"))
    assert np.abs(sweeps - dense).max() < 1e-10


def test_a_disc_is_flat(tmp_path):
    """A ball rests on the face of a short cylinder, for which a capsule would be too thick."""
    disc = {
        "shape": "cylinder",
        "radius_m": 0.06,
        "length_m": 0.01,
        "mass_kg": 1.0,
        "position_m": [0, 0, 0],
        "hinge": {},
    }
    objects = {"disc": disc, "ball": ball(0.5, 0.02, [0.01, 0, 0.025])}
    record = run(tmp_path, objects, weight=True, friction=0.3, duration_s=0.1)
    assert record["contact_normal_force"][-1].sum() == pytest.approx(0.5 * G, rel=1e-9)
    assert coordinates(record, "ball")[-1, 2] == pytest.approx(0.025, abs=1e-9)


def test_a_mobile_base_pushes_a_ball():
    """The ball leaves at the speed of the base, because the base then brakes; a box has too many candidates."""
    path = {"type": "waypoints", "frame": "start", "times_s": [0.1, 2.1], "points_m": [[0, 0], [0.4, 0]]}
    keys = {
        "duration_s": 1.8,
        "controller.base.path": path,
        "objects": {"ball": ball(0.3, 0.06, [0.3, 0, 0.06])},
        "contacts": {"law": "unilateral", "friction": 0.0, "between": [{"bodies": ["base", "ball"]}]},
    }
    record = simulate(load_scenario("mobile_path", None, keys))
    force = record["contact_normal_force"][:, record.labels["contact_normal_force"].index("ball-base")]
    pressed = np.flatnonzero(force > 1e-6)
    assert 0.2 < record.time[pressed[0]] < record.time[pressed[-1]] < 1.5
    assert record["contact_gap"].min() > -1e-6
    speed = record["v"][:, record.labels["v"].index("ball.x")]
    base = np.gradient(record["q"][:, record.labels["q"].index("base.x")], record.time)
    assert speed[-1] == pytest.approx(speed[pressed[-1] + 1], abs=1e-6)
    assert speed[-1] == pytest.approx(base.max(), rel=0.02)
    assert record.summary["energy_residual_relative"] < 1e-8
    box = {"size_m": [0.1, 0.1, 0.1], "mass_kg": 0.3, "position_m": [0.5, 0, 0.05]}
    alone = keys["contacts"] | {"between": [{"bodies": ["links", "objects"]}]}
    touching = build.contacts(load_scenario("mobile_path", None, keys | {"contacts": alone}))
    links = {contact.surface.carrier for contact in touching if contact.is_between_bodies}
    assert links == {f"link_{k}" for k in range(2, 11)}
    with pytest.raises(DynsimError, match=r"28 candidates .* use spheres"):
        simulate(load_scenario("mobile_path", None, keys | {"objects": {"ball": box}}))
