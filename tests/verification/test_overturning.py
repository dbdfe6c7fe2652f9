"""Ground reactions and tip margin of a mobile base, against Newton's law for all bodies and two separate wheels.

The independent computation takes coordinates, rates and accelerations of a sample, follows the poses of all bodies
(``clearance.poses``) and of two turning wheel discs along q + s q̇ + s² q̈/2, and differentiates them by central
differences: momenta, so forces and moments of the ground, without the engine's velocities, inertias or spin terms.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import lines_with, raises

import dynsim
from dynsim.compile.clearance import poses
from dynsim.engine.stepped import State
from dynsim.errors import ModelError, SimulationStopped
from dynsim.model.description import Robot
from dynsim.scenario import build

TRACK, RADIUS, MU, CASTER = 0.3, 0.05, 0.7, np.array([0.16, 0.03, 0.0])
WHEEL_MASS, AXLE, ACROSS = 0.25, 4e-4, 2.5e-4
MASS, COM = 4.0, np.array([0.05, 0.01, 0.08])
TENSOR = np.array([[0.03, 0.002, -0.001], [0.002, 0.05, 0.003], [-0.001, 0.003, 0.06]])
FEET = np.array([[0.0, 0.5 * TRACK, 0.0], [0.0, -0.5 * TRACK, 0.0], CASTER])

BASE = f"""
name: stands
duration_s: 0.4
plant:
  type: pws_arm
  base:
    position_m: [0.3, -0.2]
    heading_deg: 35
    mass_kg: {MASS}
    com_m: {COM.tolist()}
    inertia_kg_m2: {TENSOR[np.triu_indices(3)].tolist()}
    track_m: {TRACK}
    caster_m: {CASTER.tolist()}
    wheel_friction: {MU}
    on_overturn: OVERTURN
    wheel:
      mass_kg: {WHEEL_MASS}
      radius_m: {RADIUS}
      inertia_axle_kg_m2: {AXLE}
      inertia_across_kg_m2: {ACROSS}
      damping_N_m_s_per_rad: 0.05
      motor: {{type: wang_minami}}
    mount: {{position_m: [0.02, -0.01, 0.12], yaw_deg: 20}}
  arm:
    type: serial_arm
    gravity_m_s2: GRAVITY
    link: {{mass_kg: 0.2, length_m: 0.3, radius_m: 0.01, damping_N_m_s_per_rad: 0.5, motor: {{type: wang_minami}}}}
"""
SWINGING = """
    chain: [{axis: z, length_m: 0.0}, {axis: y, count: 3}]
    initial_deg: [10, -20, 60, 10]
"""
# Of the issue: joints 4 and 7 stand on the floor.
_A = 0.4 * np.pi
_B = np.arccos(-(0.12 + 0.3 * np.cos(_A)) / 0.3)
_ANGLES = [*np.rad2deg([0.0, _A, _B - _A, 0.25 * np.pi - _B]).tolist(), 45, 45, -90, 45, -45, 45]
BRACED = f"""
    chain: [{{axis: z, length_m: 0.0}}, {{axis: y, count: 9}}]
    initial_deg: {[float(angle) for angle in _ANGLES]}
surfaces:
  floor: {{type: plane, point_m: [0, 0, 0], normal: [0, 0, 1]}}
contacts:
  law: bilateral
  friction: 0.1
  pulling_friction: signed
  points:
    elbow_4: {{body: link_4, surface: floor}}
    elbow_7: {{body: link_7, surface: floor}}
"""
PUSHED = """
loads:
  push: {type: samples, body: base, point_m: [0.05, 0.1, 0.2], times_s: [0, 0.1, 0.2, 0.4],
         force_N: [[0, 0, 0], [9, -4, 3], [-6, 5, 2], [3, 4, -5]]}
  twist: {type: samples, body: link_3, frame: body, times_s: [0, 0.2, 0.4],
          force_N: [[0, 0, 0], [1, -2, 1], [2, 1, 0]], torque_N_m: [[0, 0, 0], [0.1, 0.2, -0.1], [-0.2, 0.1, 0]]}
