"""Figures and tables of snake runs: files, axes and labels, charts of modes, values beside those of the paper."""

import copy
import csv
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgba
from PIL import Image
from support.messages import mentions, raises, says

import dynsim
from dynsim.draw.figures import draw, snake_tasks, snake_view, style, tanaka2019
from dynsim.draw.figures import snake as figures
from dynsim.draw.figures.look import Look
from dynsim.engine import simulate
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.scenario import load_scenario
from dynsim.snake.lifting import snake_geometry
from dynsim.snake.published import TABLE_III, opening, table_iii, tables

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def record():
    return simulate(load_scenario("snake_joint_limits", None, {"duration_s": 3.0, "record.rate_hz": 50}))


@pytest.fixture
def unwritten(monkeypatch):
    """Draw figures without writing them; tests look at their contents."""
    monkeypatch.setattr(style, "save", lambda figure, path: path)
    monkeypatch.setattr(figures, "FRAMES", 2)


def test_draw_writes_every_figure_from_a_record_on_disk(record, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "FRAMES", 4)
    written = figures.draw(Record.load(record.save(tmp_path / "record.h5")), tmp_path / "figures")
    names = ["postures.png", "overview.png", "tracking.png", "joints.png", "redundancy.png", "animation.gif"]
    assert [path.name for path in written] == names
    for path in written:
        with Image.open(path) as image:
            assert min(image.size) > 200
            assert len(np.unique(np.asarray(image.convert("L")))) > 10
    with Image.open(written[-1]) as animation:
        assert animation.n_frames == 4


def test_the_animation_can_be_excluded(record, unwritten, tmp_path):
    written = draw(record, tmp_path, look=Look(film=False))
    assert [path.name for path in written] == [f"{name}.png" for name in figures.figures(record)]


def test_figures_as_functions_of_records(record):
    for name in figures.figures(record):
        assert dynsim.figure(record, name, title=False).axes
    assert dynsim.figure({"one": record, "two": record}, "comparison").get_suptitle()
    with raises(RecordError, "'energy'", "postures, overview"):
        dynsim.figure(record, "energy")


def test_geometry_is_that_of_the_scene(record):
    geometry = snake_geometry(record)
    assert (geometry.head_joints, geometry.wheel_radius) == (6, 0.05)
    limits = [np.deg2rad(65), np.deg2rad(113)] * 3 + [np.deg2rad(65)] * 6
    expected = {
        "pitch": [False, True] * 3 + [False] * 6,
        "lower": np.negative(limits),
        "upper": limits,
        "half_track": [0.075, 0.06, 0.075, 0.06, 0.075, 0.06, 0.06],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(geometry, name), values, atol=1e-15)
    with raises(RecordError):
        snake_geometry(Record(record.time))


@pytest.mark.long  # test_figures.py has those of arms
def test_figures_as_svg(record, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "FRAMES", 2)
    written = figures.draw(record, tmp_path, "svg")
    names = ["postures.svg", "overview.svg", "tracking.svg", "joints.svg", "redundancy.svg", "animation.gif"]
    assert [path.name for path in written] == names
    assert all(path.read_bytes().startswith(b"<?xml") for path in written[:-1])


def test_comparison(record, tmp_path):
    written = figures.draw_comparison({"a": record, "b": record}, tmp_path)
    assert [path.name for path in written] == ["comparison.png", "postures.png"]
    assert all(path.stat().st_size > 10_000 for path in written)


def apart(figure, axis):
    """Distances of the y tick labels that are seen, in parts of their height."""
    figure.draw_without_rendering()
    boxes = [t.get_window_extent() for t in axis.get_yticklabels() if t.get_text() and t.get_visible()]
    return np.diff([box.y0 for box in boxes]) / max(box.height for box in boxes)


def test_tick_labels_of_a_straight_robot_do_not_overlap(record):
    straight = simulate(load_scenario("snake_positioning", "x", {"duration_s": 0.5, "record.rate_hz": 50}))
    for figure in (figures.postures(straight), figures.strips({"x": straight, "bent": record})):
        left = [axis for axis in figure.axes if axis.get_subplotspec().is_first_col()]
        for axis in left:
            distances = apart(figure, axis)
            assert len(distances) >= 1
            assert distances.min() > 1.0
        plt.close(figure)


