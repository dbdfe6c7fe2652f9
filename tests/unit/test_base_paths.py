"""Paths of a mobile base: closed forms, independent integration, and refusal of paths that no base can follow."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.messages import raises

from dynsim.compile.control import JointControl
from dynsim.compile.model import Model
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.splines import rolled
from dynsim.engine.prepare import prepare
from dynsim.errors import ModelError, ScenarioError, UnreachableReference
from dynsim.library.controllers import joint_pd
from dynsim.model.base_pose import base_pose
from dynsim.scenario import build, load_scenario

DURATION, HEADING, PLACE = 10.0, np.deg2rad(30.0), np.array([0.4, -0.7])
TIMES = np.linspace(0.0, DURATION, 501)


@pytest.fixture(scope="module")
def model() -> Model:
    """A base that starts off the origin and turned, so that an exchange of frames shows."""
    base = {"plant.base.position_m": PLACE.tolist(), "plant.base.heading_deg": 30}
    disabled = {f"contacts.points.elbow_{k}.enabled": False for k in (4, 7)}
    return build.build_model(load_scenario("mobile_elbow_comparison", overrides=base | disabled))


def following(model: Model, path: dict[str, Any], **more: Any) -> JointControl:
    config = joint_pd.Config(type="joint_pd", base={"path": path}, **more)
    return joint_pd.build(config, BuildContext(DURATION, model))


def poses(model: Model, control: JointControl) -> tuple[np.ndarray, np.ndarray]:
    """Times and x, y, heading of the references of the base."""
    times, q = (np.concatenate(pieces) for pieces in zip(*control.positions(model.robot), strict=True))
    return times, base_pose(model.robot, q)


def seen(pose: np.ndarray) -> np.ndarray:
    """Poses in the frame of the base at its start."""
    c, s = np.cos(HEADING), np.sin(HEADING)
    return np.hstack([(pose[:, :2] - PLACE) @ np.array([[c, -s], [s, c]]), pose[:, 2:] - HEADING])


def jerk_law(t: np.ndarray, start: float, duration: float) -> np.ndarray:
    """The boundary value problem s⁗⁗ = 0 with s, ṡ, s̈ = 0 and 1, 0, 0 at the ends, solved as a linear system."""
    powers = np.arange(6)
    at_end = np.array([np.ones(6), powers, powers * (powers - 1)])
    coefficients = np.concatenate([np.zeros(3), np.linalg.solve(at_end[:, 3:], [1.0, 0.0, 0.0])])
    x = np.clip((t - start) / duration, 0.0, 1.0)
    return np.polynomial.polynomial.polyval(x, coefficients)


@pytest.mark.parametrize("distance", [0.2, -0.35])
def test_straight_is_minimum_jerk_along_the_heading(model: Model, distance: float) -> None:
    path = {"type": "straight", "distance_m": distance, "duration_s": 6, "start_s": 2}
    times, pose = poses(model, following(model, path))
    x, y, turn = seen(pose).T
    # Ends of the motion are knots; the spline through them errs by h³ times the jump of the jerk.
    assert np.abs(x - distance * jerk_law(times, 2.0, 6.0)).max() < 1e-8
    assert max(np.abs(y).max(), np.abs(turn).max()) < 1e-13


@pytest.mark.parametrize(("radius", "angle"), [(0.5, 90.0), (-0.3, -250.0), (0.4, -60.0), (0.0, 400.0)])
def test_an_arc_stays_on_its_circle(model: Model, radius: float, angle: float) -> None:
    path = {"type": "arc", "radius_m": radius, "angle_deg": angle, "duration_s": DURATION}
    times, pose = poses(model, following(model, path))
    x, y, turn = seen(pose).T
    assert np.abs(turn - np.deg2rad(angle) * jerk_law(times, 0.0, DURATION)).max() < 1e-10
    assert np.abs(x - radius * np.sin(turn)).max() < 1e-12
    assert np.abs(y - radius * (1.0 - np.cos(turn))).max() < 1e-12


def test_the_wheels_of_an_arc_roll_on_circles_of_their_own(model: Model) -> None:
    """Left and right wheel go (R ∓ T/2) α on circles about the same centre."""
    R, T, r = 0.5, 0.3, 0.05
    control = following(model, {"type": "arc", "radius_m": R, "angle_deg": 90, "duration_s": 5})
    _, q = (np.concatenate(pieces) for pieces in zip(*control.positions(model.robot), strict=True))
    assert q[-1, :2] == pytest.approx([(R - T / 2) * np.pi / 2 / r, (R + T / 2) * np.pi / 2 / r], rel=1e-12)


S_CURVE = {
    "type": "waypoints",
    "times_s": [0.5, 3, 6, 9],
    "points_m": [[0, 0], [0.4, 0.15], [0.8, -0.1], [1.3, 0.05]],
    "frame": "start",
}


def in_world(points: Any) -> np.ndarray:
    c, s = np.cos(HEADING), np.sin(HEADING)
    return PLACE + np.asarray(points) @ np.array([[c, s], [-s, c]])


@pytest.mark.parametrize("frame", ["start", "world"])
def test_waypoints_are_met_on_time_with_the_heading_along_the_curve(model: Model, frame: str) -> None:
    path = S_CURVE | {"frame": frame}
    if frame == "world":
        path["points_m"] = in_world(S_CURVE["points_m"]).tolist()
    times, pose = poses(model, following(model, path))
    # The end of a segment is the begin of the next.
    once = np.append(np.diff(times) > 1e-9, True)
    times, pose_seen = times[once], seen(pose)[once]
    for t, point in zip(S_CURVE["times_s"], S_CURVE["points_m"], strict=True):
        # Where the curvature bends, at the points, the spline through the knots does not: tens of nanometres.
        assert pose_seen[np.abs(times - t).argmin(), :2] == pytest.approx(point, abs=5e-8)
    standing = (times < 0.45) | (times > 9.05)
    assert np.abs(np.diff(pose_seen[standing & (times < 5)], axis=0)).max() < 1e-7
    speed = np.gradient(pose_seen[:, 0], times), np.gradient(pose_seen[:, 1], times)
    moving = np.hypot(*speed) > 0.02
    off = np.arctan2(speed[1], speed[0]) - pose_seen[:, 2]
    assert np.abs(off[moving]).max() < 1e-2


def test_two_waypoints_ahead_are_minimum_jerk(model: Model) -> None:
    path = {"type": "waypoints", "times_s": [1, 9], "points_m": [[0, 0], [0.5, 0]], "frame": "start"}
    times, pose = poses(model, following(model, path))
    assert np.abs(seen(pose)[:, 0] - 0.5 * jerk_law(times, 1.0, 8.0)).max() < 1e-8


@pytest.mark.parametrize(
    "path",
    [
        {"type": "straight", "distance_m": 0.5, "duration_s": 4, "start_s": 1.234},
        {"type": "arc", "radius_m": -0.2, "angle_deg": 200, "duration_s": 7},
        S_CURVE,
    ],
)
def test_wheel_angles_integrate_back_to_the_path(model: Model, path: dict[str, Any]) -> None:
    """ẋ = V cos ψ, ẏ = V sin ψ by another integrator, V and ω from the slopes of the wheels' references."""
    control = following(model, path)
    base, reference = model.robot.base, control.reference
    assert base is not None
    h = float(reference.grid[1])
    # Columns are in the order in which references are given, and motors have theirs.
    columns = [int(reference.spline[k]) for k in (0, 1)]

    def rates(t: float) -> np.ndarray:
        k = min(int(t / h), len(reference.coefficients) - 1)
        cubic = reference.coefficients[k, columns]
        return cubic[:, 1:] * np.arange(1, 6) @ (t - k * h) ** np.arange(5)

    def pose_rates(t: float, pose: np.ndarray) -> list[float]:
        left, right = rates(t)
        V, omega = base.wheel_radius * (left + right) / 2, base.wheel_radius * (right - left) / base.track
        return [V * np.cos(pose[2]), V * np.sin(pose[2]), omega]

    solution = solve_ivp(
        pose_rates, (0.0, DURATION), [*PLACE, HEADING], "DOP853", TIMES, rtol=1e-12, atol=1e-13, max_step=h
    )
    times, pose = poses(model, control)
    at_knots = np.concatenate([[0], np.arange(4, len(times), 5)])
    assert np.array_equal(np.round(times[at_knots], 9), np.round(TIMES, 9))
    assert np.abs(pose[at_knots] - solution.y.T).max() < 1e-10


