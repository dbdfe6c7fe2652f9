"""Figures of a mobile base, drawn from its record alone."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.messages import mentions, says

import dynsim
from dynsim.draw import figures
from dynsim.draw.figures import arm, base, contacts, energy, posture, style
from dynsim.record import Event, Record, measures
from dynsim.record.joint_motion import export_record, joint_motion
from dynsim.record.measures import percent
from dynsim.record.scene import Scene
from dynsim.scenario import load_scenario

pytestmark = pytest.mark.long

TRACK, CASTER = 0.3, 0.15
ARC = {
    "duration_s": 0.5,
    "record.rate_hz": 130,
    "controller.hand": None,
    "controller.base.path": {"type": "arc", "radius_m": 0.4, "angle_deg": 50, "duration_s": 0.4, "start_s": 0.05},
}


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(style, "DPI", 50)


def run(variant: str, scenario: str = "mobile_elbow_comparison_driving", **overrides: object) -> Record:
    return dynsim.simulate(load_scenario(scenario, variant, {"duration_s": 0.5, "metrics.settle_s": 0.2, **overrides}))


@pytest.fixture(scope="module")
def braced() -> Record:
    return run("two_elbows")


@pytest.fixture(scope="module")
def tipped() -> Record:
    """Without elbows on the floor the base tips over."""
    return run("no_elbow")


@pytest.fixture(scope="module")
def turning() -> Record:
    """A base that drives along an arc, its arm held."""
    return run("no_elbow", **ARC)


def drawn(figure: Figure | None) -> Figure:
    assert figure is not None
    return figure


def texts(figure: Figure) -> str:
    legends = [axes.get_legend() for axes in figure.axes] + list(figure.legends)
    return "\n".join(text.get_text() for legend in legends if legend is not None for text in legend.get_texts())


def in_world(record: Record, x: float, y: float) -> np.ndarray:
    """A point of the base over the ground, (T, 2), from its pose alone."""
    px, py, heading = record["base_pose"].T
    return np.stack([px + x * np.cos(heading) - y * np.sin(heading), py + x * np.sin(heading) + y * np.cos(heading)], 1)


def test_every_figure_of_a_mobile_base(
    braced: Record, tipped: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(style, "save", lambda figure, path: path)  # pictures are written by the next test
    assert {path.stem for path in figures.draw(braced, tmp_path)} == set(arm.FIGURES)
    assert {path.stem for path in figures.draw(tipped, tmp_path)} == set(arm.FIGURES) - {"contact_forces"}
    paths = figures.draw_comparison({"a": braced, "b": tipped}, tmp_path)
    assert {path.stem for path in paths} == set(arm.COMPARISONS)


@pytest.mark.parametrize("samples", [2, 1, 0])
def test_a_run_that_ended_early_is_drawn(tipped: Record, samples: int, tmp_path: Path) -> None:
    record = Record(tipped.time[:samples], provenance=tipped.provenance)
    for name, signal in tipped.signals.items():
        record.add(name, signal.data[:samples].copy(), signal.unit, labels=signal.labels)
    record.scene, record.complete = tipped.scene, False
    assert bool(figures.draw(record, tmp_path)) == bool(samples)


def test_values_that_are_not_finite_are_drawn_around(tipped: Record, tmp_path: Path) -> None:
    record = Record(tipped.time, provenance=tipped.provenance)
    for name, signal in tipped.signals.items():
        data = signal.data.copy()
        data[-3:] = np.nan
        record.add(name, data, signal.unit, labels=signal.labels)
    record.scene = tipped.scene
    assert {"base", "overturning", "base_tracking", "posture"} <= {path.stem for path in figures.draw(record, tmp_path)}


def test_supports_of_the_record_are_where_the_pose_has_them(turning: Record) -> None:
    body, _ = posture.skeleton(turning)
    assert body is not None
    assert [point.name for point in body.scene.supports] == list(turning.labels["wheel_load"])
    for row in (0, len(turning) - 1):
        expected = [in_world(turning, *at)[row] for at in ((0, TRACK / 2), (0, -TRACK / 2), (CASTER, 0))]
        np.testing.assert_allclose(base.support_corners(body, row), expected, atol=1e-7)
    assert [turning.scene.bodies[k].name for k in turning.scene.base] == ["base", "base.left.wheel", "base.right.wheel"]


def test_the_top_view_has_equal_axes_tracks_and_triangles(turning: Record) -> None:
    figure = drawn(base.top_view(turning))
    world = figure.axes[0]
    assert all(axes.get_aspect() == 1.0 for axes in figure.axes[:2])
    lines = {str(line.get_label()): line for line in world.get_lines()}
    left = np.column_stack(lines["wheel tracks"].get_data())
    np.testing.assert_allclose(left, in_world(turning, 0, TRACK / 2), atol=1e-7)
    np.testing.assert_allclose(
        np.column_stack(lines["caster track"].get_data()), in_world(turning, CASTER, 0), atol=1e-7
    )
    triangles = [patch.get_xy()[:3] for patch in world.patches if len(patch.get_xy()) == 4]
    assert len(triangles) > 2
    for corners in triangles:
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        np.testing.assert_allclose(np.sort(sides), np.sort([TRACK, *[math.hypot(TRACK / 2, CASTER)] * 2]), rtol=1e-6)


def test_the_pressure_path_is_cut_at_the_sides_of_the_triangle() -> None:
    corners = np.array([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]])
    at, outside = base.pressure_pieces(np.array([[-1.0, 0.0], [0.5, 0.0], [0.5, 1.0], [0.2, 0.1]]), corners)
    # It comes in at x = 0, goes out at (0.5, 0.5), beyond which it crosses no side, and comes in where y = 1 - x.
    inside = 2.0 + 0.5 / 1.2
    np.testing.assert_allclose(at[~np.isin(at, [0, 1, 2, 3])][[0, 1, -1]], [1.0 / 1.5, 1.5, inside], rtol=1e-12)
    assert outside[at[:-1] < 0.6].all()
    assert not outside[(at[:-1] > 0.6) & (at[:-1] < 1.4)].any()
    assert outside[(at[:-1] > 1.4) & (at[:-1] < inside - 1e-9)].all()
    assert not outside[at[:-1] > inside - 1e-9].any()


def test_outside_of_the_triangle_is_where_the_margin_is_negative(tipped: Record) -> None:
    corners = np.array([[0.0, TRACK / 2], [0.0, -TRACK / 2], [CASTER, 0.0]])
    at, outside = base.pressure_pieces(base.pressure_in_base(tipped), corners)
    # A piece between two samples on the same side of the margin, and cut by none, is on that side too.
    whole = np.flatnonzero((at[:-1] % 1 == 0) & (np.diff(at) == 1))
    rows = at[whole].astype(int)
    negative = tipped["tip_margin"] < 0.0
    same = negative[rows] == negative[rows + 1]
    np.testing.assert_array_equal(outside[whole][same], negative[rows][same])
    assert outside.any()
    assert not outside.all()
    assert says(texts(drawn(base.top_view(tipped))), "outside")


def test_tipping_is_marked_in_every_panel_that_shows_its_time(tipped: Record, turning: Record) -> None:
    figure = drawn(base.overturning(tipped))
    times = {event.time for event in tipped.events if event.kind == base.TIP_OVER}
    assert times
    for axes in figure.axes:
        lines = [part for part in axes.collections if part.get_label() == f"{style.UNLISTED}event"]
        low, high = axes.get_xlim()
        assert {path.vertices[0, 0] for part in lines for path in part.get_paths()} <= times
        assert bool(lines) == any(low <= time <= high for time in times)
    assert mentions(figure.caption, "tip margin falls below 0")
    assert mentions(texts(figure), f"{min(times):.3g} s")
    assert mentions(texts(drawn(base.margin_comparison({"a": tipped, "b": turning}))), f"{min(times):.3g} s")


def test_marks_of_later_times_take_no_room_beside_the_transient() -> None:
    time = np.linspace(0.0, 5.0, 501)
    figure = style.new_figure(3.0, "")
    (panels,) = style.time_rows(figure, [[(time, 1.0 + 50.0 * np.exp(-time / 0.05))]], settle=2.0)
    record = Record(time)
    record.events.extend(Event(at, base.TIP_OVER, "") for at in (0.05, 4.5))
    for axes in panels:
        contacts.mark(axes, contacts.marked(record))
    figure.draw_without_rendering()
    left, right = (axes.get_position() for axes in panels)
    assert right.x0 - left.x1 < 0.1


def test_a_peak_of_the_demand_does_not_hide_the_rest(braced: Record) -> None:
    assert np.nanmax(braced["traction_demand"]) > base.TRACTION_TOP
    figure = drawn(base.overturning(braced))
    columns = len(figure.axes) // 3
    assert all(axes.get_ylim()[1] <= base.TRACTION_TOP for axes in figure.axes[2 * columns :])
    assert mentions(figure.caption, f"{base.TRACTION_TOP:g}")


def test_demand_without_load_is_said_and_no_number(braced: Record) -> None:
    record = copy.deepcopy(braced)
    rows = np.flatnonzero((record.time > 0.1) & (record.time < 0.2))
    record["traction_demand"][rows, 1] = np.inf
    record["traction_demand"][rows + len(rows), 0] = np.nan
    figure = drawn(base.overturning(record))
    text = texts(figure)
    assert mentions(figure.caption, "no load")
    assert "inf" not in text
    assert "nan" not in text
    share = 2 * len(rows) / len(record)
    assert mentions(figure.caption, percent(share))
    finite = record["traction_demand"][np.isfinite(record["traction_demand"])]
    summary = measures.base_summary(record, 0.0, np.zeros(0), np.zeros(len(record)))
    assert summary["traction_demand_max"] == finite.max()


def test_motors_of_wheels_have_names(turning: Record) -> None:
    assert turning.scene is not None
    names = turning.scene.wheel_names
    assert names.keys() == {"base.left", "base.right"}
    record = copy.deepcopy(turning)
    record["current"][:, :2] = 100.0 + record["current"][:, :2]
    named = texts(drawn(energy.motors(record)))
    assert all(name in named for name in names.values())
    assert "base.left" not in named


def test_reference_of_an_arc_is_the_arc(turning: Record) -> None:
    """In closed form: x = R sin ψ, y = R (1 − cos ψ) along the start, ψ = α (10u³ − 15u⁴ + 6u⁵)."""
    u = np.clip((turning.time - 0.05) / 0.4, 0.0, 1.0)
    turn = math.radians(50.0) * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    x, y, start = 0.4 * np.sin(turn), 0.4 * (1.0 - np.cos(turn)), math.radians(45.0)
    expected = [x * np.cos(start) - y * np.sin(start), x * np.sin(start) + y * np.cos(start), start + turn]
    # The reference is a spline with knots at 20 ms, of which the jerk jumps twice.
    np.testing.assert_allclose(turning["base_target"], np.stack(expected, axis=1), atol=1e-4)
    knot = np.isclose(turning.time % 0.02, 0.0, atol=1e-9) | np.isclose(turning.time % 0.02, 0.02, atol=1e-9)
    assert knot.sum() > 3
    np.testing.assert_allclose(turning["base_target"][knot, 2], expected[2][knot], atol=1e-12)


def test_reference_between_the_knots_is_where_the_wheels_would_roll(turning: Record) -> None:
    """Equal to the integral of V cos ψ, V sin ψ on 20 times as many samples, for the references' own wheel angles."""
    from dynsim.engine.prepare import prepare

    scenario = load_scenario("mobile_elbow_comparison_driving", "no_elbow", {"duration_s": 0.5, **ARC})
    prepared = prepare(scenario)
    robot = prepared.model.robot
    t = np.linspace(0.0, 0.5, 20_001)
    target = prepared.control.base_target(robot, t)
    assert target is not None
    coefficients = prepared.control.reference.coefficients
    spacing = prepared.control.reference.grid[1]
    k = np.minimum((t / spacing).astype(int), len(coefficients) - 1)
    rates = np.einsum(
        "scp,sp->sc", coefficients[k][:, :2, 1:] * np.arange(1, 6), (t - k * spacing)[:, None] ** np.arange(5)
    )
    speed = 0.05 * rates.mean(axis=1)
    for column, wave in ((0, np.cos), (1, np.sin)):
        value = speed * wave(target[:, 2])
        # Simpson's rule over pairs of intervals.
        h = t[1] - t[0]
        distance = np.cumsum(h / 3.0 * (value[:-2:2] + 4.0 * value[1:-1:2] + value[2::2]))
        np.testing.assert_allclose(target[2::2, column], distance, atol=1e-9)