def switching_all_the_time(every):
    """A run with a change of mode every so many seconds."""
    commands = [{"at_s": every * k, "mode": 2 + k % 5} for k in range(int(3.0 / every))]
    changes = {"duration_s": 3.0, "record.rate_hz": 50, "controller.commands": commands}
    return simulate(load_scenario("snake_joint_limits", "fixed", changes))


@pytest.mark.parametrize(("every", "numbered"), [(0.5, True), (0.06, False)])
def test_modes_are_numbers_above_the_chart_or_steps_below_it(every, numbered):
    record = switching_all_the_time(every)
    figure = figures.redundancy(record)
    chart = figure.axes[0]
    assert bool(chart.texts) == numbered
    assert chart.get_title(loc="left").startswith("mode") is numbered
    steps = [axis for axis in figure.axes if axis.get_ylabel() == "mode"]
    assert len(steps) == (not numbered)
    for axis in steps:
        np.testing.assert_array_equal(axis.lines[0].get_ydata(), record["mode"])
    widths = {float(w) for bars in chart.collections for w in np.atleast_1d(bars.get_linewidth())}
    assert widths == ({0.4} if numbered else {0.0})
    plt.close(figure)


def test_modes_that_would_fill_the_chart_are_shares_of_time(monkeypatch):
    monkeypatch.setattr(snake_view, "INTERVALS", 20)
    record = switching_all_the_time(0.06)
    figure = figures.redundancy(record)
    chart, steps = figure.axes[:2]
    assert mentions(chart.get_title(loc="left"), "0.15 s")
    starts = snake_view.interval_starts(len(record))
    assert len(starts) == 20
    parts = np.split(np.arange(len(record)), starts[1:])
    pairs = np.array([mesh.get_array().ravel() for mesh in chart.collections])
    np.testing.assert_allclose(pairs.T, [record["grounded"][rows].mean(axis=0) for rows in parts], atol=1e-12)
    modes = np.array([mesh.get_array().ravel() for mesh in steps.collections])
    assert not steps.lines
    assert len(modes) == len(np.unique(record["mode"]))
    np.testing.assert_allclose(modes.sum(axis=0), 1.0, atol=1e-12)
    # Below them range and lowest value of each part.
    for name, signal, scale in (("of B̃", "sigma_min", 1.0), ("support margin", "support_margin", 1e3)):
        (axis,) = [axis for axis in figure.axes if name in axis.get_ylabel()]
        values = [scale * record[signal][rows] for rows in parts]
        stairs = axis.patches[0].get_data()
        np.testing.assert_allclose(stairs.values, [part.max() for part in values])
        np.testing.assert_allclose(stairs.baseline, [part.min() for part in values])
        np.testing.assert_allclose(axis.lines[0].get_ydata(), stairs.baseline)
    plt.close(figure)


def test_the_overview_of_a_robot_that_stays_has_a_side_view(record):
    """One that works with its head alone has its heights shown; one that lies bent needs only the top view."""
    stays = simulate(load_scenario("snake_positioning", "z", {"duration_s": 4.0, "record.rate_hz": 10}))
    figure = figures.overview(stays)
    side = [axis for axis in figure.axes if axis.get_ylabel() == "height [m]"]
    assert len(side) == 1
    heads = [line.get_ydata()[-1] for line in side[0].lines if line.get_marker() == "o"]
    rows = snake_view.moments(stays, figures.IN_A_PICTURE)
    np.testing.assert_allclose(heads, stays["posture"][rows][:, 0, 2], atol=1e-9)
    assert np.ptp(heads) > 0.01
    plt.close(figure)
    figure = figures.overview(record)
    assert "height [m]" not in {axis.get_ylabel() for axis in figure.axes}
    plt.close(figure)