"""
END = """
controller: {type: joint_pd, k_p_V_per_rad: 500, k_d_V_s_per_rad: 20}
integrator: {method: dopri5, rtol: 1.0e-9, atol: 1.0e-11}
record: {rate_hz: 200}
metrics: {settle_s: 0}
"""
DOWN = "[0, 0, -9.81]"


def read(
    folder: Path, *parts: str, gravity: str = DOWN, overturn: str = "warn", **overrides: object
) -> dynsim.Scenario:
    path = folder / "case.yaml"
    path.write_text("".join((BASE, *parts, END)).replace("GRAVITY", gravity).replace("OVERTURN", overturn))
    return dynsim.load_scenario(path, overrides=overrides)


# ---- the independent computation

ORDERS = {
    1: np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280]),
    2: np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560]),
}
S = 1.5e-3 * np.arange(-4, 5)


def derivative(values: np.ndarray, order: int) -> np.ndarray:
    """Derivative at s = 0 of values along their last axis at the nodes S, to the eighth power of their distance."""
    return values @ ORDERS[order] / (S[1] - S[0]) ** order


def curve(robot: Robot, q: np.ndarray, v: np.ndarray, vdot: np.ndarray) -> np.ndarray:
    """Coordinates (9, nq) on a curve that has these rates and accelerations at its middle."""
    turn = RADIUS / TRACK * (q[1] - q[0])
    omega = RADIUS / TRACK * (v[1] - v[0])
    speed, change = 0.5 * RADIUS * (v[0] + v[1]), 0.5 * RADIUS * (vdot[0] + vdot[1])
    ahead, aside = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    rate = np.r_[v[:2], speed * ahead, v[2:]]
    acceleration = np.r_[vdot[:2], change * ahead + speed * omega * aside, vdot[2:]]
    return q + S[:, None] * rate + 0.5 * S[:, None] ** 2 * acceleration


def cross_of(W: np.ndarray) -> np.ndarray:
    return 0.5 * np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])


def momentum_rate(mass: float, c: np.ndarray, tensor: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """d/dt of linear momentum and of angular momentum about the world origin: c (3, 9), R (3, 3, 9) along the curve."""
    force = mass * derivative(c, 2)
    R0, R1, R2 = R[..., 4], derivative(R, 1), derivative(R, 2)
    omega, alpha = cross_of(R1 @ R0.T), cross_of(R2 @ R0.T + R1 @ R1.T)
    world = R0 @ tensor @ R0.T
    return force, np.cross(c[:, 4], force) + world @ alpha + np.cross(omega, world @ omega)


def about_y(angle: np.ndarray) -> np.ndarray:
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.array([[c, o, s], [o, o + 1.0, o], [-s, o, c]])


def reaction(
    robot: Robot, q: np.ndarray, v: np.ndarray, vdot: np.ndarray, outside: list[tuple[Any, ...]]
) -> dict[str, Any]:
    """Loads, forces along and across the base, centre of pressure and margin from Newton's law.

    outside : (body, point in it, force and torque in the world) of what else acts
    """
    path = curve(robot, q, v, vdot)
    placed = {link.name: (R, p) for link, R, p in poses(robot, path)}
    force, moment = np.zeros(3), np.zeros(3)
    base_R, base_p = placed["base"]
    parts = [(MASS, COM, TENSOR, base_R, base_p)]
    disc = np.diag([ACROSS, AXLE, ACROSS])
    for k, foot in enumerate(FEET[:2]):
        R = np.einsum("ijt,jkt->ikt", base_R, about_y(path[:, k]))
        centre = base_p + np.einsum("ijt,j->it", base_R, foot + np.array([0.0, 0.0, RADIUS]))
        parts.append((WHEEL_MASS, np.zeros(3), disc, R, centre))
    for link in robot.links[2:]:
        parts.append((link.inertia.mass, link.inertia.com, link.inertia.tensor, *placed[link.name]))
    for mass, com, tensor, R, p in parts:
        c = p + np.einsum("ijt,j->it", R, com)
        f, m = momentum_rate(mass, c, tensor, R)
        force += f - mass * robot.gravity
        moment += m - np.cross(c[:, 4], mass * robot.gravity)
    for body, point, f, m in outside:
        R, p = placed[body]
        force -= f
        moment -= m + np.cross(p[:, 4] + R[..., 4] @ point, f)
    R, p = base_R[..., 4], base_p[:, 4]
    f, m = R.T @ force, R.T @ (moment - np.cross(p, force))
    # Moments about the x and y of the base, and the sum: Σ N (y, −x, 1).
    loads = np.linalg.solve(np.stack([FEET[:, 1], -FEET[:, 0], np.ones(3)]), [m[0], m[1], f[2]])
    along = np.linalg.solve([[1.0, 1.0], [-0.5 * TRACK, 0.5 * TRACK]], [f[0], m[2]])
    pressure = (loads @ FEET)[:2] / loads.sum()
    return {
        "loads": loads,
        "along": along,
        "across": f[1],
        "pressure": p[:2] + R[:2, :2] @ pressure,
        "margin": margin(pressure) if loads.sum() > 0.0 else -1.0,
    }


def margin(point: np.ndarray) -> float:
    """Least signed distance of a point of the base from the lines of the support triangle, per inradius."""
    corners = FEET[:, :2]
    area = 0.5 * abs(float(np.cross(np.r_[corners[1] - corners[0], 0.0], np.r_[corners[2] - corners[0], 0.0])[2]))
    distances, perimeter = [], 0.0
    for k in range(3):
        a, b, inner = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
        length = float(np.linalg.norm(b - a))
        normal = np.array([a[1] - b[1], b[0] - a[0]]) / length
        distances.append(normal @ (point - a) * np.sign(normal @ (inner - a)))
        perimeter += length
    return float(min(distances) / (2.0 * area / perimeter))


def incentre() -> np.ndarray:
    sides = np.array([np.linalg.norm(FEET[k - 1] - FEET[k - 2]) for k in range(3)])
    return np.asarray((sides @ FEET / sides.sum())[:2])


def outside_of(scenario: dynsim.Scenario, robot: Robot, record: dynsim.Record, k: int) -> list[tuple[Any, ...]]:
    """Contact forces of the record and loads of the scenario at a sample."""
    wrenches = []
    for contact, force in zip(build.contacts(scenario), record["contact_force"][k], strict=True):
        wrenches.append((contact.body, contact.point, force, np.zeros(3)))
    turned = {link.name: R[..., 0] for link, R, _ in poses(robot, record["q"][k : k + 1])}
    for load in build.loads(scenario, robot):
        values = load.components(record.time[k : k + 1])[0]
        R = turned[load.body] if load.in_body else np.eye(3)
        wrenches.append((load.body, load.point, R @ values[:3], R @ values[3:]))
    return wrenches


def expected_at(scenario: dynsim.Scenario, record: dynsim.Record, k: int, **more: Any) -> dict[str, Any]:
    robot = build.robot(scenario)
    outside = outside_of(scenario, robot, record, k) + more.get("outside", [])
    return reaction(robot, record["q"][k], record["v"][k], record["vdot"][k], outside)


def assert_same_support(scenario: dynsim.Scenario, record: dynsim.Record, k: int, **more: Any) -> dict[str, Any]:
    """Sample k of the record agrees with the independent computation, and the wheels' own balances of spin."""
    expected = expected_at(scenario, record, k, **more)
    loads, scale = expected["loads"], 1.0 + np.abs(expected["loads"]).max()
    np.testing.assert_allclose(record["wheel_load"][k], loads, rtol=0.0, atol=1e-8 * scale)
    assert record["tip_margin"][k] == pytest.approx(expected["margin"], rel=1e-7, abs=1e-7)
    # I φ̈ = τ − D φ̇ − r F_x, with τ what the motors give; rolling is what F_x serves.
    spin = record["torque"][k, :2] - 0.05 * record["v"][k, :2] - AXLE * record["vdot"][k, :2]
    along = spin / RADIUS
    np.testing.assert_allclose(along, expected["along"], rtol=0.0, atol=1e-8 * scale)
    carried = np.maximum(loads[:2], 0.0)
    for side in range(2):
        if loads[side] > 0.0:
            across = expected["across"] * loads[side] / carried.sum()
            demand = np.hypot(along[side], across) / (MU * loads[side])
            assert record["traction_demand"][k, side] == pytest.approx(demand, rel=1e-6)
        else:
            assert np.isnan(record["traction_demand"][k, side])
    if loads.sum() > 0.0:
        np.testing.assert_allclose(record["center_of_pressure"][k], expected["pressure"], rtol=1e-7, atol=1e-8)
    else:
        assert np.isnan(record["center_of_pressure"][k]).all()
    return expected