def test_no_reference_without_motors_that_follow() -> None:
    record = run("no_elbow", **{**ARC, "controller": None})
    assert "base_target" not in record
    assert base.tracking(record) is None


def test_a_base_that_holds_has_its_start_as_reference() -> None:
    record = run("two_elbows", "mobile_elbow_comparison")
    np.testing.assert_allclose(record["base_target"], np.tile([0.0, 0.0, math.pi / 4], (len(record), 1)), atol=1e-15)


def test_base_error_is_seen_from_the_reference() -> None:
    record = Record([0.0, 1.0])
    record.add("base_target", [[1.0, 2.0, math.pi / 2], [0.0, 0.0, math.pi]], "m, m, rad", labels=("x", "y", "heading"))
    record.add("base_pose", [[1.0, 2.5, math.pi / 2], [0.0, 0.25, 3.0]], "m, m, rad", labels=("x", "y", "heading"))
    np.testing.assert_allclose(base.base_error(record), [[0.5, 0, 0], [0, -0.25, 3.0 - math.pi]], atol=1e-15)


def test_tracking_shows_the_errors_of_the_record(turning: Record) -> None:
    figure = drawn(base.tracking(turning))
    rms = 1e3 * math.sqrt(float(np.mean(base.base_error(turning)[:, 0] ** 2)))
    assert mentions(texts(figure), f"{style.number(rms, 3)} mm")