def test_rolled_is_exact_where_the_wheels_turn_fast() -> None:
    """Radians within one segment, at constant rates: a circle."""
    robot = build.robot(load_scenario("mobile_elbow_comparison"))
    base = robot.base
    assert base is not None
    coefficients = np.zeros((2, 2, 6))
    V, omega, h = 0.3, 3.0, 0.5
    rates = (V + np.array([-0.5, 0.5]) * omega * base.track) / base.wheel_radius
    for k in (0, 1):
        coefficients[k, :, :2] = np.stack([rates * k * h, rates], axis=1)
    ways = rolled(base, np.array([1.0, 2.0]), coefficients, h, pieces=2)
    t = h * np.array([[0, 0.5, 1], [1, 1.5, 2]])
    expected = np.stack([1 + V / omega * np.sin(omega * t), 2 + V / omega * (1 - np.cos(omega * t))], axis=-1)
    assert np.abs(ways - expected).max() < 1e-12


def csv(folder: Path, header: str, rows: np.ndarray, fmt: str = "%.12g") -> str:
    file = folder / "drive.csv"
    np.savetxt(file, rows, fmt=fmt, delimiter=",", header=header, comments="")
    return str(file)


def test_rates_of_a_file_are_integrated(model: Model, tmp_path: Path) -> None:
    """V and ω rise and fall as sin² does; beyond the file the base rests."""
    t = np.linspace(1.0, 8.0, 351)
    V, omega = 0.1, 0.3
    course = np.sin(np.pi * (t - 1.0) / 7.0) ** 2
    file = csv(tmp_path, "t_s,V_m_s,omega_rad_s", np.stack([t, V * course, omega * course], axis=1))
    times, pose = poses(model, following(model, {"type": "csv", "file": file}))
    x, y, turn = seen(pose).T
    inside = np.clip(times, 1.0, 8.0) - 1.0
    closed = omega * (inside / 2.0 - 7.0 / (4.0 * np.pi) * np.sin(2.0 * np.pi * inside / 7.0))
    # PCHIP flattens what lies next to an extremum: its error is of second order there.
    assert np.abs(turn - closed).max() < 2e-6
    # V and ω have one ratio, so that the path is a circle whatever their course.
    assert np.abs(x - V / omega * np.sin(turn)).max() < 1e-8
    assert np.abs(y - V / omega * (1 - np.cos(turn))).max() < 1e-8
    assert np.ptp(turn[times > 8.05]) < 1e-9


