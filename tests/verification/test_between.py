"""Bodies that touch each other, against closed forms, conservation laws and independent methods."""

from __future__ import annotations

import math
import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.random_bodies import Motions, in_motion

from dynsim import Record, load_scenario, simulate
from dynsim.errors import DynsimError
from dynsim.record.quaternion import rotated
from dynsim.scenario import Scenario
from dynsim.scenario.schema import SceneObject

POST = {
    "type": "serial_arm",
    "chain": [{"axis": "y", "length_m": 0.1, "mass_kg": 0.1}],
    "base": {"position_m": [0, 0, 9]},
}
FLOOR = {"floor": {"type": "plane"}}


def run(
    tmp_path,
    objects: dict[str, Any],
    *,
    between: list | None = None,
    weight: bool = False,
    motions: Motions | None = None,
    **more: Any,
) -> Record:
    """A run of time stepping, or by the method of ``integrator``; without weight unless asked for."""
    law = {"law": "unilateral", "friction": more.pop("friction", 0.0), "restitution": more.pop("restitution", 0.0)}
    entries = [{"bodies": ["objects", "objects"]}] if between is None else between
    scenario = {
        "plant": POST | ({} if weight else {"gravity_m_s2": [0, 0, 0]}) | more.pop("plant", {}),
        "objects": objects,
        "contacts": law | {"between": entries},
        "integrator": {"method": "time_stepping", "step_s": more.pop("step", 1e-3)},
    } | more
    if motions is not None:
        simulation = in_motion(scenario, motions)
        simulation.advance(scenario["duration_s"])
        return simulation.record()
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scenario), encoding="utf-8")
    return simulate(load_scenario(tmp_path / "scene.yaml"))


def ball(mass: float, radius: float, position: list[float]) -> dict[str, Any]:
    return {"shape": "sphere", "mass_kg": mass, "radius_m": radius, "position_m": position}


def bar(mass: float, radius: float, length: float, position: list[float], yaw: float = 0.0) -> dict[str, Any]:
    """Return a capsule that lies along x, turned by ``yaw`` [deg]."""
    body = {"shape": "cylinder", "mass_kg": mass, "radius_m": radius, "length_m": length, "position_m": position}
    return body | {"rpy_deg": [0, 90, yaw]}


def forces(record: Record, body: str, other: str) -> np.ndarray:
    """Normal forces between two bodies at the end that are not zero, in ascending order [N]."""
    pairs = (f"{body}-{other}", f"{other}-{body}")
    chosen = [name.startswith(pairs) for name in record.labels["contact_normal_force"]]
    values = np.sort(record["contact_normal_force"][-1, chosen])
    return values[values > 0.0]


def pushed(body: str, force: list[float], duration: float = 0.1) -> dict[str, Any]:
    """A constant force on the centre of a body until a time."""
    times = [0.0, duration, duration + 1e-3, 10.0]
    return {
        "type": "samples",
        "interpolation": "linear",
        "body": body,
        "times_s": times,
        "force_N": [force, force, [0] * 3, [0] * 3],
    }