def test_postures_show_the_base_and_its_wheels(turning: Record) -> None:
    body, _ = posture.skeleton(turning)
    assert body is not None
    at_start, at_end = ([corners for corners, _ in body.solids(row)] for row in (0, len(turning) - 1))
    assert len(at_start) == 4  # plate, ball of the caster, two wheels
    for solid in at_end:
        assert solid[:, 2].min() > -1e-7
    wheels = [solid for solid in at_end if np.ptp(solid[:, 2]) == pytest.approx(0.1, rel=1e-2)]
    middles = np.array([solid.mean(axis=0)[:2] for solid in wheels])
    np.testing.assert_allclose(middles, [in_world(turning, 0, side * TRACK / 2)[-1] for side in (1, -1)], atol=1e-6)
    figure = drawn(posture.posture(turning))
    shown = 2  # at the start and at the end
    assert len(figure.axes[1].patches) == 4 * shown
    extent = figure.axes[1].viewLim
    assert all(extent.contains(*corner) for patch in figure.axes[1].patches for corner in patch.get_xy())
    compared = drawn(posture.posture_comparison({"a": turning, "b": turning}))
    assert [len(axes.patches) for axes in compared.axes] == [4 * shown] * 2


def test_supports_are_apart_from_the_points_that_older_versions_know(braced: Record, tmp_path: Path) -> None:
    text = braced.scene.to_json()
    assert Scene.from_json(text) == braced.scene
    content = json.loads(text)
    assert {point["role"] for point in content["points"]} == {"hand", "contact"}
    del content["supports"]
    older = Scene.from_json(json.dumps(content))
    assert older.supports == ()
    assert older.base == ()