@pytest.mark.parametrize("decimals", [12, 5])
def test_places_of_a_file_are_gone_through_with_their_timing(model: Model, tmp_path: Path, decimals: int) -> None:
    """Rows of a smooth S with a stop in it, also as other programs round them."""
    t = np.linspace(0.0, 9.0, 451)
    u = 0.6 * (jerk_law(t, 0.0, 4.0) + jerk_law(t, 5.0, 4.0))
    rows = np.stack([t, *in_world(np.stack([u, 0.1 * (1 - np.cos(5.0 * u))], axis=1)).T], axis=1)
    file = csv(tmp_path, "t_s,x_m,y_m", rows, fmt=f"%.{decimals}f")
    rows[0, 1:] = PLACE
    times, pose = poses(model, following(model, {"type": "csv", "file": file}))
    expected = np.stack([np.interp(times, t, column) for column in rows[:, 1:].T], axis=1)
    assert np.abs(pose[:, :2] - expected).max() < (2e-5 if decimals == 12 else 2e-4)
    waiting = (times > 4.1) & (times < 4.9)
    assert np.ptp(pose[waiting], axis=0).max() < 1e-5


@pytest.mark.parametrize("frame", ["start", "world"])
def test_a_corner_in_a_file_is_refused_with_its_place(model: Model, tmp_path: Path, frame: str) -> None:
    u = np.linspace(0.0, 1.0, 101)
    points = np.stack([np.minimum(u, 0.6), np.maximum(u - 0.6, 0.0)], axis=1)
    written = in_world(points) if frame == "world" else points
    file = csv(tmp_path, "t_s,x_m,y_m", np.column_stack([9 * u, written]))
    x, y = written[60]
    with raises(ModelError, "controller.base.path", "drive.csv", "61", f"({x:g}, {y:g})", "5.4 s", "90°") as refused:
        following(model, {"type": "csv", "file": file, "frame": frame})
    assert "\n" not in str(refused.value)


