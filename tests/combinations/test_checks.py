"""A good record passes all checks, and each kind of corruption is detected by its check."""

from __future__ import annotations

import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml
from support.pinocchio_oracle import Oracle
from support.random_robots import random_positions, random_robot, random_robot_of

from combinations.accelerations import State, _paradox, critical
from combinations.bodies import Bodies, position_rates
from combinations.checks import compare, problems
from combinations.energy import residual_floor
from combinations.observed import Observed
from combinations.running import Run
from combinations.sentences import FALSE_WARNINGS, HOLDS_UP, LAST_STEP, NUMBER, SENTENCES, WEDGE
from combinations.surfaces import nearest, shape
from combinations.verdicts import untrue
from dynsim import check, simulate
from dynsim.errors import DynsimError, SimulationStopped
from dynsim.record import Record
from dynsim.scenario.reading import scenario_from_resolved

# Two pitch joints whose tip slides over a floor, sticks and lifts off; a box on the floor next to them.
ARM = {
    "name": "checked",
    "duration_s": 0.4,
    "plant": {
        "type": "serial_arm",
        "link": {"radius_m": 0.01, "damping_N_m_s_per_rad": 0.05, "motor": {"type": "wang_minami"}},
        "chain": [
            {"axis": "z", "length_m": 0.0, "mass_kg": 0.2},
            {"axis": "y", "length_m": 0.3, "mass_kg": 0.4, "initial_deg": 60.0, "friction_N_m": 0.02},
            {"axis": "y", "length_m": 0.3, "mass_kg": 0.4, "initial_deg": 80.0, "limit_deg": [-170.0, 100.0]},
        ],
    },
    "controller": {"type": "joint_pd", "k_p_V_per_rad": 60.0, "k_d_V_s_per_rad": 2.0},
    "surfaces": {"floor": {"type": "plane", "point_m": [0.0, 0.0, -0.09]}},
    "contacts": {
        "law": "unilateral",
        "friction": 0.3,
        "points": {"tip": {"body": "link_3", "point_m": [0.0, 0.0, 0.3], "surface": "floor"}},
    },
    "loads": {
        "push": {"type": "constant", "body": "link_3", "force_N": [1.5, 0.5, -2.0]},
        "lean": {"type": "constant", "body": "box", "force_N": [0.8, 0.0, 0.0]},
    },
    "objects": {
        "box": {"mass_kg": 0.5, "size_m": [0.1, 0.1, 0.1], "position_m": [1.0, 1.0, -0.03], "rpy_deg": [5, 0, 0]}
    },
    "sensors": {"wrench": {"probe": {"body": "link_2", "point_m": [0.01, -0.02, 0.03]}}},
    "record": {"rate_hz": 1000.0},
    "metrics": {"settle_s": 0.0},
}


@cache
def _run(method: str, kind: str = "") -> Run:
    settings = deepcopy(ARM)
    settings["integrator"] = {"method": method}
    if kind == "sampled":
        settings["controller"]["sample_time_s"] = 0.002
        del settings["plant"]["chain"][1]["friction_N_m"]
    return _simulated(settings)


def _simulated(settings: dict[str, Any]) -> Run:
    scenario, checked = scenario_from_resolved(settings), None
    record, failure = None, None
    try:
        check(scenario)
    except DynsimError as error:
        checked = str(error)
    try:
        record = simulate(scenario)
    except SimulationStopped as stop:
        record, failure = stop.record, stop
    except DynsimError as error:
        failure = error
    said = list(record.summary["warnings"]) if record is not None else []
    return Run(settings, scenario, scenario.integrator.method, "simulate", record, failure, said, checked)


def _spoilt(run: Run, **signals: Callable[[np.ndarray], np.ndarray]) -> Run:
    """Return the run with some signals of its record changed."""
    assert run.record is not None
    record = Record(run.record.time, provenance=run.record.provenance)
    record.signals.update(run.record.signals)
    record.summary.update(run.record.summary)
    record.events.extend(run.record.events)
    for name, change in signals.items():
        signal = record.signals[name]
        record.signals[name] = replace(signal, data=change(np.array(signal.data)))
    return replace(run, record=record)


def _kinds(run: Run) -> set[str]:
    return {problem.kind for problem in problems(run.scenario, run)}