def rates(record: Record, body: str) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular velocity of a free object in the end, in the world and in the body."""
    columns = [k for k, label in enumerate(record.labels["v"]) if label.startswith(f"{body}.")]
    v = record["v"][-1, columns]
    return v[:3], v[3:6]


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_two_spheres_head_on(tmp_path, restitution):
    record = run(
        tmp_path,
        {"a": ball(1.0, 0.05, [0, 0, 0]), "b": ball(2.0, 0.07, [0.3, 0, 0])},
        loads={"push": pushed("a", [10.0, 0.0, 0.0])},
        restitution=restitution,
        duration_s=0.6,
    )
    a, b = rates(record, "a")[0], rates(record, "b")[0]
    before = a[0] + 2.0 * b[0]
    assert before == pytest.approx(1.005, abs=1e-6)
    # Without restitution, the removal of the penetration leaves a speed that remains if no force presses.
    error = 0.03 if restitution == 0.0 else 1e-12
    assert a[0] == pytest.approx(before * (1.0 - 2.0 * restitution) / 3.0, abs=error)
    assert b[0] == pytest.approx(before * (1.0 + restitution) / 3.0, abs=error)
    assert record.summary["energy_residual_relative"] < 1e-12


def after_impact(mass, radius, normal, v, spin, restitution, friction):
    """Velocities and spins after the impact of two solid spheres, with the normal from the second to the first."""
    m, r, n = np.array(mass), np.array(radius), np.array(normal)
    arm = [-r[0] * n, r[1] * n]
    u = v[0] + np.cross(spin[0], arm[0]) - v[1] - np.cross(spin[1], arm[1])
    un, ut = u @ n, u - (u @ n) * n
    reduced = 1.0 / (1.0 / m).sum()
    pressed = -(1.0 + restitution) * reduced * un
    stopping = -2.0 / 7.0 * reduced * ut  # 1/m_t = Σ (1/m + r²/I) = 7/2 Σ 1/m
    size = np.linalg.norm(stopping)
    tangential = stopping * min(1.0, friction * pressed / size)
    impulse = pressed * n + tangential
    ends = [(v[k] + s * impulse / m[k], spin[k] + s * np.cross(arm[k], impulse) / (0.4 * m[k] * r[k] ** 2))
            for k, s in enumerate((1.0, -1.0))]  # fmt: skip
    return np.array(ends), size > friction * pressed


@pytest.mark.parametrize(
    ("friction", "restitution", "slides"), [(0.05, 0.6, True), (0.05, 0.0, True), (0.6, 0.6, False), (0.6, 0.0, False)]
)
def test_spheres_off_centre_with_spins(tmp_path, friction, restitution, slides):
    """Events locate the impact; steps meet it up to a step too late, so that the normal is turned by h v/(r₁ + r₂)."""
    mass, radius, offset, speed = [1.0, 2.0], [0.05, 0.07], 0.05, 1.0
    reach = sum(radius)
    normal = [-math.sqrt(1.0 - (offset / reach) ** 2), offset / reach, 0.0]
    v, spin = np.array([[speed, 0, 0], [0, 0, 0]]), np.array([[1.0, 2.0, -3.0], [-2.0, 1.0, 4.0]])
    exact, slid = after_impact(mass, radius, normal, v, spin, restitution, friction)
    assert slid == slides
    objects = {"a": ball(mass[0], radius[0], [-0.2, offset, 0]), "b": ball(mass[1], radius[1], [0, 0, 0])}
    motions = {"a": (v[0], spin[0]), "b": (v[1], spin[1])}

    def error(**more: Any) -> tuple[float, float]:
        record = run(
            tmp_path, objects, motions=motions, friction=friction, restitution=restitution, duration_s=0.2, **more
        )
        ends = []
        for body in "ab":
            velocity, spin_in_body = rates(record, body)
            q = record["q"][-1, [label.startswith(f"{body}.") for label in record.labels["q"]]]
            ends.append((velocity, rotated(q[3:7] / np.linalg.norm(q[3:7]), spin_in_body)))
        off = np.array(ends) - exact
        return float(np.abs(off[:, 0]).max()), float(np.abs(off[:, 1] * np.array(radius)[:, None]).max())

    assert max(error(integrator={"method": "dopri5", "rtol": 1e-10, "atol": 1e-12})) < 1e-8
    for step in (2e-3, 1e-3, 5e-4, 2.5e-4):
        # With e = 0, the penetration is undone slowly, and the bodies separate at up to the speed of this motion.
        assert max(error(step=step)) < 4.0 * step * speed**2 / reach + (0.03 if restitution == 0.0 else 0.0)


@pytest.mark.parametrize("gap", [2e-3, 0.0])
def test_cradles(tmp_path, gap):
    """A pulse passes pair by pair if gaps exceed h v; simultaneous contacts follow Newton's law for all of them."""
    objects = {f"b{k}": ball(1.0, 0.05, [k * (0.1 + gap) - (k == 0) * 0.05, 0, 0]) for k in range(5)}
    motions = {f"b{k}": ([1.0 if k == 0 else 0.0, 0, 0], [0, 0, 0]) for k in range(5)}
    record = run(tmp_path, objects, motions=motions, restitution=1.0, duration_s=0.2)
    speeds = [rates(record, f"b{k}")[0][0] for k in range(5)]
    # All four normals leave as fast as they approached: only the first one did.
    expected = [0, 0, 0, 0, 1] if gap else [-0.6, 0.4, 0.4, 0.4, 0.4]
    assert speeds == pytest.approx(expected, abs=1e-12)
    assert np.abs(record["energy_residual"]).max() < 1e-15


def test_capsules_along_and_across_capsules_at_rest(tmp_path):
    g, r = 9.81, 0.03
    objects = {
        "a": bar(2.0, r, 0.5, [0, 0, r]),
        "b": bar(1.0, r, 0.3, [0.1, 0, 3 * r]),  # along a, both ends above it
        "c": bar(2.0, r, 0.5, [0, 1, r]),
        "d": bar(1.0, r, 0.4, [0.15, 1, 3 * r]),  # along c, one end beyond it
        "e": bar(2.0, r, 0.5, [0, 2, r]),
        "f": bar(1.0, r, 0.4, [0.1, 2, 3 * r], 60.0),  # across e
    }
    record = run(tmp_path, objects, surfaces=FLOOR, weight=True, friction=0.5, duration_s=0.1)
    assert forces(record, "a", "b") == pytest.approx([0.5 * g, 0.5 * g], rel=1e-9)
    # The axis of c ends at 0.22, that of d begins at −0.02: 0.07 and 0.17 m from the centre of d.
    assert forces(record, "c", "d") == pytest.approx([0.07 / 0.24 * g, 0.17 / 0.24 * g], rel=1e-9)
    assert forces(record, "e", "f") == pytest.approx([g], rel=1e-9)
    assert np.abs(record["v"][-1]).max() < 1e-9