def test_a_reversal_is_a_corner(model: Model) -> None:
    """The curve through points there and back has a cusp or none; there it is refused, whatever the spline does."""
    points = [[0, 0], [0.5, 0], [1.0, 0], [0.5, 0], [0.2, 0]]
    path = {"type": "waypoints", "times_s": [0, 2, 4, 6, 8], "points_m": points, "frame": "start"}
    with raises(ModelError, "controller.base.path", "2", "(1, 0)", "4 s", "180°"):
        following(model, path)


def test_a_cusp_between_points_is_a_corner(model: Model) -> None:
    """Points whose chords turn by less than half a turn, and whose spline comes to a stop in its parameter."""
    bend = np.deg2rad(179.9)
    points = [[0, 0], [0.5, 0], [0.5 + 0.5 * np.cos(bend), 0.5 * np.sin(bend)]]
    path = {"type": "waypoints", "times_s": [0, 2, 4], "points_m": points, "frame": "start"}
    with raises(ModelError, "controller.base.path", re.compile(r"\b\d \(.*\) m, t = \d s\b"), re.compile(r"\b17\d°")):
        following(model, path)


BAD = {
    "too sharp": (
        {"type": "arc", "radius_m": 0.1, "angle_deg": 90, "duration_s": 0.1, "start_s": 1},
        ("0.2 rad", "controller.knot_spacing_s", re.compile(r"\b1\.0\d0 s\b")),
    ),
    "sideways": (
        {"type": "waypoints", "times_s": [0, 5], "points_m": [[0, 0], [0, 1]], "frame": "start"},
        ("1", "(0, 1)", "5 s", "90°"),
    ),
    "too near": (
        {"type": "waypoints", "times_s": [0, 1, 2], "points_m": [[0, 0], [9e9, 0], [9e9, 1e-9]], "frame": "start"},
        ("2", "(9e+09, 1e-09)", "2 s"),
    ),
    "elsewhere": (
        {"type": "waypoints", "times_s": [0, 5], "points_m": [[0, 0], [1, 1]]},
        ("0", "(0, 0)", "0 s", "0.8062 m"),
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_path_that_begins_otherwise_than_the_base_is_refused(model: Model, name: str) -> None:
    path, names = BAD[name]
    with raises(ModelError, "controller.base.path", *names):
        following(model, path)


def test_a_file_that_moves_off_sideways_or_nowhere_is_refused(model: Model, tmp_path: Path) -> None:
    t = np.linspace(0.0, 5.0, 51)
    sideways = csv(tmp_path, "t_s,x_m,y_m", np.stack([t, 0 * t, 0.1 * t], axis=1))
    with raises(ModelError, "controller.base.path", "drive.csv", "2", "(0, 0.01)", "0.1 s", "90°", "15°"):
        following(model, {"type": "csv", "file": sideways, "frame": "start"})
    nowhere = csv(tmp_path, "t_s,x_m,y_m", np.stack([t, 0 * t, 0 * t], axis=1))
    with raises(ModelError, "controller.base.path", "drive.csv", "0.001 m"):
        following(model, {"type": "csv", "file": nowhere, "frame": "start"})


@pytest.mark.parametrize(
    ("path", "names"),
    [
        ({"type": "straight", "distance_m": 1, "duration_s": 0}, "controller.base.path.duration_s = 0"),
        (
            {"type": "arc", "radius_m": 1, "angle_deg": 1, "duration_s": 1, "start_s": -1},
            "controller.base.path.start_s = -1",
        ),
        ({"type": "waypoints", "times_s": [0, 1, 1], "points_m": [[0, 0]] * 3}, "controller.base.path times_s"),
        (
            {"type": "waypoints", "times_s": [0, 1], "points_m": [[0, 0]] * 3},
            "controller.base.path 2 times_s 3 points_m",
        ),
        ({"type": "waypoints", "times_s": [0, 1], "points_m": [[0, 0]] * 2}, "controller.base.path points_m"),
        (
            {"type": "waypoints", "times_s": [-1, 1], "points_m": [[0, 0], [1, 0]]},
            "controller.base.path.times_s.0 = -1",
        ),
        ({"type": "zigzag"}, "controller.base.path.type arc csv hold straight waypoints"),
        ({"type": "csv", "file": "nowhere.csv"}, "nowhere.csv"),
    ],
)
def test_bad_keys_are_one_line_of_a_scenario(path: dict[str, Any], names: str) -> None:
    with raises(ScenarioError, *names.split()) as refused:
        load_scenario("mobile_elbow_comparison", overrides={"controller.base.path": path})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("t_s,x_m\n0,0\n1,1\n", "drive.csv:1 't_s,x_m' t_s,x_m,y_m t_s,V_m_s,omega_rad_s"),
        ("t_s,V_m_s,omega_rad_s\n-1,0,0\n1,1,0\n", "drive.csv -1"),
        ("t_s,V_m_s,omega_rad_s\n0,1e300,0\n1,1,0\n", "drive.csv"),
    ],
)
def test_bad_files_are_one_line_of_a_scenario(content: str, names: str, tmp_path: Path) -> None:
    file = tmp_path / "drive.csv"
    file.write_text(content)
    with raises(ScenarioError, "controller.base.path", *names.split()) as refused:
        load_scenario("mobile_elbow_comparison", overrides={"controller.base.path": {"type": "csv", "file": str(file)}})
    assert "\n" not in str(refused.value)