def test_names_of_variants_have_a_stem_and_an_ending():
    assert style.families(["ii_z", "ii_z_kinematic", "i_z"]) == {
        "ii_z": ("ii_z", ""),
        "ii_z_kinematic": ("ii_z", "kinematic"),
        "i_z": ("i_z", ""),
    }
    assert style.families(["ii_z", "ii_x", "base"]) == {"ii_z": ("ii", "z"), "ii_x": ("ii", "x"), "base": ("base", "")}


@pytest.mark.parametrize(
    ("errors", "scale", "low", "high"),
    [
        (np.linspace(0.0, 5e-7, 100), "linear", 0.0, 1.1 * snake_view.ROUNDING),  # a kinematic run
        (np.append(0.0, np.geomspace(50.0, 0.05, 100)), "log", 0.02, 75.0),
        (np.linspace(10.0, 50.0, 100), "linear", 0.0, 55.0),
    ],
)
def test_rounding_errors_do_not_stretch_the_error_axis(errors, scale, low, high):
    axis = style.new_figure(3.0, "").subplots()
    axis.plot(errors)
    snake_view.error_axis(axis, "position error", "mm", errors)
    assert axis.get_yscale() == scale
    assert axis.get_ylim()[0] >= low
    assert axis.get_ylim()[1] == pytest.approx(high)


def test_exact_runs_have_a_note_next_to_errors_on_a_logarithmic_axis(record):
    late = copy.deepcopy(record)
    late["position_error"][:] = np.geomspace(0.05, 5e-5, len(record))
    assert mentions(figures.comparison({"exact": record, "late": late}).caption, "1 of 2 variants")
    assert mentions(dynsim.figure({"one": record, "two": record}, "comparison").caption, "one and two")


def test_constant_joint_angles_are_in_a_note(record):
    still = copy.deepcopy(record)
    still["at_limit"][:] = 0
    still["phi"][:, 0] = np.linspace(0.0, 1.0, len(record))
    still["phi"][:, 1:] = 0.1
    (panel,) = figures.joints(still).axes
    first, *others = (snake_view.greek(name) for name in record.labels["phi"])
    assert [text.get_text() for text in panel.get_legend().get_texts()] == [first]
    assert mentions(figures.joints(still).notes, "at 5.7°", others[-1])


def test_a_joint_that_is_never_straightened_has_no_time(simulated):
    rows = tables("snake_joint_limits", {v: simulated("snake_joint_limits", v) for v in JOINT_LIMITS})["joint_limits"]
    (fixed,) = [row[4] for row in rows if row[3] == "fixed"]
    assert mentions(fixed, "theta4", "theta8")
    assert not re.search(r"theta[48] [\d.]", fixed)
    assert "22.0" not in fixed


@pytest.mark.usefixtures("unwritten")
def test_table_iii_sets_measured_and_simulated_side_by_side(simulated, tmp_path):
    records = {moved: simulated("snake_positioning", moved) for moved in TABLE_III}
    rows = table_iii(records)
    assert len(rows) == 1 + 4 * 6
    assert rows[5] == ["y", "target", "0", "0.1", "0", "0", "0", "0"]
    assert float(rows[8][3]) == pytest.approx(0.1, abs=1e-6)
    written = figures.draw_comparison(records, tmp_path)
    assert {"table_iii.csv", "table_iii.png"} <= {path.name for path in written}


JOINT_LIMITS = ("fixed", "cyclic", "predictive", "eq20", "eq20_min")


def row_of(rows, section, unit, variant):
    """The row of one section of the paper, unit and variant."""
    (row,) = [row for row in rows if row[0] == section and unit in row[1] and row[3] == variant]
    return row