def test_boxes_touch_at_the_corners_of_their_overlap(tmp_path):
    """Corners of either box, or places where edges cross; the weight is above the middle of the overlap."""
    g, size = 9.81, [0.2, 0.2, 0.1]
    objects = {
        "a": {"size_m": size, "mass_kg": 2, "position_m": [0, 0, 0.05]},
        "b": {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1, "position_m": [0.02, 0.01, 0.15]},
        "c": {"size_m": [0.3, 0.1, 0.1], "mass_kg": 2, "position_m": [0, 1, 0.05]},
        "d": {"size_m": [0.1, 0.3, 0.1], "mass_kg": 1, "position_m": [0, 1, 0.15]},  # a cross
        "e": {"size_m": size, "mass_kg": 2, "position_m": [0, 2, 0.05]},
        "f": {"size_m": size, "mass_kg": 1, "position_m": [0.05, 2.05, 0.15]},  # over one corner
        "h": {"size_m": size, "mass_kg": 2, "position_m": [0, 3, 0.05]},
        "i": bar(1.0, 0.03, 0.5, [0, 3, 0.13]),  # over two edges
    }
    record = run(tmp_path, objects, surfaces=FLOOR, weight=True, friction=0.5, duration_s=0.3)
    for pair in ("ab", "cd"):
        assert forces(record, *pair) == pytest.approx([0.25 * g] * 4, rel=1e-5)
    # The force of least norm: its line of action is through the centre of f, 23 mm from the middle of the overlap.
    assert len(forces(record, "e", "f")) == 4
    assert forces(record, "e", "f").sum() == pytest.approx(g, rel=1e-6)
    assert forces(record, "h", "i") == pytest.approx([0.5 * g] * 2, rel=1e-6)
    on_floor = [name.startswith("a") and name.endswith("floor") for name in record.labels["contact_normal_force"]]
    assert record["contact_normal_force"][-1, on_floor].sum() == pytest.approx(3.0 * g, rel=1e-6)
    assert np.abs(record["v"][-1]).max() < 1e-9


def test_stacks_carry_their_weight(tmp_path):
    g = 9.81
    record = run(
        tmp_path,
        {
            "a": ball(1.0, 0.05, [0, 0, 0.05]),
            "b": ball(2.0, 0.05, [0, 0, 0.15]),
            "c": {"size_m": [0.2, 0.2, 0.1], "mass_kg": 2, "position_m": [1.0, 0, 0.05]},
            "d": {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1, "position_m": [1.02, 0, 0.15]},
        },
        surfaces=FLOOR,
        weight=True,
        friction=0.5,
        duration_s=0.3,
    )
    force = dict(zip(record.labels["contact_normal_force"], record["contact_normal_force"][-1], strict=True))
    assert force["a.floor"] == pytest.approx(3.0 * g, rel=1e-9)
    assert force["a-b"] == pytest.approx(2.0 * g, rel=1e-9)
    assert sum(f for name, f in force.items() if name.startswith("c") and name.endswith("floor")) == pytest.approx(
        3.0 * g, rel=1e-6
    )
    assert sum(f for name, f in force.items() if name.startswith(("d-c", "c-d"))) == pytest.approx(g, rel=1e-6)
    assert np.abs(record["v"][-1]).max() < 1e-9


THREE = {
    "a": ball(1.0, 0.05, [0, 0, 0]),
    "b": {"shape": "cylinder", "radius_m": 0.03, "length_m": 0.2, "mass_kg": 0.5, "position_m": [0.2, 0.02, 0.03]},
    "c": {"size_m": [0.1, 0.2, 0.15], "mass_kg": 2, "position_m": [0.4, -0.03, 0.0], "rpy_deg": [10, 20, 30]},
}
BALLS = {
    "a": ball(1.0, 0.05, [0, 0, 0]),
    "b": ball(0.5, 0.05, [0.2, 0.02, 0.03]),
    "c": ball(2.0, 0.06, [0.4, -0.03, 0]),
}


@pytest.mark.parametrize("objects", [BALLS, THREE], ids=["spheres", "solids"])
def test_momentum_and_angular_momentum_of_a_free_scene(tmp_path, objects):
    """Oblique impacts with friction and restitution."""
    record = run(
        tmp_path,
        objects,
        loads={"push": pushed("a", [20.0, 1.0, 0.5], 0.05)},
        friction=0.4,
        restitution=0.6,
        duration_s=0.6,
        record={"rate_hz": 1000},
    )
    masses = {name: body["mass_kg"] for name, body in objects.items()}
    inertias = {name: SceneObject.model_validate(body).inertia.tensor for name, body in objects.items()}
    momentum, spin = np.zeros((2, len(record), 3))
    for name, mass in masses.items():
        q, v = (record[kind][:, [x.startswith(f"{name}.") for x in record.labels[kind]]] for kind in ("q", "v"))
        position, attitude, velocity = q[:, :3], q[:, 3:7] / np.linalg.norm(q[:, 3:7], axis=1)[:, None], v[:, :3]
        own = rotated(attitude.T, (v[:, 3:6] @ inertias[name]).T).T
        momentum += mass * velocity
        spin += np.cross(position, mass * velocity) + own
    after = record.time > 0.06
    assert record["contact_normal_force"].max() > 1.0
    assert np.ptp(momentum[after], axis=0).max() < 1e-12
    assert np.ptp(spin[after], axis=0).max() < 1e-12
    assert record.summary["energy_residual_relative"] < 1e-12