def test_a_plant_without_a_mobile_base_has_no_path_for_one() -> None:
    overrides = {"controller.base": {"path": {"type": "hold"}}}
    scenario = load_scenario("elbow_comparison", overrides=overrides)
    with raises(ModelError, "controller.base", "pws_arm"):
        build.controller(scenario, build.build_model(scenario))


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        ({"plant.base.wheel.motor": None}, ("controller.base", "base.left", "plant.base.wheel.motor")),
        (
            {"plant.base.wheel.motor": {"type": "torque", "limit_N_m": 1}, "controller.k_p_V_per_rad": 500},
            ("controller.base", "base.left", "torque"),
        ),
        (
            {"controller.joints": {"base.right": {"times_s": [0, 1], "angles_deg": [0, 5]}}},
            ("controller", "base.right"),
        ),
        ({"controller.hand.joints": ["base.left", "joint_9", "joint_10"]}, ("controller", "base.left")),
    ],
)
def test_wheels_that_cannot_follow_are_refused(overrides: dict[str, Any], names: tuple[str, ...]) -> None:
    scenario = load_scenario("mobile_elbow_comparison", overrides=overrides)
    with raises(ModelError, *names):
        build.controller(scenario, build.build_model(scenario))


def test_a_base_that_holds_has_no_moving_references() -> None:
    """The same control as without ``controller.base``."""
    scenario = load_scenario("mobile_elbow_comparison")
    model = build.build_model(scenario)
    held = build.controller(scenario, model).reference
    none = load_scenario("mobile_elbow_comparison", overrides={"controller.base": None})
    for table, other in zip(held, build.controller(none, model).reference, strict=True):
        assert np.array_equal(table, other)