@pytest.mark.usefixtures("unwritten")
def test_what_the_paper_says_of_figures_8_to_10_and_16_beside_what_was_simulated(simulated, tmp_path):
    records = {variant: simulated("snake_joint_limits", variant) for variant in JOINT_LIMITS}
    written = figures.draw_comparison(records, tmp_path)
    expected = {"joint_limits.csv", "policies.csv", "fig_9.png", "fig_10.png", "fig_8_and_16.png", "policies.png"}
    assert expected <= {path.name for path in written}
    rows = list(csv.reader((tmp_path / "joint_limits.csv").read_text().splitlines()))
    assert {len(row) for row in rows} == {5}
    error = row_of(rows, "V.B, Fig 9", "[mm]", "cyclic")
    assert mentions(error[2], "30")
    assert float(error[4]) < 1e-3
    # the wheels of every mode that was used are those of Table II
    wheels = next(row for row in rows if row[0] == "IV.C.5, Table II" and "3, 6" in row[2])
    assert wheels[4].replace("mode ", "") == wheels[2].replace("mode ", "")
    area = [float(row_of(rows, "V.E, Fig 16", "[m^2]", v)[4]) for v in ("cyclic", "eq20_min")]
    assert area[1] > area[0]


def test_policies_side_by_side(simulated):
    records = {variant: simulated("snake_joint_limits", variant) for variant in JOINT_LIMITS}
    rows = {row[0]: row[1:] for row in tables("snake_joint_limits", records)["policies"]}
    assert rows[""] == ["fixed", "cyclic", "predictive"]
    assert [str(records[p].summary["mode_switches"]) for p in rows[""]] in rows.values()
    assert ["1", "1" + " 2 3 4 5 6" * 4] in [row[:2] for row in rows.values()]


@pytest.mark.usefixtures("unwritten")
def test_the_door_of_figure_14(simulated, tmp_path):
    records = {variant: simulated("snake_door_arc", variant) for variant in ("pull", "pull_switching")}
    figure = tanaka2019.door(records["pull_switching"])
    panels = {axis.get_title()[:3]: axis for axis in figure.axes if axis.get_visible()}
    figure.draw_without_rendering()
    assert any(text.get_visible() and text.get_text() for text in panels["(c)"].get_xticklabels())
    plt.close(figure)
    written = figures.draw_comparison(records, tmp_path)
    assert {"door.csv", "fig_14.png"} <= {path.name for path in written}
    rows = list(csv.reader((tmp_path / "door.csv").read_text().splitlines()))
    opened = {row[3]: float(row[4]) for row in rows if "[deg]" in row[1]}
    assert opened["pull"] < 20 < 25 == opened["pull_switching"]


@pytest.mark.usefixtures("unwritten")
def test_the_pick_up_of_figure_13(simulated, tmp_path):
    written = figures.draw(simulated("snake_operator", None), tmp_path)
    assert "fig_13.png" in {path.name for path in written}


def test_variants_that_the_paper_does_not_have_get_no_tables(record):
    assert tables("snake_joint_limits", {"a": record}) == {}
    assert tables("snake_positioning", {"a": record}) == {}
    assert tables("mine", {"cyclic": record}) == {}


TASK = {"servos", "servo_loads", "power", "wheels", "gripper", "object"}
KINEMATIC = {"plant.level": "kinematic", "record.rate_hz": 50}


def drawn(maker, record):
    """A figure after its layout, with all its legends in it."""
    with style.look():
        figure = maker(record)
        figure.draw_without_rendering()
    for legend in filter(None, [*figure.legends, *(axis.get_legend() for axis in figure.axes)]):
        box = legend.get_window_extent()
        assert 0.0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert 0.0 <= box.y0 < box.y1 <= figure.bbox.y1
    return figure


def lines(axis):
    return {line.get_label(): line for line in axis.lines}


def named(axis, beginning):
    """The line whose label begins with these letters."""
    (line,) = [line for name, line in lines(axis).items() if name.startswith(beginning)]
    return line


def means(values):
    """Mean of values in each interval of a run."""
    return [part.mean() for part in np.split(values, snake_view.interval_starts(len(values))[1:])]