@pytest.mark.parametrize(("rate", "times"), [(1.0, [0.0, 1.0, 1.1]), (2.5, [0.0, 0.4, 0.8, 1.1]), (10.0, None)])
def test_a_resampled_motion_ends_where_its_record_ends(rate: float, times: list[float] | None, tmp_path: Path) -> None:
    """q = t³ over 1.1 s, which cubic Hermite polynomials have exactly."""
    t = np.linspace(0.0, 1.1, 12)
    record = Record(t)
    record.add("q", t[:, None] ** 3, "rad", labels=("a",))
    record.add("v", 3.0 * t[:, None] ** 2, "rad/s", labels=("a",))
    rows = np.loadtxt(export_record(record, tmp_path / "a.csv", "csv", rate=rate), delimiter=",", skiprows=1)
    wanted = t if times is None else np.array(times)
    np.testing.assert_allclose(rows, np.stack([wanted, wanted**3, 3.0 * wanted**2], axis=1), atol=1e-8)


def test_export_has_the_joints_that_have_rates(braced: Record, tmp_path: Path) -> None:
    joints, _, position, velocity = joint_motion(braced)
    assert tuple(joints) == braced.labels["v"]
    np.testing.assert_array_equal(velocity, braced["v"])
    for joint, column in zip(joints, position.T, strict=True):
        np.testing.assert_array_equal(column, braced["q"][:, braced.labels["q"].index(joint)])
    rows = export_record(braced, tmp_path / "a.csv", "csv").read_text().splitlines()
    assert rows[0].split(",")[:2] == ["time [s]", "base.left [rad]"]
    assert all(len(row.split(",")) == 1 + 2 * len(joints) for row in rows)