# Directions along a capsule link that leans, and normal to its upper side.
ALONG, ABOVE = np.array([-math.sqrt(0.75), 0.0, 0.5]), np.array([0.5, 0.0, math.sqrt(0.75)])


def leaning(method: str, step: float, friction: float, tmp_path, gap=0.0215, solver="articulated") -> Record:
    """A sphere that falls on a capsule from this distance, and slides down on it while the capsule sinks."""
    start = [0.0, 0.0, 1.0] + 0.34 * ALONG + (0.07 + gap) * ABOVE
    integrator = {"method": method} | (
        {"step_s": step} if method == "time_stepping" else {"rtol": 1e-10, "atol": 1e-12}
    )
    return run(
        tmp_path,
        {"ball": ball(0.2, 0.04, start.tolist())},
        plant={
            "chain": [
                {
                    "axis": "y",
                    "initial_deg": -60,
                    "length_m": 0.6,
                    "mass_kg": 1.0,
                    "radius_m": 0.03,
                    "damping_N_m_s_per_rad": 4.0,
                }
            ],
            "base": {"position_m": [0, 0, 1]},
        },
        between=[{"bodies": ["ball", "links"]}],
        weight=True,
        friction=friction,
        duration_s=0.3,
        integrator=integrator | {"solver": solver},
    )


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_sphere_that_falls_on_a_moving_capsule(tmp_path, friction):
    """Friction acts on both moving bodies; two event-driven methods agree, and time stepping converges to them."""
    exact, other = (leaning(method, 0.0, friction, tmp_path) for method in ("dopri5", "radau5"))
    assert np.abs(exact["q"][-1] - other["q"][-1]).max() < 1e-7
    errors = [
        float(np.abs(leaning("time_stepping", step, friction, tmp_path)["q"][-1] - exact["q"][-1]).max())
        for step in (2e-3, 1e-3, 5e-4, 2.5e-4)
    ]
    assert errors[0] < 1e-2
    assert math.log2(errors[0] / errors[-1]) > 2.0


# Steps that divide 0.25 s, each a quarter of the one before.
QUARTERS = (2e-3, 5e-4, 1.25e-4)


@pytest.mark.parametrize(
    ("gaps", "order"),
    [([0.0], 2.0), ([0.02, 0.0203, 0.0206, 0.0209], 1.0)],
    ids=["from contact", "with a landing"],
)
def test_steps_are_of_second_order_between_events_and_of_first_at_landings(tmp_path, gaps, order):
    """Mean over some landings, because the error depends on when within a step the sphere lands."""
    errors = np.zeros(len(QUARTERS))
    for gap in gaps:
        exact = leaning("dopri5", 0.0, 0.3, tmp_path, gap)
        k = int(np.argmin(np.abs(exact.time - 0.25)))
        ends = [leaning("time_stepping", step, 0.3, tmp_path, gap)["q"][k] for step in QUARTERS]
        errors += np.abs(np.array(ends) - exact["q"][k]).max(axis=1)
    slope = np.polyfit(np.arange(len(errors)), -np.log2(errors), 1)[0] / 2.0
    assert slope == pytest.approx(order, abs=0.25)


def test_an_arm_lies_on_its_own_first_link(tmp_path):
    """Friction keeps the first two joints at rest; the moment about the third one gives the force on the tip."""

    def link(angle: float, length: float, mass: float, **joint: float) -> dict[str, Any]:
        body = {"axis": "y", "initial_deg": angle, "length_m": length, "mass_kg": mass, "radius_m": 0.02}
        return body | joint

    chain = [
        link(90, 0.6, 1.0, friction_N_m=50.0),
        link(-120, 0.3, 0.5, friction_N_m=50.0),
        link(-60, 0.3, 0.5, damping_N_m_s_per_rad=0.1),
    ]
    plant = {"chain": chain, "base": {"position_m": [0, 0, 1]}}
    record = run(tmp_path, {}, plant=plant, between=[{"bodies": "self"}], weight=True, duration_s=1.5)
    # Angles of links 1 and 3 from the vertical; the landing has turned joint 1 by 1.4°.
    first, third = record["q"][-1, 0], record["q"][-1].sum()
    lift = 0.5 * 0.5 * 9.81 * abs(math.sin(third) / math.cos(third - first))
    assert forces(record, "link_1", "link_3") == pytest.approx([lift], rel=1e-6)
    assert record["contact_gap"].min() > -2e-3
    assert abs(record["contact_gap"][-1].min()) < 1e-4
    assert np.abs(record["v"][-1]).max() < 1e-9
    assert record.summary["energy_residual_relative"] < 1e-12