@pytest.mark.parametrize(
    "path",
    [
        {"type": "straight", "distance_m": 0.2, "duration_s": 10},
        {"type": "arc", "radius_m": 0.5, "angle_deg": 25, "duration_s": 8, "start_s": 1},
        {"type": "waypoints", "times_s": [0, 5, 10], "points_m": [[0, 0], [0.1, 0.02], [0.2, 0.0]], "frame": "start"},
    ],
)
def test_the_hand_stays_on_its_path_in_the_world_while_the_base_drives(path: dict[str, Any]) -> None:
    scenario = load_scenario("mobile_elbow_comparison_driving", overrides={"controller.base.path": path})
    model = build.build_model(scenario)
    control = build.controller(scenario, model)
    times, q = (np.concatenate(pieces) for pieces in zip(*control.positions(model.robot), strict=True))
    body, point = model.robot.hand
    hand = np.array([model.point_position(body, point, posture) for posture in q])
    target = control.target(times)
    assert target is not None
    knots = np.isclose(times / 0.02, np.round(times / 0.02))
    tolerance = scenario.controller.hand.tolerance_m
    assert np.abs(hand - target)[knots].max() < 1e-2 * tolerance
    assert np.abs(hand - target).max() < tolerance
    circle = np.array([1.5 + 0.1 * np.cos(0.2 * np.pi * times), 1.5 + 0.1 * np.sin(0.2 * np.pi * times)]).T
    assert np.abs(target[:, :2] - circle).max() < 1e-12
    # The base's own way, so that it did move: the end of its path.
    assert np.hypot(*(base_pose(model.robot, q)[-1, :2])) > 0.15


def test_a_hand_out_of_reach_of_a_base_that_drives_is_refused() -> None:
    overrides = {"controller.base.path": {"type": "straight", "distance_m": -1.0, "duration_s": 10}}
    scenario = load_scenario("mobile_elbow_comparison_driving", overrides=overrides)
    with raises(
        UnreachableReference, "controller.hand.path", "joint_1, joint_9, joint_10", re.compile(r"\bt = \d\.\d+ s\b")
    ):
        build.controller(scenario, build.build_model(scenario))


def test_contacts_of_the_references_move_with_the_base() -> None:
    """The elbows of the references slide along with the base, and stay on the floor."""
    scenario = load_scenario("mobile_elbow_comparison_driving")
    model = build.build_model(scenario)
    control = build.controller(scenario, model)
    _, q = (np.concatenate(pieces) for pieces in zip(*control.positions(model.robot), strict=True))
    elbow = np.array([model.point_position("link_4", np.zeros(3), posture) for posture in q[::50]])
    ahead = (elbow - elbow[0]) @ np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0])
    # Joint 1 turns the arm to the hand's circle; the elbow goes on with the base.
    assert ahead[-1] == pytest.approx(0.2, abs=0.02)
    assert np.abs(elbow[:, 2]).max() < 1e-9


def test_references_that_drive_an_elbow_off_its_surface_are_refused_with_time_and_place() -> None:
    """On a cylinder across the way, the elbow leaves its top as the base drives on; joint 1 holds."""
    name, variant = "mobile_elbow_comparison_driving", "elbow_4"
    model = build.build_model(load_scenario(name, variant))
    elbow = model.point_position("link_4", np.zeros(3), model.robot.initial)
    across = {"type": "cylinder", "axis": [1, -1, 0], "radius_m": 1.0, "point_m": [*elbow[:2].tolist(), -1.0]}
    scenario = load_scenario(name, variant, overrides={"surfaces.floor": across, "controller.hand": None})
    far = np.sqrt((1.0 + scenario.config.contacts.reference_tolerance_m) ** 2 - 1.0)
    fine = np.linspace(0.0, DURATION, 100_001)
    off = fine[np.argmax(0.2 * jerk_law(fine, 0.0, DURATION) > far)]
    with raises(ModelError, "elbow_4", "floor", "contacts.reference_tolerance_m") as refused:
        prepare(scenario)
    off_from = re.findall(r"\bt = ([\d.]+) s\b", str(refused.value))[-1]
    assert float(off_from) == pytest.approx(off, abs=0.006)
