"""Recorded contact forces as vectors: they move the bodies in every direction, stay in their cones and oppose slip.

Bodies that are free to move in all directions are the objects, the snake, and arms whose first joints are prismatic,
along x, y and z, without motor and friction. Of these Σ contact forces + loads + weight is the change of Σ m v. In
records of time stepping the force of a sample is the mean of the step that ends there, or in which it lies.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dynsim
from dynsim.compile.model import Model
from dynsim.snake.published import wheel_table

H = 2.5e-4
MU = 0.4
# Step of the point in a bowl [s], and the bowl's radius [m].
H_BOWL, RADIUS = 2e-3, 0.3
PUSH = (2.0, 3.0, 0.0)
SURFACES: dict[str, dict[str, Any]] = {
    "plane": {"type": "plane", "normal": [0.1, -0.05, 1.0]},
    "cylinder": {"type": "cylinder", "point_m": [0.05, -0.02, -0.5], "axis": [0.3, 1.0, 0.0], "radius_m": 0.5},
    "bowl": {"type": "sphere", "center_m": [0.0, 0.05, 0.7], "radius_m": 0.7, "inside": True},
    "heights": {"type": "height_field", "file": "heights.csv", "spacing_m": [0.2, 0.2], "origin_m": [-0.8, -0.8, 0]},
}
TIP = {"body": "link_5", "point_m": [0.02, 0.01, 0.2], "surface": "s"}
CONTACTS: dict[str, dict[str, Any]] = {
    "point": {"points": {"tip": TIP}},
    "sphere": {"points": {"tip": TIP | {"radius_m": 0.03}}},
    "wheel": {"points": {"tip": TIP | {"radius_m": 0.03, "grip": {"axis": [1, 0, 0], "ratio": 0.3}}}},
    "links": {"candidates": "links"},
}
# Height of the carriage from which the tip, or the links, fall by some centimetres [m].
TIP_FALLS = {"plane": -0.06, "cylinder": -0.08, "bowl": 0.06, "heights": 0.0}
LINKS_FALL = {"plane": 0.12, "cylinder": 0.12, "bowl": 0.13, "heights": 0.15}
METHODS = {"time_stepping": {"integrator.method": "time_stepping", "integrator.step_s": H}}
METHODS |= {method: {"integrator.method": method, "integrator.rtol": 1e-9} for method in ("dopri5", "radau5")}


def arm(surface: str, contact: str) -> dict[str, Any]:
    """Two links on a carriage that floats, dropped on a surface and pushed along it."""
    height = (LINKS_FALL if contact == "links" else TIP_FALLS)[surface]
    free = {"kind": "prismatic", "length_m": 0}
    link = {"length_m": 0.2, "radius_m": 0.03}
    chain = [
        free | {"axis": "x", "mass_kg": 0},
        free | {"axis": "y", "mass_kg": 0},
        free | {"axis": "z", "mass_kg": 0.1, "initial_m": height},
        link | {"axis": "y", "mass_kg": 0.5, "initial_deg": 70},
        link | {"axis": "x", "mass_kg": 0.4, "initial_deg": 75, "damping_N_m_s_per_rad": 0.05},
    ]
    return {
        "duration_s": 0.4,
        "plant": {"type": "serial_arm", "chain": chain},
        "surfaces": {"s": SURFACES[surface]},
        "contacts": {"law": "unilateral", "friction": MU, **CONTACTS[contact]},
        "loads": {"push": {"type": "constant", "body": "link_4", "force_N": list(PUSH)}},
    }


def objects(surface: str, soft: bool) -> dict[str, Any]:
    """A box, a ball and a cart on wheels, dropped on a surface and pushed along it, next to an arm."""
    wheel = {"radius_m": 0.05, "mass_kg": 0.4}
    wheels = {
        "left": wheel | {"position_m": [0, 0.15, -0.02]},
        "right": wheel | {"position_m": [0, -0.15, -0.02]},
        "rear": wheel | {"position_m": [-0.2, 0, -0.02], "friction_N_m": 0.002},
    }
    size = [0.06, 0.08, 0.06]
    gives = {"stiffness_N_per_m": 1e5, "damping_N_s_per_m": 200} if soft else {}
    return {
        "duration_s": 0.5,
        "plant": {
            "type": "serial_arm",
            "base": {"position_m": [0, 0, 2]},
            "chain": [{"axis": "y", "length_m": 0.1, "mass_kg": 0.1}],
        },
        "objects": {
            "box": {"mass_kg": 0.3, "size_m": size, "position_m": [0.4, 0, 0.2], "rpy_deg": [3, 5, 20]},
            "ball": {"mass_kg": 0.5, "shape": "sphere", "radius_m": 0.05, "position_m": [-0.3, 0.1, 0.2]},
            "cart": {"mass_kg": 2, "size_m": [0.5, 0.2, 0.04], "position_m": [0, 0.2, 0.25], "wheels": wheels},
        },
        "surfaces": {"s": SURFACES[surface]},
        "contacts": {"law": "unilateral", "friction": MU, **gives},
        "loads": {name: {"type": "constant", "body": name, "force_N": list(PUSH)} for name in ("box", "ball", "cart")},
    }


def simulate(folder: Path, scenario: dict[str, Any], method: str) -> tuple[dynsim.Record, Model]:
    """The record, with a sample at the end of every step, and the model."""
    heights = np.array([[0.04 * np.sin(1.1 * i) * np.cos(0.9 * k) for i in range(9)] for k in range(9)])
    np.savetxt(folder / "heights.csv", heights, delimiter=",")
    path = folder / "vectors.yaml"
    path.write_text(json.dumps({"name": "vectors", **scenario, "record": {"rate_hz": 1.0 / H}}))
    loaded = dynsim.load_scenario(path, overrides=METHODS[method])
    return dynsim.simulate(loaded), dynsim.Simulation(loaded).model


def momentum(model: Model, record: dynsim.Record, bodies: Sequence[int], samples: np.ndarray) -> np.ndarray:
    """Σ m v of bodies at samples, (k, 3) [N s]."""
    inertias = {i: model.robot.links[i].inertia for i in bodies if model.robot.links[i].inertia.mass > 0.0}
    return np.array(
        [
            sum(
                inertia.mass * (model.point_jacobian(i, inertia.com, record["q"][t]) @ record["v"][t])
                for i, inertia in inertias.items()
            )
            for t in samples
        ]
    )


def forces(model: Model, record: dynsim.Record, bodies: Sequence[int], first: np.ndarray, steps: int = 1) -> np.ndarray:
    """Change of Σ m v of bodies, less their weight, in the steps after samples ``first``, (k, 3) [N].

    That is what contacts and loads must have been in the mean.
    """
    mass = sum(model.robot.links[i].inertia.mass for i in bodies)
    change = momentum(model, record, bodies, first + steps) - momentum(model, record, bodies, first)
    return change / (record.time[first + steps] - record.time[first])[:, None] - mass * model.robot.gravity


def some_steps(record: dynsim.Record) -> np.ndarray:
    """Samples at which steps begin: every eighth, and those of impacts, (k,)."""
    strongest = np.argsort(record["contact_normal_force"].sum(axis=1))[-20:] - 1
    last = len(record.time) - 2
    return np.unique(np.r_[np.arange(0, last, 8), np.clip(strongest, 0, last)])


def smooth(record: dynsim.Record, *kinds: str) -> np.ndarray:
    """True for samples more than two steps from any event of these kinds, (T,)."""
    times = np.array([event.time for event in record.events if event.kind in kinds])
    far = np.abs(record.time[:, None] - times[None, :]) > 2.0 * np.diff(record.time).max()
    return far.all(axis=1)


def friction_of(record: dynsim.Record) -> np.ndarray:
    """Return |f_t| of each contact, from |F| and f_n alone, (T, c) [N]."""
    square = (record["contact_force"] ** 2).sum(axis=2) - record["contact_normal_force"] ** 2
    return np.sqrt(np.maximum(square, 0.0))


def check_cones(record: dynsim.Record, mu: float, speed: float, within: float) -> None:
    """|f_t| ≤ μ f_n, and = μ f_n against the slip of contacts that slide faster than ``speed``, except in impacts."""
    normal, slip = record["contact_normal_force"], record["contact_slip_velocity"]
    # |F|² − f_n² loses half of the digits where friction is small.
    assert (friction_of(record) - mu * normal).max() < 1e-6 * normal.max()
    fast = np.linalg.norm(slip, axis=2)
    slides = (record["contact_mode"] == 1) & (fast > speed)
    slides[1:] &= slides[:-1].copy()
    slides &= smooth(record, "landing", "lift_off")[:, None] & (normal > 1e-3 * np.median(normal[normal > 0.0]))
    assert slides.sum() > 100
    power = (record["contact_force"] * slip).sum(axis=2)[slides]
    np.testing.assert_allclose(power / (mu * normal * fast)[slides], -1.0, atol=within)


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("contact", CONTACTS)
def test_time_stepping_records_the_forces_that_move_an_arm(contact, surface, tmp_path):
    record, model = simulate(tmp_path, arm(surface, contact), "time_stepping")
    first = some_steps(record)
    recorded = record["contact_force"].sum(axis=1)[first + 1] + PUSH
    left = np.abs(forces(model, record, range(len(model.robot.links)), first) - recorded).max(axis=1)
    assert (record["contact_normal_force"].sum(axis=1) > 0.0).sum() > 500
    # The scheme is of second order while contacts stay, some 2e-3 N here; in the step of an impact, with hundreds of
    # newtons, of first: velocity products are those before it.
    assert np.quantile(left, 0.85) < 1e-3 * 9.81
    assert left.max() < 0.02 * record["contact_normal_force"].max()
    if contact != "wheel":
        # Friction is against the mean slip of the step, the record has that of its end.
        check_cones(record, MU, speed=0.02, within=0.02)


# dopri5 has a program of its own for shapes.
@pytest.mark.parametrize("method", ["radau5", pytest.param("dopri5", marks=pytest.mark.long)])
@pytest.mark.parametrize("contact", ["sphere", "links"])
def test_events_record_the_forces_that_move_an_arm(contact, method, tmp_path):
    record, model = simulate(tmp_path, arm("plane", contact), method)
    calm = np.flatnonzero(smooth(record, *{event.kind for event in record.events}))[1:-1:8]
    # Here a sample has the force of its instant: the mean of the intervals before and after it, to O(H²).
    change = forces(model, record, range(len(model.robot.links)), calm - 1, 2)
    left = np.abs(change - record["contact_force"].sum(axis=1)[calm] - PUSH).max(axis=1)
    assert (record["contact_normal_force"].sum(axis=1)[calm] > 0.0).sum() > 60
    assert left.max() < 1e-3 * 9.81
    check_cones(record, MU, speed=0.0, within=1e-9)


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("surface", ["plane", "heights"])
def test_time_stepping_records_the_forces_that_move_objects(surface, soft, tmp_path):
    record, model = simulate(tmp_path, objects(surface, soft), "time_stepping")
    names, first = record.labels["contact_force"], some_steps(record)
    for name in ("box", "ball", "cart"):
        bodies = [i for i, link in enumerate(model.robot.links) if link.name.startswith(name)]
        touching = [k for k, label in enumerate(names) if label.startswith(name)]
        recorded = record["contact_force"][first + 1][:, touching].sum(axis=1)
        left = np.abs(forces(model, record, bodies, first) - recorded - PUSH).max(axis=1)
        assert (recorded[:, 2] > 0.0).sum() > 5
        if name == "cart":
            # Its wheels turn against it: as of an arm.
            assert np.quantile(left, 0.85) < 1e-3 * 9.81
            assert left.max() < 0.02 * np.abs(recorded).max()
        else:
            # For a single body the scheme has the momentum exactly; ten thousand roundings of v / h.
            assert left.max() < 1e-10 * np.abs(recorded).max()
    assert (friction_of(record) - MU * record["contact_normal_force"]).max() < 1e-6 * record["contact_force"].max()


@pytest.mark.parametrize("theta", [0.5, 1.0])
@pytest.mark.parametrize("driven", [False, True])
def test_a_frictionless_point_in_a_bowl_is_pushed_along_the_normal_at_the_midpoint_of_its_step(theta, driven, tmp_path):
    """At every sample of a step, also of the last one, which is shorter, and of those that a limit has taken again."""
    steps, last = 150, 0.7  # the last step is shorter
    chain = [{"kind": "prismatic", "length_m": 0, "mass_kg": 0, "axis": axis} for axis in "xyz"]
    chain[2] |= {"mass_kg": 0.5}
    for link, position in zip(chain, (0.1, 0.05, -0.28), strict=True):
        link["initial_m"] = position
    bowl = {"type": "sphere", "center_m": [0, 0, 0], "radius_m": RADIUS, "inside": True}
    tip = {"body": "link_3", "point_m": [0, 0, 0], "surface": "bowl"}
    scenario: dict[str, Any] = {
        "name": "bowl",
        "duration_s": (steps + last) * H_BOWL,
        "plant": {"type": "serial_arm", "chain": chain},
        "surfaces": {"bowl": bowl},
        "contacts": {"law": "unilateral", "friction": 0, "points": {"tip": tip}},
        "initial": {"on_surface": ["tip"]},
        "record": {"rate_hz": 2.0 / H_BOWL},
        "integrator": {"method": "time_stepping", "step_s": H_BOWL, "theta": theta},
    }
    if driven:
        motor = {"torque_constant_N_m_per_A": 0.03, "resistance_ohm": 0.3, "inductance_H": 1e-4, "gear_ratio": 100}
        chain[0]["motor"] = {"type": "dc", "rotor_inertia_kg_m2": 1e-6, "voltage_limit_V": 2.0, **motor}
        joints = {"joint_1": {"times_s": [0, 0.1, 0.2, 0.3], "positions_m": [0.1, -0.1, 0.1, -0.1]}}
        scenario["controller"] = {"type": "joint_pd", "k_p_V_per_rad": 100, "k_d_V_s_per_rad": 1, "joints": joints}
    path = tmp_path / "bowl.yaml"
    path.write_text(json.dumps(scenario))
    record = dynsim.simulate(dynsim.load_scenario(path))
    t, q, v = record.time, record["q"], record["v"]
    f_n, force = record["contact_normal_force"][:, 0], record["contact_force"][:, 0]
    # Two samples in each step: its middle and its end; of the last step its end too.
    first = np.searchsorted(t, H_BOWL * np.maximum(np.ceil(t / H_BOWL - 1e-6) - 1.0, 0.0) - 1e-9)
    h = np.minimum(H_BOWL, t[-1] - t[first])
    assert h[-1] == pytest.approx(last * H_BOWL)
    assert list(first[-2:]) == [2 * steps] * 2
    middle = q[first] + 0.5 * h[:, None] * v[first]
    normal = -middle / np.linalg.norm(middle, axis=1)[:, None]
    assert f_n.min() > 0.2
    np.testing.assert_allclose(force, f_n[:, None] * normal, rtol=0, atol=1e-12)
    if driven:
        # Steps begin and end at the limit: those are solved more than once.
        limited = np.abs(record["voltage"][:, 0]) > 2.0 - 1e-9
        assert np.count_nonzero(limited[1:] != limited[:-1]) > 2
    else:
        # The mean force of a step is its change of momentum, to roundings of v / h.
        ends = np.append(np.arange(2, 2 * steps + 1, 2), len(t) - 1)
        change = 0.5 * (v[ends] - v[first[ends]]) / h[ends, None]
        np.testing.assert_allclose(change, force[ends] + [0.0, 0.0, -0.5 * 9.81], rtol=0, atol=1e-11)


def test_wheels_of_the_snake_record_the_forces_that_move_it():
    """One sample for each step; the table of wheels has the heat of the ledger."""
    every = {"duration_s": 3.0, "record.rate_hz": 200.0, "integrator.step_s": 0.005}
    scenario = dynsim.load_scenario("snake_positioning_dynamic", "y", overrides=every)
    record, model = dynsim.simulate(scenario), dynsim.Simulation(scenario).model
    first = some_steps(record)
    left = forces(model, record, range(len(model.robot.links)), first)
    left -= record["contact_force"].sum(axis=1)[first + 1]
    assert np.abs(record["contact_force"][:, :, :2]).max() > 10.0
    # 4e-4 N of 98 N: the scheme's second order, at slow motion.
    assert np.abs(left).max() < 2e-3
    assert (friction_of(record) - 0.6 * record["contact_normal_force"]).max() < 1e-6 * 98.0
    table = wheel_table({"y": record})
    heat = sum(float(row[table[0].index("friction_J")]) for row in table[1:])
    # Trapezoids over samples of the power; slip begins and ends between them.
    assert record["heat_friction"][-1] > 5e-3
    assert heat == pytest.approx(record["heat_friction"][-1], rel=0.05)