@pytest.mark.parametrize("kind", ["", "sampled"])
@pytest.mark.parametrize("method", ["dopri5", "radau5", "time_stepping"])
def test_good_records_pass(method: str, kind: str) -> None:
    run = _run(method, kind)
    assert problems(run.scenario, run) == []
    # The record contains sliding and sticking contacts, a stop and dry friction.
    assert run.record is not None
    modes = run.record["contact_mode"]
    assert {0, 1} <= set(np.unique(modes))


def _shifted(by: float, first: int = 0, count: int | None = None) -> Callable[[np.ndarray], np.ndarray]:
    def change(data: np.ndarray) -> np.ndarray:
        data[first : None if count is None else first + count] += by
        return data

    return change


def _times(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda data: factor * data


def _turned_tangent(data: np.ndarray) -> np.ndarray:
    """Rotate the friction on the floor by 40°, with normal forces unchanged."""
    turn = np.radians(40.0)
    x, y = data[..., 0].copy(), data[..., 1].copy()
    data[..., 0], data[..., 1] = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    return data


def _stronger_friction(data: np.ndarray) -> np.ndarray:
    data[..., :2] *= 1.2
    return data


def _with_nan(data: np.ndarray) -> np.ndarray:
    data[len(data) // 2] = np.nan
    return data


def _one_absurd(data: np.ndarray) -> np.ndarray:
    data[len(data) // 2] = 1e16
    return data


def _falling(data: np.ndarray) -> np.ndarray:
    data[len(data) // 2 :] -= 0.05 * data.max()
    return data


def _lagging(data: np.ndarray) -> np.ndarray:
    """Hold values a tick longer than the controller did."""
    return np.concatenate([data[:2], data[:-2]])


SPOILT: dict[str, tuple[dict[str, Callable[[np.ndarray], np.ndarray]], set[str]]] = {
    "first sample elsewhere": ({"q": _shifted(0.01, 0, 1)}, {"start"}),
    "starts moving": ({"v": _shifted(0.01, 0, 1)}, {"start"}),
    "accelerations of other forces": ({"vdot": _times(1.05)}, {"motion"}),
    "current that gives another torque": ({"current": _times(1.05)}, {"equation"}),
    "other wrench": ({"wrench_torque": _times(1.0001)}, {"wrench"}),
    "turned tangent": ({"contact_force": _turned_tangent}, {"equation", "friction", "momentum"}),
    "outside the cone": ({"contact_force": _stronger_friction}, {"friction"}),
    "other normal force": ({"contact_normal_force": _times(1.01)}, {"touching"}),
    "pulling": ({"contact_normal_force": _times(-1.0), "contact_force": _times(-1.0)}, {"touching", "equation"}),
    "force of an open contact": ({"contact_mode": _times(0.0)}, {"touching"}),
    "other gap": ({"contact_gap": _shifted(1e-4)}, {"touching"}),
    "slip of the other way": ({"contact_slip_velocity": _times(-1.0)}, {"touching"}),
    "dry friction beyond its bound": ({"joint_friction": _times(1.5)}, {"dry", "equation"}),
    "dry friction that drives": ({"joint_friction": _times(-1.0)}, {"dry", "equation"}),
    "kinetic energy": ({"energy_kinetic": _times(1.001)}, {"ledger"}),
    "electrical energy": ({"energy_electrical": _times(1.01)}, {"ledger"}),
    "Joule heat": ({"heat_joule": _times(1.5)}, {"powers"}),
    "losses": ({"loss_joint": _times(1.5)}, {"powers"}),
    "losses that fall": ({"loss_joint": _falling}, {"losses"}),
    "voltage of another gain": ({"voltage": _times(1.1)}, {"commands"}),
    "not finite": ({"contact_force": _with_nan}, {"finite"}),
    "absurd force": ({"contact_normal_force": _one_absurd}, {"absurd"}),
}


@pytest.mark.parametrize("fault", SPOILT)
@pytest.mark.parametrize("method", ["radau5", "time_stepping"])
def test_corrupted_signals_are_found(method: str, fault: str) -> None:
    changes, expected = SPOILT[fault]
    spoilt = _spoilt(_run(method), **changes)
    assert expected <= _kinds(spoilt)


def test_the_floor_of_the_residual_is_that_of_the_summary() -> None:
    """An arm held by its dry friction has a turnover below the resolution of its ledger."""
    settings = {**deepcopy(ARM), "duration_s": 0.02, "integrator": {"method": "radau5"}}
    del settings["objects"], settings["loads"]
    settings["plant"]["chain"][1]["friction_N_m"] = settings["plant"]["chain"][2]["friction_N_m"] = 10.0
    run = _simulated(settings)
    assert problems(settings, run) == []
    # For 1 kg each landing may leave 1e-13 m times the weight, ten of them up to the limit of 1e-6.
    assert residual_floor(Observed(run)) == pytest.approx(1.0 * 9.81 * 1e-6, rel=1e-3)
    assert "ledger" in _kinds(_spoilt(run, energy_electrical=_shifted(1e-9, 5)))


def _below(data: np.ndarray) -> np.ndarray:
    """Bend the elbow a little further in one sample."""
    data[60, 1] += 0.01
    return data


def _beyond_its_stop(data: np.ndarray) -> np.ndarray:
    data[-300:, 2] = np.radians(100.5)
    return data


@pytest.mark.parametrize("method", ["radau5", "time_stepping"])
def test_points_below_surfaces_and_joints_beyond_stops_are_found(method: str) -> None:
    run = _run(method)
    assert run.record is not None
    tip = run.record["contact_mode"][60, run.record.labels["contact_mode"].index("tip")]
    assert tip > 0
    assert "gaps" in _kinds(_spoilt(run, q=_below))
    assert "stops" in _kinds(_spoilt(run, q=_beyond_its_stop))


def test_wrong_currents_of_circuits_are_found() -> None:
    """Sample four times as densely, which resolves L/R = 1.5 ms."""
    settings = {**deepcopy(ARM), "duration_s": 0.1, "record": {"rate_hz": 4000.0}, "integrator": {"method": "radau5"}}
    run = _simulated(settings)
    assert problems(settings, run) == []
    assert "circuit" in _kinds(_spoilt(run, voltage=_times(1.1)))


def test_a_start_that_is_not_in_equilibrium_is_found() -> None:
    settings = {**deepcopy(ARM), "initial": {"equilibrium": True}, "integrator": {"method": "radau5"}}
    del settings["objects"], settings["loads"]["lean"]
    run = _simulated(settings)
    assert problems(settings, run) == []
    assert "equilibrium" in _kinds(_spoilt(run, vdot=_shifted(1.0, 0, 1)))


def test_wrong_wheel_loads_are_found() -> None:
    arm = {"type": "serial_arm", "chain": [{"axis": "y", "length_m": 0.3, "mass_kg": 0.5, "initial_deg": 30.0}]}
    settings = {
        "name": "mobile",
        "duration_s": 0.1,
        "plant": {"type": "pws_arm", "base": {}, "arm": arm},
        "contacts": {"law": "unilateral"},
        "integrator": {"method": "radau5"},
        "record": {"rate_hz": 1000.0},
        "metrics": {"settle_s": 0.0},
    }
    run = _simulated(settings)
    assert problems(settings, run) == []
    assert "support" in _kinds(_spoilt(run, wheel_load=_times(1.05)))


def test_a_check_that_disagrees_with_the_run_is_found() -> None:
    assert "check" in _kinds(replace(_run("radau5"), checked="refused"))


@cache
def _unique(method: str, friction: float) -> Run:
    """Return the arm without objects and dry friction, so that forces are unique."""
    settings = deepcopy(ARM)
    del settings["objects"], settings["loads"]["lean"], settings["plant"]["chain"][1]["friction_N_m"]
    settings["contacts"]["friction"] = friction
    settings["integrator"] = {"method": method}
    return _simulated(settings)


@pytest.mark.parametrize("stranger", ["", "dopri5", "radau5", "time_stepping"])
def test_runs_of_a_scene_agree_and_strangers_do_not(stranger: str) -> None:
    runs = {name: _unique(name, 0.1 if name == stranger else 0.3) for name in ("dopri5", "radau5", "time_stepping")}
    assert {problem.kind for problem in compare(ARM, runs)} == ({"methods"} if stranger else set())


# Kinds of stops that cannot occur in a benign scene.
@pytest.mark.parametrize("kind", ["chatter", "no_progress", "not_projected", "forces_reversed", "no_contact_forces"])
def test_a_stop_without_reason_is_found(kind: str) -> None:
    run = _run("radau5")
    assert run.record is not None
    state = {name: run.record[name][-1].tolist() for name in ("q", "v", "current")}
    stop = SimulationStopped("stopped", time=float(run.record.time[-1]), state=state, kind=kind)
    assert "verdict" in _kinds(replace(run, error=stop))


@pytest.mark.parametrize(("share", "crawls"), [(0.1, True), (10.0, False)])
def test_a_run_that_crawls_to_its_wall_limit_is_found(share: float, crawls: bool) -> None:
    """The run is half-way, with a last step of that fraction of the mean step."""
    run = _run("radau5")
    assert run.record is not None
    state = {name: run.record[name][-1].tolist() for name in ("q", "v", "current")}
    half = 0.5 * float(run.scenario["duration_s"])
    step = share * half / int(run.record.summary["steps"])
    stop = SimulationStopped(LAST_STEP.replace(NUMBER, f"{step:.1e}"), time=half, state=state, kind="out_of_time")
    assert ("verdict" in _kinds(replace(run, error=stop))) == crawls


@pytest.mark.parametrize("law", ["unilateral", "bilateral"])
@pytest.mark.parametrize("wrong", ["", "time", "speed", "step", "method"])
@pytest.mark.parametrize("kind", ["out_of_time", "no_progress"])
def test_a_run_that_stiff_friction_holds_up_is_true_to_its_words(law: str, wrong: str, kind: str) -> None:
    settings = yaml.safe_load((Path(__file__).parents[1] / "data" / "endless" / "creeping_block.yaml").read_text())
    settings["contacts"] |= {"law": law} | ({"slip_smoothing_m_s": 1e-7} if law == "bilateral" else {})
    run = _simulated(settings)
    stop = run.error
    assert isinstance(stop, SimulationStopped)
    assert stop.kind == "out_of_time"
    text, summary = str(stop), run.record.summary if run.record is not None else {}
    if wrong == "method":
        summary["method"] = "radau5"
    elif wrong:
        holds_up = re.search(HOLDS_UP, text)
        assert holds_up is not None
        begin, end = holds_up.span({"step": 1, "speed": 3, "time": 4}[wrong])
        text = f"{text[:begin]}{2.5 * float(text[begin:end]):.3g}{text[end:]}"
    said = SimulationStopped(text, time=stop.time, state=stop.state, kind=kind)
    assert ("verdict" in _kinds(replace(run, error=said))) == bool(wrong)


def test_critical_friction_finds_a_true_paradox() -> None:
    """Painlevé's rod: slender, sliding on its tip at 60°, μ above the critical 4/3 of I = m l²/12."""
    rod = {
        "name": "rod",
        "duration_s": 0.3,
        "plant": {
            "type": "serial_arm",
            "chain": [
                {"kind": "prismatic", "axis": "x", "length_m": 0.0, "mass_kg": 0.0},
                {"kind": "prismatic", "axis": "z", "length_m": 0.0, "mass_kg": 0.0},
                {"axis": "y", "length_m": 1.0, "mass_kg": 1.0, "initial_deg": 30.0},
            ],
        },
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {"law": "unilateral", "friction": 3.0, "points": {"tip": {"body": "link_3", "surface": "floor"}}},
        "record": {"rate_hz": 200.0},
        "metrics": {"settle_s": 0.0},
    }
    run = _simulated(rod)
    assert run.record is not None
    seen = Observed(run)
    v = np.zeros(3)
    paradox = {}
    for speed in (1.0, -1.0):
        v[0] = speed
        paradox[speed] = critical(seen, {"q": seen.robot.initial.tolist(), "v": v.tolist()})
    # A paradox occurs in one direction of the slip only.
    assert sorted(paradox.values()) == [False, True]


def test_critical_friction_has_a_sign_for_each_glued_contact() -> None:
    """Two points whose determinant vanishes only if one of them pulls and the other is pushed."""
    bare = np.array([[0.0976, 0.0689], [0.0689, 0.1714]])
    friction = np.array([[-0.0120, -0.0279], [0.0556, 0.0306]])
    normals = np.linalg.cholesky(bare)
    tangents = np.linalg.solve(normals, friction).T
    rows = [np.stack([n, t, np.zeros(2)]) for n, t in zip(normals, tangents, strict=True)]
    slip, ones, none = [np.array([1.0, 0.0])] * 2, [1.0, 1.0], np.zeros(2)
    gaps = [0.0, 0.0]
    state = State(none, none, none, np.eye(2), ["a", "b"], rows, gaps, slip, ones, gaps, ones, [], [], none, [])
    assert _paradox(state, [0, 1], np.eye(2), (1.0, -1.0))
    for sign in (1.0, -1.0):
        assert not _paradox(state, [0, 1], np.eye(2), (sign,))


@pytest.mark.parametrize("warning", FALSE_WARNINGS)
def test_a_false_warning_is_found(warning: str) -> None:
    run = _run("radau5")
    # Some check verifies it, but for the last one.
    assert any(re.search(pattern, warning) for pattern in SENTENCES.values()) == (warning != FALSE_WARNINGS[-1])
    assert "verdict" in _kinds(replace(run, warnings=[*run.warnings, warning]))


@pytest.mark.parametrize("seed", range(5))
def test_bodies_agree_with_pinocchio(seed: int) -> None:
    random = np.random.default_rng(seed)
    robot = random_robot(random, 7)
    q, v, vdot = (random.normal(size=(1, 7)) for _ in range(3))
    bodies, oracle = Bodies(robot), Oracle(robot)
    motion = bodies.motion(q, v, vdot)
    forces = oracle.back(pin.rnea(oracle.model, oracle.data, *(oracle.to(x[0]) for x in (q, v, vdot))))
    # Rounding of two codes.
    np.testing.assert_allclose(
        bodies.along_rows(motion, bodies.wrenches(motion))[0], forces, rtol=0, atol=1e-11 * (1.0 + np.abs(forces).max())
    )
    np.testing.assert_allclose(
        bodies.mass_matrix(q[0]) - np.diag(bodies.armature), oracle.mass_matrix(q[0]), rtol=0, atol=1e-11
    )
    point = random.normal(size=3)
    position, J, velocity, _ = oracle.point(6, point, q[0], v[0])
    np.testing.assert_allclose(motion.point(6, point)[0], position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(bodies.jacobian(motion, 6, position[None])[0], J, rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion.velocity(6, position[None])[0], velocity, rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", ["ball", "floating", "planar", "rolling"])
def test_joints_with_several_rows_move_as_their_rates_say(kind: str) -> None:
    """Compare velocities and accelerations with differences of positions and velocities."""
    random = np.random.default_rng(3)
    robot = random_robot_of(random, [kind, "revolute"])
    bodies = Bodies(robot)
    q = random_positions(random, robot)
    v, vdot = random.normal(size=(2, bodies.n))
    h = 1e-4
    # Two steps of constant acceleration in each direction, positions by the midpoint rule.
    states = [(q, v)]
    for sign in (-1.0, 1.0):
        middle = q + 0.5 * sign * h * position_rates(bodies, q[None], v[None])[0]
        states.append(
            (
                q + sign * h * position_rates(bodies, middle[None], v[None] + 0.5 * sign * h * vdot)[0],
                v + sign * h * vdot,
            )
        )
    now, before, after = (bodies.motion(a[None], b[None], vdot[None]) for a, b in states)
    body, point = bodies.n - 1, random.normal(size=3)
    places = [motion.point(body, point) for motion in (before, now, after)]
    velocities = [motion.velocity(body, motion.point(body, point)) for motion in (before, now, after)]
    # Error of a central difference.
    np.testing.assert_allclose((places[2] - places[0]) / (2 * h), velocities[1], rtol=0, atol=1e-5)
    gain = now.rushing[body] + np.cross(now.turning[body], places[1]) + np.cross(now.spin[body], velocities[1])
    np.testing.assert_allclose((velocities[2] - velocities[0]) / (2 * h), gain, rtol=0, atol=1e-5)


def test_own_nearest_points_are_nearest() -> None:
    """Compare axes near a box and a sphere with a fine search; distances from a box with those from its faces."""
    random = np.random.default_rng(0)
    box = shape({"type": "box", "center_m": [0, 0, 0], "edges_m": [1, 2, 3], "edge_radius_m": 0.1}, np.zeros(3))
    assert box.distance(np.array([[0.7, 0.0, 0.0], [0.0, -1.5, 0.0]])) == pytest.approx([0.2, 0.5])
    sphere = shape({"type": "sphere", "center_m": [0, 0, 0], "radius_m": 1.0}, np.zeros(3))
    for surface in (box, sphere):
        start, end = random.normal(scale=3.0, size=(2, 50, 3))
        far = surface.distance(nearest(surface, start, end))
        many = [surface.distance(start + u * (end - start)) for u in np.linspace(0.0, 1.0, 2001)]
        outside = np.min(many, axis=0) > 0.0
        assert (far[outside] <= np.min(many, axis=0)[outside] + 1e-9).all()


def test_the_last_step_ends_with_the_run() -> None:
    """A shorter last step has a separate midpoint, and its forces act along the normal there."""
    settings: dict[str, Any] = deepcopy(ARM)
    settings |= {"duration_s": 0.1008, "record": {"rate_hz": 2000.0}}
    settings["surfaces"] = {"floor": {"type": "sphere", "center_m": [0.4, 0.0, -0.33], "radius_m": 0.25}}
    settings["contacts"]["friction"] = 0.0
    settings["initial"] = {"on_surface": ["tip"]}
    # Steps end where constant loads do, which is also the end of the run.
    del settings["plant"]["link"]["motor"], settings["controller"], settings["loads"]
    settings["integrator"] = {"method": "time_stepping", "step_s": 0.001}
    seen = Observed(_simulated(settings))
    start, end = seen.steps_around
    np.testing.assert_allclose(seen.time[-3:], [0.1, 0.1005, 0.1008])
    np.testing.assert_allclose(start[-3:], [0.099, 0.1, 0.1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(end[-3:], [0.1, 0.1008, 0.1008], rtol=0, atol=1e-12)
    (touch,) = (touch for touch in seen.touches() if touch.contact.name == "tip")
    normal = seen._at_midpoints(touch.contact, seen.v_start)[2]
    # Within the step the normal turns by far more than the tolerance.
    assert touch.normal_force[-1] > 1.0
    assert touch.turned[-1] > 1e-3
    np.testing.assert_allclose(touch.force, touch.normal_force[:, None] * normal, rtol=0, atol=1e-9)


# A body that slides along x and z on a plane that leans sideways by 1 in 2: friction wedges it from 2 on.
WEDGING = {
    "name": "wedge",
    "duration_s": 0.05,
    "plant": {
        "type": "serial_arm",
        "gravity_m_s2": [30, 0, -10],
        "link": {"length_m": 0},
        "chain": [{"kind": "prismatic", "axis": "x", "mass_kg": 0}, {"kind": "prismatic", "axis": "z", "mass_kg": 1}],
    },
    "surfaces": {"slope": {"type": "plane", "normal": [0, 1, 2]}},
    "contacts": {
        "law": "unilateral",
        "points": {"foot": {"body": "link_2", "point_m": [0, 0, 0], "surface": "slope"}},
    },
    "integrator": {"method": "time_stepping"},
}


def test_warnings_of_wedging_are_checked_both_ways() -> None:
    settings = deepcopy(WEDGING)
    settings["contacts"]["friction"] = 2.1
    run = _simulated(settings)
    seen = Observed(run)
    assert not list(untrue(settings, run, seen))
    (missing,) = untrue(settings, replace(run, warnings=[]), seen)
    assert "foot can wedge itself against slope, without a warning" in missing
    wedge = re.search(WEDGE, run.warnings[0])
    assert wedge is not None
    assert wedge[2] == "2"
    less = f"{run.warnings[0][: wedge.start(2)]}1.9{run.warnings[0][wedge.end(2) :]}"
    (wrong,) = untrue(settings, replace(run, warnings=[less]), seen)
    assert "foot can wedge itself from a coefficient of 2 on" in wrong
    settings["contacts"]["friction"] = 1.9
    run = _simulated(settings)
    assert not run.warnings
    assert not list(untrue(settings, run, Observed(run)))