def test_neighbours_and_ignored_pairs_do_not_touch(tmp_path):
    plant = {"chain": [{"axis": "y", "count": 4, "length_m": 0.2, "mass_kg": 0.2, "radius_m": 0.02}]}
    record = run(
        tmp_path, {}, plant=plant, between=[{"bodies": "self", "ignore": [["link_1", "link_3"]]}], duration_s=0.01
    )
    pairs = {tuple(sorted(name.split("_")[1:2])) for name in record.labels["contact_gap"]}
    assert pairs
    text = " ".join(record.labels["contact_gap"])
    assert "link_1-link_4" in text or "link_4-link_1" in text
    assert "link_1-link_3" not in text
    assert "link_1-link_2" not in text


@pytest.mark.parametrize(
    ("between", "text"),
    [
        ([{"bodies": ["a", "x"]}], "unknown body 'x'"),
        ([{"bodies": ["a"]}], "two bodies"),
        ([{"bodies": ["a", "table"]}], "'table' is a surface, not a body"),
    ],
)
def test_wrong_pairs_are_errors(tmp_path, between, text):
    surfaces = {"table": {"type": "plane", "point_m": [0, 0, -1]}}
    with pytest.raises(DynsimError, match=text):
        run(tmp_path, {"a": ball(1.0, 0.05, [0, 0, 0])}, between=between, duration_s=0.01, surfaces=surfaces)


def test_overlap_at_the_start_is_an_error(tmp_path):
    objects = {"a": ball(1.0, 0.05, [0, 0, 0]), "b": ball(1.0, 0.05, [0.08, 0, 0])}
    with pytest.raises(DynsimError, match=r"a and b overlap by 0\.02 m .*move a"):
        run(tmp_path, objects, duration_s=0.01)


BOX = {"size_m": [0.1, 0.12, 0.14], "mass_kg": 1}
ROD = {"shape": "cylinder", "radius_m": 0.03, "length_m": 0.3, "mass_kg": 1}


@pytest.mark.parametrize(
    ("other", "depth"),
    [
        (BOX | {"position_m": [0.05, 0.0, 0.0]}, 0.05),
        (BOX | {"position_m": [0.06, 0.01, 0.02]}, 0.04),
        (BOX | {"position_m": [0.02, 0.03, 0.05], "rpy_deg": [20, 30, 40]}, None),
        (BOX | {"position_m": [0.06, 0.08, 0.0], "rpy_deg": [45, 0, 45]}, None),
        (ROD | {"position_m": [0.01, 0.02, 0.0], "rpy_deg": [90, 0, 0]}, 0.07),
        (ROD | {"position_m": [0.0, 0.03, 0.08], "rpy_deg": [70, 20, 0]}, None),
        (ball(1.0, 0.05, [0.02, 0.01, 0.0]), 0.08),
        (ball(1.0, 0.05, [0.07, 0.08, 0.0]), None),
    ],
)
def test_overlap_ends_after_the_advised_move(tmp_path, other, depth):
    """The depth is the length of the move; moves that are 1 % shorter leave an overlap."""
    start, objects = np.array([0.3, 0.2, 0.1]), {"b": other, "a": BOX | {"position_m": [0, 0, 0]}}

    def error(position: Any) -> str:
        objects["a"]["position_m"] = [float(value) for value in position]
        objects["b"] = other | {"position_m": (start + other["position_m"]).tolist()}
        try:
            run(tmp_path, objects, duration_s=0.002, integrator={"method": "time_stepping"})
        except DynsimError as failure:
            return str(failure)
        return ""

    message = re.search(r"overlap by (\S+) m .* move (\w) by \((.*)\) m", error(start))
    assert message
    by = np.array([float(part) for part in message[3].split(",")]) * (1.0 if message[2] == "a" else -1.0)
    stated = float(message[1])
    assert depth is None or stated == pytest.approx(depth, abs=1e-5)
    assert np.linalg.norm(by) == pytest.approx(stated, abs=1e-4)
    assert error(start + by) == ""
    assert "overlap by" in error(start + 0.99 * by)


def test_object_inside_a_surface_is_an_error_about_its_position(tmp_path):
    box = {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1, "position_m": [0, 0, 0.049]}
    with pytest.raises(DynsimError, match=r"objects\.box\.position_m: box starts 0\.001 m inside surface 'table'"):
        run(tmp_path, {"box": box}, duration_s=0.01, surfaces={"table": {"type": "plane"}})


def test_many_pairs_need_time_stepping(tmp_path):
    boxes = {f"b{k}": {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1, "position_m": [0.2 * k, 0, 0]} for k in range(2)}
    with pytest.raises(DynsimError, match=r"28 candidates .* time_stepping"):
        run(tmp_path, boxes, duration_s=0.01, integrator={"method": "dopri5"})