def test_servos_beside_their_limits(simulated):
    record = simulated("snake_valve", "turns")
    assert set(figures.figures(record)) >= TASK
    figure = drawn(snake_tasks.servos, record)
    assert len(figure.axes) == 2  # joints and wheels
    for axis, (stall, friction) in zip(figure.axes, ((8.4, 0.8), (2.5, 0.0)), strict=True):
        by_name = lines(axis)
        stalled = [line for name, line in by_name.items() if mentions(name, f"{stall:g} N m")]
        columns = [
            record.labels["torque"].index(name)
            for name in record.labels["torque"]
            if ("wheel" in name) == (stall == 2.5)
        ]
        largest = np.abs(record["torque"][:, columns]).max()
        assert len(stalled) == (stall <= snake_tasks.NEAR * largest)
        assert bool(stalled) != mentions(figure.notes, f"{stall:g} N m")
        assert any(says(text.get_text(), "gear friction") for text in axis.get_legend().texts) == (friction > 0.0)
        assert axis.get_ylim()[1] >= (stall if stalled else largest)
    worst = record.summary["worst_joint"]
    (line,) = [line for name, line in lines(figure.axes[0]).items() if name.startswith("ψ2 rms")]
    assert worst["joint"] == "psi2"
    assert line.get_label() == f"ψ2 rms {worst['torque_rms_N_m']:.2f} N m"
    torque = record["torque"][:, record.labels["torque"].index("psi2")]
    np.testing.assert_allclose(line.get_ydata(), means(torque))


@pytest.mark.parametrize("draw", [snake_tasks.servos, snake_tasks.servo_loads])
def test_servo_above_its_stall_torque_is_shown_and_named(simulated, draw):
    record = copy.copy(simulated("snake_valve", "turns"))
    assert "9.3" not in drawn(draw, record).caption
    record.summary = copy.deepcopy(record.summary)
    motor = next(motor for motor in record.summary["motors"] if motor["joint"] == "psi3")
    motor["torque_max_N_m"] = 9.3
    figure = drawn(draw, record)
    assert mentions(figure.caption, "ψ3", "9.30 N m")
    assert figure.axes[0].get_ylim()[1] > 9.3


def test_earlier_postures_of_a_push_end_before_the_plate():
    """All postures of the side view are along one axis, so no head appears behind the plate that it pushes."""
    record = simulate(load_scenario("snake_push", "i_x", {"duration_s": 2.0}))
    assert record.scene.grip is None
    plate = 0.34876
    side = drawn(figures.overview, record).axes[1]
    heads = [line.get_xdata()[0] for line in side.lines if line.get_marker() == "o"]
    assert len(heads) == figures.IN_A_PICTURE
    x, y, yaw = record["base_pose"][-1]
    expected = (record["posture"][snake_view.moments(record, figures.IN_A_PICTURE), 0, :2] - [x, y]) @ [
        np.cos(yaw),
        np.sin(yaw),
    ]
    np.testing.assert_allclose(heads, expected, atol=1e-9)
    assert np.ptp(heads) > 0.02
    assert max(heads) < plate - x


def test_each_servo_has_a_bar_below_its_limits(simulated):
    record = simulated("snake_valve", "turns")
    joints, wheels = drawn(snake_tasks.servo_loads, record).axes
    motors = {motor["joint"]: motor for motor in record.summary["motors"]}
    names = record.labels["torque"]
    for axis, part, stall, nominal in ((joints, names[:17], 8.4, 1.68), (wheels, names[17:], 2.5, 0.5)):
        bars = {round(bar.get_x() + 0.5 * bar.get_width()): bar for bar in axis.patches}
        assert len(bars) == len(part)
        for k, name in enumerate(part):
            assert bars[k].get_height() == motors[name]["torque_rms_N_m"]
            assert (bars[k].get_facecolor() == to_rgba(style.ORANGE)) == (bars[k].get_height() > nominal)
        by_name = lines(axis)
        np.testing.assert_allclose(by_name["stall torque"].get_ydata(), stall)
        np.testing.assert_allclose(by_name["nominal torque"].get_ydata(), nominal)


def test_the_area_below_the_power_is_the_energy(simulated):
    record = simulated("snake_valve", "turns")
    for axis, signal in zip(
        drawn(snake_tasks.power, record).axes, ("energy_electrical", "work_mechanical"), strict=True
    ):
        values, edges, _ = axis.patches[0].get_data()
        total = record[signal][-1] - record[signal][0]
        assert (values * np.diff(edges)).sum() == pytest.approx(total, rel=1e-9)
        assert mentions(axis.get_legend().texts[0].get_text(), style.number(total, 3))