# M* of wheels and a support polygon is a program of its own to compile.
@pytest.mark.parametrize("solver", ["articulated", pytest.param("m_star", marks=pytest.mark.slow)])
@pytest.mark.parametrize("gravity", [DOWN, "[1.5, -2.0, -9.0]"], ids=["level", "on a slope"])
def test_loads_at_random_states_are_those_of_explicit_wheels_and_differenced_momenta(tmp_path, gravity, solver):
    """Tipped and lifted states among them, wrenches on base and arm."""
    scenario = read(tmp_path, SWINGING, gravity=gravity, **{"integrator.solver": solver})
    rng, kinds = np.random.default_rng(3), set()
    for case in range(8):
        q = np.r_[rng.normal(size=2), rng.normal(size=2), rng.normal(size=4)]
        v = np.r_[rng.normal(scale=15.0, size=2), rng.normal(scale=2.0, size=4)]
        simulation = dynsim.Simulation(scenario, state=State(0.0, q, v, rng.normal(size=6)))
        force, torque, point = rng.normal(scale=8.0, size=3), rng.normal(size=3), rng.normal(scale=0.1, size=3)
        lift = np.array([0.0, 0.0, 80.0 if case == 0 else 0.0])
        simulation.set_wrench("base", lift)
        simulation.set_wrench("link_4", force, torque, point=point)
        simulation.advance(1e-6)
        wrenches = [("base", np.zeros(3), lift, np.zeros(3)), ("link_4", point, force, torque)]
        support = assert_same_support(scenario, simulation.record(), 0, outside=wrenches)
        kinds.add("stands" if support["margin"] > 0.0 else "lifted" if support["loads"].sum() <= 0.0 else "tips")
    assert kinds == {"stands", "tips", "lifted"}