def folded(tmp_path, links: int) -> Scenario:
    """An arm whose links, in a zigzag, can all touch each other."""
    chain = [{"axis": "y", "count": links, "length_m": 0.2, "mass_kg": 0.2, "radius_m": 0.02}]
    plant = {"type": "serial_arm", "chain": chain, "initial_deg": [10, -10] * (links // 2)}
    scenario = {"duration_s": 0.01, "plant": plant, "integrator": {"method": "time_stepping"}}
    scenario["contacts"] = {"law": "unilateral", "between": [{"bodies": "self"}]}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(scenario), encoding="utf-8")
    return load_scenario(tmp_path / "arm.yaml")


def test_pairs_of_thirty_links_are_prepared_quickly(tmp_path):
    resource = pytest.importorskip("resource")
    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    record = simulate(folded(tmp_path, 30))
    assert time.process_time() - started < 3.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 5e5  # KB
    assert len(record.labels["contact_normal_force"]) == 4 * (30 * 29 // 2 - 29)


@pytest.mark.skipif(sys.platform != "linux", reason="limits of the address space")
def test_scratch_of_too_many_pairs_is_an_error(tmp_path):
    import resource

    scenario, limits = folded(tmp_path, 30), resource.getrlimit(resource.RLIMIT_AS)
    used = resource.getpagesize() * int(Path("/proc/self/statm").read_text().split()[0])
    try:
        resource.setrlimit(resource.RLIMIT_AS, (used + 3 * 10**9, limits[1]))
        with pytest.raises(DynsimError, match=r"arm\.yaml.*1624 contact candidates need 3\.8 GB .*fewer pairs"):
            simulate(scenario)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def test_bilateral_law_is_refused(tmp_path):
    with pytest.raises(DynsimError, match=r"contacts\.between.*unilateral"):
        run(
            tmp_path,
            BALLS,
            duration_s=0.01,
            contacts={"law": "bilateral", "between": [{"bodies": ["a", "b"]}]},
            integrator={"method": "dopri5"},
        )


def test_a_sphere_on_the_corner_of_a_box_is_one_contact(tmp_path):
    """The distance of the sphere covers corners; another contact there would double the stiffness."""
    box = {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1.0, "position_m": [0, 0, 0]}
    upright = {"rpy_deg": [45.0, -math.degrees(math.atan(math.sqrt(0.5))), 0.0]}
    record = run(tmp_path, {"box": box | upright, "ball": ball(1.0, 0.05, [0, 0, 0.2])}, duration_s=0.002)
    assert record.labels["contact_normal_force"] == ("ball-box",)
    assert record["contact_gap"][0, 0] == pytest.approx(0.15 - 0.001 - math.sqrt(3.0) * 0.049, abs=1e-12)


def test_names_of_groups_are_refused_for_bodies(tmp_path):
    with pytest.raises(DynsimError, match="'links' is a group and a body"):
        run(tmp_path, {"links": ball(1.0, 0.05, [0, 0, 0]), "b": ball(1.0, 0.05, [0, 0, 1])}, duration_s=0.002)


def test_entries_and_ignored_pairs_without_effect_are_listed(tmp_path):
    objects = {"a": ball(1.0, 0.05, [0, 0, 0]), "b": ball(1.0, 0.05, [0, 0, 1])}
    pair = {"bodies": ["a", "b"]}
    between = [{"bodies": ["a", "a"]}, pair | {"ignore": [["b", "a"]]}, pair | {"ignore": [["link_1", "b"]]}, pair]
    warnings = run(tmp_path, objects, between=between, duration_s=0.002).summary["warnings"]
    listed = [text.partition(" (")[0] for text in warnings if text.startswith("contacts.between")]
    nothing = "no pair remains without neighbours on joints and `ignore`"
    assert listed == [
        f"contacts.between.0 has no effect: {nothing}",
        f"contacts.between.1 has no effect: {nothing}",
        "contacts.between.2.ignore has no effect: the entry does not contain link_1-b",
    ]


def test_further_contacts_of_a_pair_cannot_determine_the_start(tmp_path):
    boxes, entries = {"a": cube([0, 0, 0]), "b": cube([0, 0, 0.2])}, [{"bodies": ["b", "a"]}]
    with pytest.raises(DynsimError, match="'b-a_2' is a further contact of a pair; use 'b-a'"):
        run(tmp_path, boxes, between=entries, initial={"on_surface": ["b-a_2"]}, duration_s=0.002)


def cube(position: list[float], **more: Any) -> dict[str, Any]:
    return {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1.0, "position_m": position} | more


def pressed(tmp_path, upper: dict[str, Any], lower: dict[str, Any], stiffness: float, direction: list[float]) -> Record:
    """A body on rails that 10 N press on a fixed one."""
    rails = {"slide": {"axis": direction, "damping_N_s_per_m": 60.0}}
    fixed = {"slide": {"axis": [0, 1, 0], "friction_N": 1000.0}}
    between = [{"bodies": ["a", "b"], "stiffness_N_per_m": stiffness}]
    force = {"p": {"type": "constant", "body": "a", "force_N": [-10.0 * x for x in direction]}}
    return run(tmp_path, {"a": upper | rails, "b": lower | fixed}, between=between, loads=force, duration_s=0.3)


DIAGONAL = [3.0**-0.5] * 3
UPRIGHT = {"rpy_deg": [45.0, 35.26439, 0.0]}
CORNERS = cube([0.098 + 0.0021 * 3.0**-0.5] * 3), cube([0, 0, 0]), DIAGONAL
EDGES = (
    cube([0, 0, 0.1407], rpy_deg=[45, 0, 0]),
    cube([0, 0, 0], rpy_deg=[0, 45, 0]),
    [0.0, 0.0, 1.0],
)
FACES = cube([0.01, 0.02, 0.1001]), cube([0, 0, 0]), [0.0, 0.0, 1.0]
CORNER_ON_FACE = cube([0.01, 0.02, 0.136]) | UPRIGHT, cube([0, 0, 0]), [0.0, 0.0, 1.0]
BALL_ON_EDGE = (
    ball(1.0, 0.05, [0.049 + 0.0511 * 2.0**-0.5, 0, 0.049 + 0.0511 * 2.0**-0.5]),
    cube([0, 0, 0]),
    [2.0**-0.5, 0.0, 2.0**-0.5],
)


@pytest.mark.parametrize(
    ("scene", "stiffness", "warned"),
    [
        (CORNERS, 1000.0, True),
        (CORNERS, 10_000.0, False),
        (EDGES, 1000.0, True),
        (EDGES, 10_000.0, False),
        (FACES, 300.0, False),
        (CORNER_ON_FACE, 1000.0, False),
        (BALL_ON_EDGE, 1000.0, False),
    ],
)
def test_edges_compressed_beyond_their_rounding_are_reported(tmp_path, scene, stiffness, warned):
    """Only the normals of edges and corners depend on the rounding; a ball keeps its normal."""
    upper, lower, direction = scene
    warnings = pressed(tmp_path, upper, lower, stiffness, direction).summary["warnings"]
    assert any("rounding of the edges (2 mm)" in text for text in warnings) == warned
    assert not warned or not any(text.startswith("time stepping") and "integrator.step_s" in text for text in warnings)


@pytest.mark.parametrize(("shift", "warned"), [(0.049, True), (0.0, False)])
def test_points_pressed_into_an_edge_of_the_world_are_reported(tmp_path, shift, warned):
    """10 mm deep, at the edge and on the face of a box that stands in the world."""
    slope = [2.0**-0.5 if warned else 0.0, 0.0, 2.0**-0.5 if warned else 1.0]
    rails = {"axis": slope, "damping_N_s_per_m": 60.0}
    block = {"type": "box", "center_m": [0, 0, 0], "edges_m": [0.1, 0.1, 0.1], "edge_radius_m": 0.001}
    record = run(
        tmp_path,
        {"a": cube([shift + 0.001 * slope[0], 0, 0.049 + 0.001 * slope[2]], slide=rails)},
        surfaces={"block": block},
        contacts={
            "law": "unilateral",
            "points": {"p": {"body": "a", "surface": "block", "stiffness_N_per_m": 1000.0}},
        },
        loads={"f": {"type": "constant", "body": "a", "force_N": [-10.0 * x for x in slope]}},
        duration_s=0.5,
    )
    texts = [text for text in record.summary["warnings"] if "rounding of the edges (1 mm)" in text]
    assert len(texts) == warned
    assert record.summary["contacts"][0]["penetration_max_m"] > 5e-3


def test_the_advised_stiffness_conserves_energy(tmp_path):
    objects = {
        "a": cube([0, 0, 0], rpy_deg=[10, 20, 30]),
        "b": {"mass_kg": 2, "size_m": [0.2, 0.1, 0.05], "position_m": [0.3, 0.03, 0.02], "rpy_deg": [5, 0, 40]},
    }
    loads = {"push": pushed("a", [15.0, 0.0, 0.0])}
    between = {"bodies": ["a", "b"], "stiffness_N_per_m": 50_000.0}
    record = run(tmp_path, objects, between=[between], loads=loads, duration_s=0.3)
    (warning,) = [text for text in record.summary["warnings"] if "rounding of the edges" in text]
    assert warning.startswith("a-b: ")
    assert abs(record["energy_kinetic"][-1] / record["work_loads"][-1, 0] - 1.0) > 0.03
    between["stiffness_N_per_m"] = float(warning.rpartition(" ")[2])
    record = run(tmp_path, objects, between=[between], loads=loads, duration_s=0.3, step=2e-5)
    assert record["energy_kinetic"][-1] == pytest.approx(record["work_loads"][-1, 0], rel=1e-3)
    assert not record.summary["warnings"]


def test_bodies_elsewhere_do_not_change_a_rebound(tmp_path):
    """A rod whose restitution would create energy with friction, and a ball that lands 5 m away in the same step."""
    rod = {"shape": "cylinder", "radius_m": 0.02, "length_m": 0.4, "mass_kg": 1, "position_m": [0, 0, 0.12341457]}
    objects = {"rod": rod | {"rpy_deg": [0, 55.5148884, 0]}, "ball": ball(2.0, 0.05, [5, 0, 0.051411036])}
    motions = {"rod": ([-1.3812, 0, -0.060582], [0, -12.493, 0]), "ball": ([0, 0, -1.0], [0, 0, 0])}
    ends = {}
    for names in (["rod", "ball"], ["rod"], ["ball"]):
        record = run(
            tmp_path,
            {name: objects[name] for name in names},
            between=[{"bodies": ["objects", "links"]}],
            motions={name: motions[name] for name in names},
            surfaces={"floor": {"type": "plane"}},
            plant={"chain": [{"axis": "y", "length_m": 0.1, "mass_kg": 0.1, "radius_m": 0.01}]},
            weight=True,
            friction=1.889434,
            restitution=0.961838,
            duration_s=0.01,
        )
        labels = np.array([label.partition(".")[0] for label in record.labels["v"]])
        ends[len(names), names[0]] = record["v"][-1]
        if len(names) == 2:
            both = {name: record["v"][-1][labels == name] for name in names}
    assert both["ball"][2] > 0.8
    np.testing.assert_allclose(both["rod"], ends[1, "rod"][-6:], atol=1e-9)
    np.testing.assert_allclose(both["ball"], ends[1, "ball"][-6:], atol=1e-9)


def test_names_of_contacts_are_unique(tmp_path):
    objects = {"b": cube([0, 0, 0.05]), "b1": ball(1.0, 0.05, [1, 0, 0.05])}
    record = run(tmp_path, objects, surfaces={"floor": {"type": "plane"}}, weight=True, duration_s=0.02)
    labels = record.labels["contact_normal_force"]
    assert len(set(labels)) == len(labels)
    assert record["contact_normal_force"][-1, labels.index("b1.floor_2")] == pytest.approx(9.81, rel=1e-6)


@pytest.mark.parametrize("rate", [60.0, 150.0])
def test_a_slender_rod_spins_with_constant_energy(tmp_path, rate):
    """At 150 rad/s the iteration for the angular momentum diverges, and the midpoint equation is kept."""
    rods = {name: bar(1.0, 0.01, 0.6, [0, y, 0]) for name, y in (("a", 0.0), ("b", 1.0))}
    record = run(tmp_path, rods, motions={"a": ([0, 0, 0], [0, rate, 0])}, duration_s=0.1)
    np.testing.assert_allclose(record["energy_kinetic"], record["energy_kinetic"][0], rtol=1e-9)


PLATE = cube([0, 0.01, 0.01], size_m=[0.004, 0.2, 0.2])


@pytest.mark.parametrize("rate", [200, 3000])
@pytest.mark.parametrize(
    ("bodies", "step", "passes"),
    [
        ((cube([-0.3, 0, 0]), cube([0, 0.01, 0.01])), 1e-3, True),
        ((cube([-0.3, 0, 0]), cube([0, 0.01, 0.01])), 1e-4, False),
        ((cube([-0.3, 0, 0], size_m=[0.01, 0.05, 0.05]), PLATE), 1e-3, True),
        # A cube, and a ball that sinks in by more than the plate is thick, turns the plate and stays on its side.
        ((cube([-0.3, 0, 0]), PLATE), 1e-3, False),
        ((ball(1.0, 0.02, [-0.3, 0, 0]), PLATE), 1e-3, False),
        # Beside each other.
        ((cube([-0.3, 0, 0]), cube([0, 0.105, 0])), 1e-3, False),
    ],
)
def test_bodies_that_pass_through_each_other_are_reported(tmp_path, bodies, step, passes, rate):
    """At 30 m/s; a shorter step finds the contact."""
    more = {"duration_s": 0.03, "step": step, "record": {"rate_hz": rate}}
    record = run(tmp_path, dict(zip("ab", bodies, strict=True)), motions={"a": ([30, 0, 0], [0, 0, 0])}, **more)
    texts = [text for text in record.summary["warnings"] if "pass through each other" in text]
    assert len(texts) == passes
    ahead = record["q"][-1, [record.labels["q"].index(f"{name}.x") for name in "ab"]]
    assert not passes or ahead[0] > ahead[1] + 0.1
    for text in texts:
        assert "30 mm per step" in text


def test_drift_is_the_error_of_event_driven_constraints_only(tmp_path):
    """A ball on a spring: its compression is the depth of the contact, and no drift."""
    objects = {"a": cube([0, 0, 0.05]), "b": ball(1.0, 0.05, [0, 0, 0.15])}
    more = {"surfaces": FLOOR, "weight": True, "duration_s": 0.1}
    soft = run(tmp_path, objects, between=[{"bodies": ["a", "b"], "stiffness_N_per_m": 1e4}], **more).summary
    assert "constraint_drift_max_m" not in soft
    assert soft["time_stepping"]["penetration_max_m"] < 1e-5
    (pair,) = [contact for contact in soft["contacts"] if contact["name"] == "b-a"]
    assert pair["penetration_max_m"] > 1e-3
    rigid = run(tmp_path, objects, integrator={"method": "dopri5"}, **more).summary
    assert rigid["constraint_drift_max_m"] < 1e-9