def test_wheels_that_lift_off_are_marked_on_their_pair(simulated):
    record = simulated("snake_valve", "turns")
    figure = drawn(snake_tasks.wheels, record)
    loads, ground, slip = figure.axes
    load = lines(loads)["pair 2"].get_ydata()
    forces = record["contact_normal_force"]
    columns = [record.labels["contact_normal_force"].index(f"wheel2{side}") for side in "LR"]
    np.testing.assert_allclose(load, means(forces[:, columns].sum(axis=1)))
    lifted = [band for band in ground.collections if band.get_label() == "a wheel without load"]
    rows = sorted(round(float(np.mean(band.get_paths()[0].get_extents().intervaly))) for band in lifted)
    pairs = [
        k
        for k, down in enumerate(record["grounded"].T > 0, 1)
        if (down & (forces[:, 2 * k - 2 : 2 * k] <= 0.0).any(axis=1)).any()
    ]
    assert rows == pairs
    assert 2 in rows
    assert slip.get_ylim()[1] >= slip.lines[1].get_ydata().max() > 1.0
    assert mentions(figure.caption, "slip distance", "wheel4R")


def test_the_gripper_with_its_bounds_states_and_events(simulated):
    record = simulated("snake_valve", "turns")
    figure = drawn(snake_tasks.gripper, record)
    distance, force, torque = figure.axes
    np.testing.assert_array_equal(lines(distance)["distance"].get_ydata(), 1e3 * record["grasp_distance"])
    (limit,) = [line for name, line in lines(distance).items() if mentions(name, "15 mm")]
    np.testing.assert_allclose(limit.get_ydata(), 15.0)
    # On the object: against the tie's force on its first body, the gripper. The valve's friction is 0.3 N m.
    about_x = lines(torque)["about x"].get_ydata()
    np.testing.assert_array_equal(about_x, -record["tie_force"][:, 3])
    assert about_x[record.time.searchsorted(13.0)] == pytest.approx(0.3, abs=0.01)
    # The forces are much smaller than their bound, so it is in a note.
    assert mentions(figure.caption, "force", "20 N")
    assert force.get_ylim()[1] < 20.0
    np.testing.assert_allclose(lines(torque)["± bound 0.8 N m"].get_ydata(), 0.8)
    shown = {name: float(lines(force)[style.UNLISTED + name].get_xdata()[0]) for name in ("captures", "releases")}
    assert shown == {"captures": 7.0, "releases": pytest.approx(18.5, abs=0.01)}
    (legend,) = figure.legends
    expected = ["hardening", "hardened", "softening", "captures", "releases"]
    assert [text.get_text() for text in legend.texts] == expected
    bands = {band.get_label(): band.get_datalim(force.transData).x1 for band in force.collections}
    assert bands[f"{style.UNLISTED}hardening"] == pytest.approx(8.0, abs=0.02)


def test_the_valve_beside_the_head_that_turns_it(simulated):
    record = simulated("snake_valve", "turns")
    angle, load = drawn(snake_tasks.objects, record).axes
    turned = np.rad2deg(record["q"][:, record.labels["q"].index("valve")])
    (valve,) = [line for name, line in lines(angle).items() if name.startswith("valve: ")]
    np.testing.assert_array_equal(valve.get_ydata(), turned)
    target = named(angle, "target")
    assert target.get_xdata()[[0, -1]] == pytest.approx([7.0, 18.495], abs=0.01)
    assert target.get_ydata()[[0, -1]] == pytest.approx([0.0, 90.0], abs=0.1)
    friction = record["joint_friction"][:, record.labels["joint_friction"].index("valve")]
    np.testing.assert_array_equal(lines(load)["friction"].get_ydata(), friction)