@pytest.mark.parametrize("arm", [SWINGING, BRACED], ids=["no contact", "braced, pulled and with friction"])
def test_loads_along_a_run_with_contacts_and_changing_loads(tmp_path, arm):
    scenario = read(tmp_path, arm, PUSHED)
    record = dynsim.simulate(scenario)
    if arm is BRACED:
        assert np.abs(record["contact_normal_force"]).max() > 1.0
    for k in range(0, len(record), 9):
        assert_same_support(scenario, record, k)


def test_a_robot_at_rest_stands_by_its_levers(tmp_path):
    """The centre of pressure of what has come to rest lies below the centre of mass."""
    record = dynsim.simulate(read(tmp_path, SWINGING, duration_s=8.0))
    robot = build.robot(read(tmp_path, SWINGING))
    total, first = 0.0, np.zeros(2)
    for link, R, p in poses(robot, record["q"][-1:]):
        m = link.inertia.mass
        total, first = total + m, first + m * (p[:2, 0] + R[:2, :, 0] @ link.inertia.com)
    assert np.abs(record["v"][-1]).max() < 1e-9
    np.testing.assert_allclose(record["center_of_pressure"][-1], first / total, rtol=0.0, atol=1e-8)
    x, y, heading = record["base_pose"][-1]
    c, s = np.cos(heading), np.sin(heading)
    a, b = np.array([[c, s], [-s, c]]) @ (first / total - [x, y])
    caster = total * 9.81 * a / CASTER[0]
    others = total * 9.81 - caster
    left = 0.5 * others + (total * 9.81 * b - caster * CASTER[1]) / TRACK
    np.testing.assert_allclose(record["wheel_load"][-1], [left, others - left, caster], rtol=1e-7)
    base = record.summary["base"]
    assert list(base["wheel_load_final_N"].values()) == record["wheel_load"][-1].tolist()
    # Of all steps, which do not end at samples.
    assert 0.0 <= record["tip_margin"].min() - base["tip_margin_min"] < 2e-3
    assert base["overturns_at_s"] is None
    assert base["pose_final"] == record["base_pose"][-1].tolist()


def pressed(scenario: dynsim.Scenario, point: np.ndarray, extra: float) -> dynsim.Record:
    """One sample at the start, with a weight put on the base so that the pressure's centre is there (base's frame)."""

    def sample(force: float, at: np.ndarray) -> dynsim.Record:
        simulation = dynsim.Simulation(scenario)
        simulation.set_wrench("base", [0.0, 0.0, -force], point=np.r_[at, 0.0])
        simulation.advance(1e-7)
        return simulation.record()

    # A weight on the base moves nothing, so loads are linear in it.
    loads = sample(0.0, point)["wheel_load"][0]
    return sample(extra, point + (point - (loads @ FEET)[:2] / loads.sum()) * loads.sum() / extra)


def test_the_margin_is_one_at_the_incentre_zero_on_the_sides_and_minus_one_aloft(tmp_path):
    scenario = read(tmp_path, SWINGING)
    assert pressed(scenario, incentre(), 50.0)["tip_margin"][0] == pytest.approx(1.0, abs=1e-10)
    for k in range(3):
        middle = 0.5 * (FEET[k - 1] + FEET[k - 2])[:2]
        assert pressed(scenario, middle, 50.0)["tip_margin"][0] == pytest.approx(0.0, abs=1e-10)
        out = middle + 2.0 * (middle - incentre())
        assert pressed(scenario, out, 50.0)["tip_margin"][0] == pytest.approx(margin(out), abs=1e-9)
    aloft = pressed(scenario, incentre(), -500.0)
    assert aloft["tip_margin"][0] == -1.0
    assert lines_with(aloft.summary["warnings"], phrase="base lifted")


# A push on the base that grows until the base tips, and beyond.
TIPPING = """
loads:
  push: {type: samples, body: base, point_m: [0.0, 0.0, 0.15], times_s: [0, 0.15, 0.3, 0.4],
         force_N: [[0, 0, 0], [2, 20, 0], [-3, 48, 0], [2, 30, 0]]}
"""


def crossing(times: np.ndarray, values: np.ndarray) -> float:
    """First zero of samples, by the polynomial through the six around it."""
    k = int(np.flatnonzero((values[:-1] > 0.0) & (values[1:] <= 0.0))[0])
    near = slice(k - 2, k + 4)
    fit = np.polynomial.Polynomial.fit(times[near], values[near], 5)
    roots = [root.real for root in fit.roots() if abs(root.imag) < 1e-12 and times[k] <= root.real <= times[k + 1]]
    assert len(roots) == 1
    return float(roots[0])


def test_it_tips_when_an_independent_margin_is_zero_and_goes_on_as_if_held(tmp_path):
    scenario = read(tmp_path, SWINGING, TIPPING)
    record = dynsim.simulate(scenario)
    tips = [event for event in record.events if event.kind == "tip_over"]
    base = record.summary["base"]
    assert base["overturns_at_s"] == tips[0].time
    expected = np.array([expected_at(scenario, record, k)["margin"] for k in range(len(record))])
    assert tips[0].time == pytest.approx(crossing(record.time, expected), abs=1e-6)
    assert record.complete
    assert record["tip_margin"].min() < 0.0
    assert 0.0 <= record["tip_margin"].min() - base["tip_margin_min"] < 1e-3
    assert 0.0 <= record["wheel_load"][:, 1].min() - base["wheel_load_min_N"]["right"] < 0.01
    assert lines_with(record.summary["warnings"], phrase="held down")
    assert base["traction_demand_max"] == np.nanmax(record["traction_demand"])