@pytest.mark.parametrize(
    ("name", "variant", "angle", "point"),
    [
        ("snake_valve", "turns", 90.0, "gripper"),
        ("snake_valve", "turns", 90.0, "head"),
        ("snake_door", "push", 60.0, "gripper"),
    ],
)
def test_kinematic_objects_turn_with_the_gripper(name, variant, angle, point):
    """Without a spring between them; whatever point of the head is controlled."""
    record = simulate(load_scenario(name, variant, {**KINEMATIC, "plant.controlled_point": point}))
    assert set(figures.figures(record)) & TASK == {"gripper", "object"}
    (only,) = drawn(snake_tasks.objects, record).axes
    own = only.lines[0]
    gripper = named(only, "gripper")
    rows = np.isin(own.get_xdata(), gripper.get_xdata())
    assert gripper.get_ydata()[-1] == pytest.approx(angle, abs=0.01)
    np.testing.assert_allclose(gripper.get_ydata(), own.get_ydata()[rows], rtol=0, atol=0.02)
    (distance,) = drawn(snake_tasks.gripper, record).axes
    assert "captures" not in lines(distance)
    assert len([line for line in distance.lines if line.get_label() == f"{style.UNLISTED}captures"]) == 1


def test_the_pipe_is_drawn_and_rises(simulated):
    record = simulated("snake_pick_up", "lifts")
    makers = figures.figures(record)
    height, ground = drawn(makers["object"], record).axes
    (pipe,) = [line for name, line in lines(height).items() if name.startswith("pipe: ")]
    assert np.ptp(pipe.get_ydata()) == pytest.approx(160.0, abs=5.0)
    weight = 0.2 * 9.81
    rows = record.time.searchsorted([10.0, 25.0])
    assert ground.lines[0].get_ydata()[rows] == pytest.approx([weight, 0.0], abs=0.01)
    strip = drawn(makers["fig_13"], record)
    assert any(mentions(text.get_text(), "object") for text in strip.legends[0].texts)
    wood = [patch for axis in strip.axes for patch in axis.patches if patch.get_facecolor() == to_rgba("#E9CFA6")]
    assert len(wood) == 2 * len(strip.axes)  # run and branch


@pytest.mark.usefixtures("unwritten")
def test_figure_14_with_a_door(tmp_path):
    records = {"pull_switching": simulate(load_scenario("snake_door", "pull_switching", KINEMATIC))}
    written = figures.draw_comparison(records, tmp_path)
    assert {"door.csv", "fig_14.png"} <= {path.name for path in written}
    # The head turns with the door.
    heading = np.rad2deg(records["pull_switching"]["w"][:, 5])
    np.testing.assert_allclose(opening(records["pull_switching"]), np.abs(heading - heading[0]), rtol=0, atol=0.02)
    figure = tanaka2019.door(records["pull_switching"])
    assert any(mentions(text.get_text(), "object") for text in figure.legends[0].texts)
    plt.close(figure)


def test_many_variants_are_bars_with_marks_at_the_end(record):
    late = copy.deepcopy(record)
    late["cost"][:] += np.linspace(0.0, 1.0, len(record))
    records = {f"{posture}_{axis}": late if axis == "y" else record for posture in ("i", "ii", "iii") for axis in "xyz"}
    figure = drawn(figures.comparison, records)
    assert [text.get_text() for text in figure.legends[0].texts] == ["…_x", "…_y", "…_z"]
    assert [text.get_text() for text in figure.axes[-1].get_xticklabels()] == ["i", "ii", "iii"]
    ends = [line.get_ydata()[0] for line in figure.axes[0].lines]
    assert ends == [run["cost"][-1] for run in records.values()]
    (bars,) = {tuple(bar.get_segments()[0][:, 1]) for bar in figure.axes[0].collections[1::3]}
    assert bars == (late["cost"].min(), late["cost"].max())
    for axis in figure.axes:
        low, high = axis.get_ylim()
        for bar in axis.collections:
            assert low <= bar.get_segments()[0][0, 1] <= bar.get_segments()[0][1, 1] <= high


def test_constant_coordinates_have_no_panel():
    record = simulate(load_scenario("snake_positioning", "z", {"duration_s": 4.0, "record.rate_hz": 10}))
    figure = drawn(figures.tracking, record)
    labels = [axis.get_ylabel() for axis in figure.axes if axis.get_visible()]
    assert "height $z$ [mm]" in labels
    assert "$y$ [m]" not in labels
    assert mentions(figure.caption, "y (", "γ (")