def test_margin_of_a_base_without_total_load_is_that_of_a_lifted_base(tmp_path):
    """Loads that cancel up to rounding have no centre of pressure; their quotient would be a margin of −1e15."""
    forces = enumerate((-0.1, -0.2, 0.3))
    loads = "".join(
        f"  push_{k}: {{type: samples, body: base, point_m: [{0.1 * k}, {0.05 * k}, 0.1], times_s: [0, 1],"
        f" force_N: [[0, 0, {force}], [0, 0, {force}]]}}\n"
        for k, force in forces
    )
    record = dynsim.simulate(read(tmp_path, SWINGING, f"loads:\n{loads}", gravity="[0, 0, 0]", duration_s=0.02))
    total, largest = record["wheel_load"].sum(axis=1), np.abs(record["wheel_load"]).max()
    assert largest > 0.1
    assert (total > 0.0).all()
    assert (total < 1e-15).all()
    assert (record["tip_margin"] == -1.0).all()
    assert np.isnan(record["center_of_pressure"]).all()
    assert record.summary["base"]["tip_margin_min"] == record.summary["base"]["tip_margin_min_settled"] == -1.0


def test_a_run_that_is_to_stop_where_it_tips_ends_there_with_all_that_it_has(tmp_path):
    scenario = read(tmp_path, SWINGING, TIPPING, overturn="stop")
    goes_on = dynsim.simulate(read(tmp_path, SWINGING, TIPPING))
    with pytest.raises(SimulationStopped) as stop:
        dynsim.simulate(scenario)
    assert (stop.value.exit_code, stop.value.kind) == (3, "overturned")
    record = stop.value.record
    assert stop.value.time == goes_on.summary["base"]["overturns_at_s"] == record.summary["base"]["overturns_at_s"]
    assert record.summary["base"]["tip_margin_min"] == pytest.approx(0.0, abs=1e-12)
    assert [event.kind for event in record.events] == ["tip_over"]
    count = len(record)
    assert record.time[-1] <= stop.value.time < goes_on.time[count]
    for name in ("q", "wheel_load", "tip_margin"):
        assert record[name].tobytes() == goes_on[name][:count].tobytes()
    simulation = dynsim.Simulation(scenario)
    simulation.advance(0.1)
    with pytest.raises(SimulationStopped) as stepped:
        simulation.advance(0.4)
    assert (stepped.value.time, stepped.value.kind) == (stop.value.time, "overturned")
    assert stepped.value.record["q"].tobytes() == record["q"].tobytes()


TIPPED = """
duration_s: 3.0
plant:
  type: pws_arm
  base: {on_overturn: OVERTURN, wheel: {damping_N_m_s_per_rad: 0.05}}
  arm: {type: serial_arm, chain: [{axis: z, mass_kg: 0.5, length_m: 0.2, damping_N_m_s_per_rad: 0.1}]}
loads:
  push:
    type: samples
    body: base
    times_s: [1.0, 1.1, 1.5, 1.6]
    torque_N_m: [[0, 0, 0], [0, 3.6, 0], [0, 3.6, 0], [0, 0, 0]]
"""


def test_a_base_that_tips_and_comes_back_within_one_step_tips(tmp_path):
    """From 1.18 s to 1.42 s, which radau5 passes over in a step; at the time that short steps of dopri5 find."""
    path, times = tmp_path / "case.yaml", []
    for overrides in ({"method": "radau5"}, {"method": "dopri5"}, {"method": "dopri5", "step_max_s": 1e-3}):
        path.write_text(TIPPED.replace("OVERTURN", "stop"))
        with pytest.raises(SimulationStopped) as stop:
            dynsim.simulate(dynsim.load_scenario(path, overrides={f"integrator.{k}": overrides[k] for k in overrides}))
        assert stop.value.kind == "overturned"
        times.append(stop.value.time)
        assert stop.value.record["tip_margin"].min() > 0.0
    assert times == pytest.approx([times[-1]] * 3, abs=1e-9)
    path.write_text(TIPPED.replace("OVERTURN", "warn"))
    record = dynsim.simulate(dynsim.load_scenario(path))
    assert record.summary["base"]["overturns_at_s"] == times[0]
    below = record.time[record["tip_margin"] < 0.0]
    assert 0.0 < below[0] - times[0] < record.time[1] - record.time[0]


def test_a_stepper_records_the_same_and_watches_margins(tmp_path):
    scenario = read(tmp_path, SWINGING, TIPPING)
    whole, simulation = dynsim.simulate(scenario), dynsim.Simulation(scenario)
    for t in (0.031, 0.2, 0.4):
        simulation.advance(t)
    record = simulation.record()
    assert record.events == whole.events
    for name in whole:
        assert record[name].tobytes() == whole[name].tobytes()
    assert record.summary["base"] == whole.summary["base"]
    other = dynsim.Simulation(scenario)
    other.watch("tip_margin", "base", 0.2, direction=-1, stop=True)
    other.advance(0.4)
    early = crossing(whole.time, whole["tip_margin"] - 0.2)
    assert other.time == pytest.approx(early, abs=1e-6)
    with raises(ModelError, "'link_1'", "base"):
        other.watch("tip_margin", "link_1")


def test_a_base_that_begins_beyond_its_triangle_tips_at_once(tmp_path):
    text = BASE.replace(f"com_m: {COM.tolist()}", "com_m: [-0.1, 0.0, 0.08]")
    path = tmp_path / "case.yaml"
    path.write_text((text + SWINGING + END).replace("GRAVITY", DOWN).replace("OVERTURN", "stop"))
    with pytest.raises(SimulationStopped) as stop:
        dynsim.simulate(dynsim.load_scenario(path))
    assert stop.value.kind == "overturned"
    assert stop.value.time < 1e-12
    assert stop.value.record.summary["base"]["tip_margin_min"] < 0.0


def test_a_record_of_a_lifted_wheel_comes_back_from_its_file(tmp_path):
    record = dynsim.simulate(read(tmp_path, SWINGING, TIPPING))
    assert np.isnan(record["traction_demand"]).any()
    again = dynsim.Record.load(record.save(tmp_path / "record.h5"))
    for name in ("wheel_load", "center_of_pressure", "tip_margin", "traction_demand", "wheel_speed"):
        np.testing.assert_array_equal(again[name], record[name])
    assert again.events == record.events


def test_path_length_of_wheels_that_turn_is_that_of_their_angles(tmp_path):
    record = dynsim.simulate(read(tmp_path, SWINGING, TIPPING, **{"record.rate_hz": 2000}))
    rate = 0.5 * RADIUS * np.abs(record["wheel_speed"].sum(axis=1))
    length = record.summary["base"]["path_length_m"]
    assert length > 1e-4
    assert length == pytest.approx(np.trapezoid(rate, record.time), rel=1e-3)


# ---- objects beside the base, which it does not carry

VALVE = {"mass_kg": 2.0, "size_m": [0.1, 0.1, 0.1], "position_m": [1.3, -0.2, 0.5], "hinge": {"axis": [0, 0, 1]}}
DROP = {"type": "constant", "body": "valve", "force_N": [0.0, 0.0, -40.0]}


def test_what_hangs_on_a_hinge_beside_the_base_does_not_load_it(tmp_path):
    """Nor does a load on it; the same for the margin at rest that check tells, and for stopping where it tips."""
    real = {"contacts": {"law": "unilateral"}, "duration_s": 0.02}
    beside = read(tmp_path, SWINGING, overturn="stop", objects={"valve": VALVE}, loads={"drop": DROP}, **real)
    alone = read(tmp_path, SWINGING, **real)
    record, expected = dynsim.simulate(beside), dynsim.simulate(alone)
    for name in ("wheel_load", "center_of_pressure", "tip_margin", "traction_demand"):
        # Both runs are right to about 1e-9, by steps of their own.
        np.testing.assert_allclose(record[name], expected[name], rtol=1e-6, atol=1e-6, err_msg=name)
    assert dynsim.check(beside).tip_margin == pytest.approx(dynsim.check(alone).tip_margin, rel=1e-12)
