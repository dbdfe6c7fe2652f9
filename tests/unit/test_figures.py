"""Figures of every kind of record, and their agreement with it: curves, labels, marks, scales and colours."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from support.layout import layout_faults, tick_faults
from support.messages import lines_with, mentions, raises, says

import dynsim
from dynsim.draw import figures
from dynsim.draw.figures import arm, contacts, energy, overlap, posture, style
from dynsim.draw.geometry import robot
from dynsim.engine import recording as metrics
from dynsim.errors import RecordError
from dynsim.record import Event, Record, measures
from dynsim.scenario import load_scenario

SHORT = {"duration_s": 0.3, "metrics.settle_s": 0.1, "integrator.rtol": 1e-4}
PENDULUM = """\
duration_s: 0.5
plant:
  type: serial_arm
  chain: [{axis: y, initial_deg: 120, damping_N_m_s_per_rad: 0.005}]
"""
PNG = b"\x89PNG\r\n\x1a\n"
# Those of a mobile base: see tests/unit/test_base_figures.py.
FIGURES = set(arm.FIGURES) - {"base", "overturning", "base_tracking"}
COMPARISONS = set(arm.COMPARISONS) - {"compare_tip_margin"}


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer pixels: the tests look at what is drawn, not at how sharp it is."""
    monkeypatch.setattr(style, "DPI", 50)


def simulated(variant: str) -> Record:
    return dynsim.simulate(load_scenario("elbow_comparison", variant, SHORT))


@pytest.fixture(scope="module")
def braced() -> Record:
    return simulated("two_elbows")


@pytest.fixture(scope="module")
def free() -> Record:
    return simulated("no_elbow")


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Record:
    path = tmp_path_factory.mktemp("scenario") / "pendulum.yaml"
    path.write_text(PENDULUM)
    return dynsim.simulate(load_scenario(path))


def shortened(record: Record, samples: int) -> Record:
    """The record as an interrupted run leaves it, with so many samples."""
    result = Record(record.time[:samples], provenance=record.provenance)
    for name, signal in record.signals.items():
        result.add(name, signal.data[:samples].copy(), signal.unit, labels=signal.labels)
    result.complete = False
    result.scene = record.scene
    return result


def stretched(record: Record, samples: int) -> Record:
    """The record repeated to so many samples."""
    index = np.arange(samples) % len(record)
    result = Record(np.arange(samples) * 1e-3, provenance=record.provenance)
    for name, signal in record.signals.items():
        result.add(name, signal.data[index], signal.unit, labels=signal.labels)
    result.scene = record.scene
    return result


def without(record: Record, *names: str) -> Record:
    result = copy.copy(record)
    result.signals = {name: signal for name, signal in record.signals.items() if name not in names}
    return result


def drawn(figure: Figure | None) -> Figure:
    assert figure is not None
    return figure


def assert_pngs(paths: list[Path], folder: Path, names: set[str]) -> None:
    assert {path.stem for path in paths} == names
    # Nothing is left under a temporary name.
    assert sorted(folder.glob("*.png")) == sorted(paths)
    for path in paths:
        data = path.read_bytes()
        assert data.startswith(PNG)
        assert len(data) > 2000


def texts(figure: Figure) -> str:
    legends = [axes.get_legend() for axes in figure.axes] + list(figure.legends)
    return "\n".join(text.get_text() for legend in legends if legend is not None for text in legend.get_texts())


@pytest.mark.parametrize("samples", [61, 2, 1])
def test_braced_run_has_every_figure(braced: Record, samples: int, tmp_path: Path) -> None:
    record = braced if samples == len(braced) else shortened(braced, samples)
    # Loads of motors are in the summary, which only the whole record has.
    assert_pngs(figures.draw(record, tmp_path), tmp_path, FIGURES - ({"torques"} if record is not braced else set()))


def test_run_without_contacts(free: Record, tmp_path: Path) -> None:
    assert_pngs(figures.draw(free, tmp_path), tmp_path, FIGURES - {"contact_forces"})


def test_run_without_motors_target_or_contacts(pendulum: Record, tmp_path: Path) -> None:
    assert_pngs(figures.draw(pendulum, tmp_path), tmp_path, {"hand_path", "energy_ledger", "posture"})


def test_run_without_target(braced: Record) -> None:
    record = without(braced, "target_position")
    available = {name for name, draw in arm.FIGURES.items() if draw(record) is not None}
    assert available == FIGURES - {"tracking_error"}
    assert "target" not in texts(drawn(energy.path(record)))


def test_record_without_samples_has_no_figures(braced: Record, tmp_path: Path) -> None:
    empty = shortened(braced, 0)
    assert figures.draw(empty, tmp_path / "none") == []
    assert figures.draw_comparison({"a": empty}, tmp_path / "none") == []
    assert not (tmp_path / "none").exists()


def test_comparison(braced: Record, free: Record, tmp_path: Path) -> None:
    records = {"two_elbows": braced, "no_elbow": shortened(free, 2), "stopped": shortened(braced, 0)}
    assert_pngs(figures.draw_comparison(records, tmp_path), tmp_path, COMPARISONS)


def test_comparison_of_pendulums(pendulum: Record, tmp_path: Path) -> None:
    paths = figures.draw_comparison({"a": pendulum, "b": pendulum}, tmp_path)
    assert_pngs(paths, tmp_path, {"compare_hand_path", "compare_posture"})


def test_drawing_leaves_matplotlib_settings_alone(pendulum: Record, tmp_path: Path) -> None:
    import matplotlib

    def settings() -> dict[str, object]:
        # Looking at the backend would choose one.
        return {key: matplotlib.rcParams[key] for key in matplotlib.rcParams if key != "backend"}

    before = settings()
    figures.draw(pendulum, tmp_path)
    assert settings() == before


def test_a_record_of_signals_that_nobody_draws_is_refused(tmp_path: Path) -> None:
    record = Record([0.0, 1.0])
    record.add("pressure", [1.0, 2.0], "Pa")
    with raises(RecordError, "pressure"):
        figures.draw(record, tmp_path)


def test_what_is_drawn_depends_on_the_signals_not_on_the_engine(pendulum: Record, tmp_path: Path) -> None:
    record = copy.copy(pendulum)
    record.provenance = {}
    assert_pngs(figures.draw(record, tmp_path), tmp_path, {"hand_path", "energy_ledger", "posture"})


@pytest.mark.parametrize(("kind", "start"), [pytest.param("pdf", b"%PDF-", marks=pytest.mark.long), ("svg", b"<?xml")])
def test_figures_as_pdf_and_svg(pendulum: Record, tmp_path: Path, kind: str, start: bytes) -> None:
    names = {"hand_path", "energy_ledger", "posture"}
    paths = figures.draw(pendulum, tmp_path / "a", kind)
    assert {path.name for path in paths} == {f"{name}.{kind}" for name in names}
    again = figures.draw(pendulum, tmp_path / "b", kind)
    for path, other in zip(paths, again, strict=True):
        assert path.read_bytes().startswith(start)
        assert path.read_bytes() == other.read_bytes()
    paths = figures.draw_comparison({"a": pendulum, "b": pendulum}, tmp_path, kind)
    assert {path.name for path in paths} == {f"compare_hand_path.{kind}", f"compare_posture.{kind}"}


def test_a_folder_that_cannot_be_written_is_a_record_error(pendulum: Record, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with raises(RecordError, "file"):
        figures.draw(pendulum, tmp_path / "file")


def test_contact_figure_states_the_pulling_fraction(braced: Record) -> None:
    figure = drawn(contacts.forces(braced))
    for contact in braced.summary["contacts"]:
        assert lines_with(texts(figure), contact["name"], f"{100 * contact['pulling_fraction']:.1f} %")
    # elbow 4 is the brace that the floor would have to hold down.
    assert braced.summary["contacts"][0]["pulling_fraction"] > 0.8
    lines = figure.axes[-1].get_lines()
    np.testing.assert_array_equal(lines[0].get_ydata(), braced["contact_normal_force"][:, 1])


def test_contact_figures_show_the_extremes_of_all_steps(braced: Record) -> None:
    for figure, lines in ((contacts.forces(braced), True), (contacts.forces_comparison({"a": braced}), False)):
        for contact, axes in zip(braced.summary["contacts"], drawn(figure).axes[::2], strict=True):
            low, high = contact["normal_force_min_N"], contact["normal_force_max_N"]
            levels = [line.get_ydata()[0] for line in axes.get_lines() if len(line.get_xdata()) == 2]
            assert ({low, high} <= set(levels)) is lines
            assert not lines or axes.get_ylim()[0] < low < high < axes.get_ylim()[1]
        assert mentions(figure.caption, "5 ms")


def test_ledger_stack_adds_up_to_the_electrical_energy(braced: Record) -> None:
    """The topmost positive edge plus the lowest negative one is what was supplied, but for the residual."""
    figure = drawn(energy.ledger(braced))
    top = figure.axes[0]
    edges = [collection.get_paths()[0].vertices for collection in top.collections]
    last = braced.time[-1]
    at_end = [vertices[vertices[:, 0] == last, 1] for vertices in edges]
    total = max(y.max() for y in at_end) + min(y.min() for y in at_end)
    expected = braced["energy_electrical"] + braced["work_constraint"] - braced["energy_residual"]
    assert total == pytest.approx(expected[-1], rel=1e-12)
    assert set(energy.TERMS) == {*measures.SINKS, *measures.MORE_SINKS, *metrics.STORES}


def test_hand_path_panels_have_one_scale_and_all_points(braced: Record) -> None:
    figure = drawn(energy.path(braced))
    spans = [np.ptp(axes.get_xlim()) for axes in figure.axes] + [np.ptp(axes.get_ylim()) for axes in figure.axes]
    np.testing.assert_allclose(spans, spans[0], rtol=1e-12)
    for axes, (i, j) in zip(figure.axes, energy.PLANES, strict=True):
        for name in ("hand_position", "target_position"):
            inside = axes.viewLim.contains
            assert all(inside(*point) for point in braced[name][:, (i, j)])


def test_labels_of_hand_path_ticks_stand_apart(braced: Record) -> None:
    """Also about zero, where they are the widest: −0.050, −0.025."""
    record = without(braced, "hand_position", "target_position")
    turn = np.linspace(0.0, 2.0 * np.pi, len(braced))
    circle = 0.051 * np.stack([np.cos(turn), np.sin(turn), 0.5 * np.sin(turn)], axis=1)
    for name in ("hand_position", "target_position"):
        record.add(name, circle, "m", labels=("x", "y", "z"))
    with style.look():
        figure = drawn(energy.path(record))
        figure.draw_without_rendering()
    for axes in figure.axes:
        low, high = axes.get_xlim()
        shown = [
            label.get_window_extent() for label in axes.get_xticklabels() if low <= label.get_position()[0] <= high
        ]
        assert len(shown) >= 2
        assert all(right.x0 - left.x1 > 3.0 for left, right in itertools.pairwise(shown))


def test_target_that_is_held_is_a_mark(braced: Record) -> None:
    held = without(braced, "target_position")
    held.add("target_position", np.tile(braced["target_position"][0], (len(braced), 1)), "m", labels=("x", "y", "z"))
    for record, named in ((held, {"target"}), (braced, {"target", "start of the target"})):
        for figure in (drawn(energy.path(record)), drawn(energy.path_comparison({"a": record}))):
            assert {name for name in texts(figure).splitlines() if "target" in name} == named
            target = next(line for line in figure.axes[0].get_lines() if line.get_label() == "target")
            assert target.get_marker() == ("x" if record is held else "None")


def test_tracking_error_states_the_rms_of_the_summary(braced: Record) -> None:
    assert mentions(texts(drawn(energy.error(braced))), f"{1e3 * braced.summary['hand_error_rms_m']:.3g} mm")


def test_every_variant_has_its_colour_everywhere(braced: Record, free: Record) -> None:
    records = {"two_elbows": braced, "no_elbow": free}
    styles = style.variant_styles(list(records))
    for figure in (energy.error_comparison(records), energy.energy_comparison(records)):
        colours = [line.get_color() for line in drawn(figure).axes[0].get_lines()[:2]]
        assert colours == [styles[name]["color"] for name in records]
    assert not {style.PULLING, style.BLACK} & {*style.VARIANT_COLOURS}


def test_many_motors_are_an_envelope_and_the_largest(braced: Record) -> None:
    count, samples = 40, len(braced)
    record = Record(braced.time, provenance=braced.provenance)
    values = np.outer(np.ones(samples), np.arange(count, dtype=float))
    for name, unit in (("current", "A"), ("voltage", "V")):
        record.add(name, values, unit, labels=tuple(f"joint_{k}" for k in range(count)))
    shown = texts(drawn(energy.motors(record))).splitlines()
    assert (lines_with(shown[0], "40"), shown[1:]) == ([shown[0]], [f"joint_{k}" for k in range(34, 40)])


def test_transient_has_a_panel_and_the_rest_its_own_range() -> None:
    time = np.linspace(0.0, 10.0, 1001)
    values = 1.0 + 0.1 * np.sin(time) + 50.0 * np.exp(-time / 0.05)
    (panels,) = style.time_rows(style.new_figure(3.0, ""), [[(time, values)]], settle=2.0)
    assert len(panels) == 2
    assert panels[0].get_xlim()[1] < 1.0
    assert panels[1].get_ylim()[1] < 1.5
    (whole,) = style.time_rows(style.new_figure(3.0, ""), [[(time, np.sin(time))]], settle=2.0)
    assert len(whole) == 1


def test_short_peak_is_cut_and_stated() -> None:
    time = np.linspace(0.0, 10.0, 1001)
    values = np.sin(time)
    values[500] = 80.0
    (panels,) = style.time_rows(figure := style.new_figure(3.0, ""), [[(time, values)]], settle=2.0)
    assert 1.2 < panels[-1].get_ylim()[1] < 3.0
    assert [text.get_text() for text in panels[-1].texts] == ["range −1 … 80"]
    assert mentions(figure.caption, "Short peaks")


@pytest.mark.parametrize("lasting", [0.5, 3.0])
def test_transient_of_many_samples_is_not_cut_in_a_narrow_figure(lasting: float) -> None:
    time = np.linspace(0.0, 10.0, 1001)
    values = np.where(time < lasting, 80.0, np.sin(time))
    with style.look(style.Look(width=3.4)):
        (panels,) = style.time_rows(figure := style.new_figure(3.0, ""), [[(time, values)]], settle=2.0)
        style.line(panels[-1], time, values)
    assert len(panels) == 1
    assert panels[-1].get_ylim()[1] > 80.0
    assert not panels[-1].texts
    assert not figure.notes


@pytest.mark.parametrize(("low", "high"), [(-0.005, 0.0045), (247.0, 286.0), (0.0, 92.0), (-1.0, 0.9)])
@pytest.mark.parametrize("height", [0.9, 1.2, 2.5])
def test_labels_of_ticks_span_the_axis(low: float, high: float, height: float) -> None:
    figure = style.new_figure(height, "")
    figure.subplots().plot([low, high], [low, high])
    figure.draw_without_rendering()
    assert tick_faults(figure) == []


@pytest.mark.parametrize("name", ["tracking_error", "hand_path"])
def test_labels_are_measured_once_in_each_layout(name: str, braced: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    measured, measure = list[Axes](), Axes.get_tightbbox

    def counted(axes: Axes, *args: Any, **options: Any) -> Any:
        measured.append(axes)
        return measure(axes, *args, **options)

    monkeypatch.setattr(Axes, "get_tightbbox", counted)
    with style.look():
        figure = drawn(arm.FIGURES[name](braced))
        list(style.with_panels([(name, figure)]))
        assert sorted(map(id, measured)) == sorted(map(id, figure.axes))
        figure.draw_without_rendering()
    assert len(measured) == 3 * len(figure.axes)
    # Another layout, which measures the labels at the present positions, moves no edge by a pixel: only labels that
    # extend over the ends of an axis change their space, by a part of the change of its length.
    before = [axes.get_position(original=True).extents for axes in figure.axes]
    layout = figure.get_layout_engine()
    assert layout is not None
    layout.execute(figure)
    moved = np.abs(np.subtract(before, [axes.get_position(original=True).extents for axes in figure.axes]))
    assert moved.max() * figure.bbox.width < 1.0


def test_planes_of_a_flat_path_have_different_scales() -> None:
    panels = list(style.new_figure(3.0, "").subplots(1, 3))
    note = energy._frame(panels, energy.PLANES, np.zeros(3), np.array([0.4, 0.3, 0.02]))
    assert [axes.get_aspect() for axes in panels] == [1.0, "auto", "auto"]
    assert mentions(note, "x and z, y and z")


def test_contact_of_an_instant_is_in_the_note(real: Record) -> None:
    short = copy.deepcopy(real)
    for contact in short.summary["contacts"]:
        contact["closed_fraction"] = 1e-3
    figure = drawn(contacts.forces_comparison({"real": real, "short": short}))
    assert mentions(figure.caption, "Closed for an instant", "elbow_7 of short")
    assert not lines_with(texts(figure).splitlines(), "short:")
    assert mentions(drawn(contacts.forces(short)).caption, "Sampled")


@pytest.mark.parametrize("settle", [9.0, 9.9, 20.0])
def test_transient_of_the_whole_run_has_no_panel(settle: float) -> None:
    time = np.linspace(0.0, 10.0, 1001)
    (panels,) = style.time_rows(style.new_figure(3.0, ""), [[(time, 50.0 * np.exp(-time / 3.0))]], settle=settle)
    assert len(panels) == 1
    panels[0].plot(time, 50.0 * np.exp(-time / 3.0))
    assert panels[0].get_ylim()[1] > 50.0


def test_long_record(braced: Record, tmp_path: Path) -> None:
    record = stretched(braced, 60_000)
    for draw in (energy.error, energy.ledger, contacts.forces, energy.motors):
        assert style.save(drawn(draw(record)), tmp_path / "long.png").stat().st_size > 2000


def test_values_that_are_not_finite_are_drawn_around(braced: Record, tmp_path: Path) -> None:
    """A run that diverged may end in them."""
    record = shortened(braced, 20)
    for signal in record.signals.values():
        signal.data[-1:] = np.nan
    assert figures.draw(record, tmp_path)


@pytest.mark.parametrize("lost", ["scene", "poses", "bodies"])
def test_posture_that_the_record_does_not_tell_is_left_out(braced: Record, lost: str) -> None:
    record = copy.copy(braced)
    if lost == "scene":
        record.scene, expected = None, "no scene"
    elif lost == "poses":
        record, expected = without(record, "body_orientation"), "no poses"
    else:
        record.scene = dataclasses.replace(braced.scene, bodies=braced.scene.bodies[:3], points=())
        expected = "other bodies"
    figure = drawn(posture.posture(record))
    assert any(says(axes.get_title().replace("\n", " "), expected) for axes in figure.axes)
    assert posture.posture_comparison({"a": record}) is None


def test_side_view_shows_the_arm_and_which_contact_pulls(braced: Record) -> None:
    figure = drawn(posture.posture(braced))
    side = figure.axes[1]
    forces = braced["contact_normal_force"][-1]
    marks = [line.get_marker() for line in side.get_lines() if str(line.get_label()).startswith("surface pu")]
    assert marks == ["v" if force < 0.0 else "^" for force in forces]
    # The arm stands in the plane x = y: seen from the side, all its 0.3 m links have their true length at the start.
    first = np.array(side.collections[0].get_segments())
    np.testing.assert_allclose(np.linalg.norm(first[1:, 1] - first[1:, 0], axis=1)[1:], 0.3, rtol=1e-6)


def test_contacts_with_a_radius_are_marked_on_their_surface() -> None:
    """Where the sphere touches, not at its centre above the floor."""
    radii = {f"contacts.points.elbow_{k}.radius_m": 0.02 for k in (4, 7)}
    overrides = {"duration_s": 0.05, "surfaces.floor.point_m": [0.0, 0.0, -0.02], **radii}
    record = dynsim.simulate(load_scenario("pressing", "plain", overrides))
    body, _ = posture.skeleton(record)
    assert body is not None
    touching = {point.name: (position, force) for point, _, position, force in body.contacts()}
    position, force = touching["elbow_7"]
    assert force > 0.0
    assert position[2] == pytest.approx(-0.02, abs=1e-4)


def test_labels_of_contacts_do_not_overprint_each_other(braced: Record) -> None:
    body, _ = posture.skeleton(braced)
    plane = posture.SidePlane(np.zeros(3), np.eye(3)[[0, 2]])
    with style.look():
        assert [label.level for label in posture.contact_labels(body, plane, 1000.0)] == [0, 0]
        close = posture.contact_labels(body, plane, 10.0)
        assert [label.level for label in close] == [0, 1]
        low, _ = posture.with_labels((np.zeros(2), np.ones(2)), close, 10.0)
        assert low[1] < close[1].place[1] + (close[1].offset[1] - close[1].half[1]) / 10.0


def boxes(axes: Axes) -> list[Bbox]:
    """Where texts of a panel are written."""
    return [text.get_window_extent() for text in axes.texts]


def test_labels_of_postures_lie_on_nothing() -> None:
    """Contacts: not over each other, nor over any posture, way or edge of the panel; at a wall beside it."""
    record = dynsim.simulate(load_scenario("wall_push", "weak_hold", {"integrator.rtol": 1e-4}))
    figure = drawn(posture.posture(record))
    figure.draw_without_rendering()
    side = figure.axes[1]
    (contact,) = (text for text in side.texts if "elbow" in text.get_text())
    assert contact.get_window_extent().x0 > side.transData.transform((0.4, 0.0))[0]
    written = boxes(side)
    assert written
    lines = [path for lines in side.collections if isinstance(lines, LineCollection) for path in lines.get_segments()]
    lines += [line.get_xydata() for line in side.get_lines() if len(line.get_xydata()) > 1]
    points = [
        np.column_stack([np.interp(np.linspace(0, len(curve) - 1, 400), np.arange(len(curve)), c) for c in curve.T])
        for curve in lines
    ]
    pixels = side.transData.transform(np.concatenate(points))
    for box in written:
        inside = (pixels > [box.x0, box.y0]).all(axis=1) & (pixels < [box.x1, box.y1]).all(axis=1)
        assert not inside.any()
        assert side.bbox.x0 <= box.x0
        assert box.x1 <= side.bbox.x1


def test_energies_far_apart_are_dots_on_a_logarithmic_axis(braced: Record) -> None:
    """Bars of 220 J and 13 200 J: one of them is no more than a line. A ratio of 18 is drawn on a linear axis."""
    more, most = copy.deepcopy(braced), copy.deepcopy(braced)
    more["energy_electrical"][:] *= 10.0
    most["energy_electrical"][:] *= 60.0
    figure = drawn(energy.energy_comparison({"a": braced, "b": more, "c": most}))
    total = figure.axes[1]
    assert total.get_xscale() == "log"
    assert not total.patches
    assert [text.get_text().split()[1:] for text in total.texts] == [["(1/60)"], ["(1/6)"], []]
    most["energy_electrical"][:] *= 18.0 / 60.0
    figure = drawn(energy.energy_comparison({"a": braced, "b": most}))
    assert [axes.get_yscale() for axes in figure.axes] == ["linear"] * 3
    assert figure.axes[0].get_ylim()[0] == 0.0
    assert len(figure.axes[1].patches) == 2


def test_tracking_error_has_a_settled_axis(braced: Record) -> None:
    """What the start alone has is drawn in a panel of its own; the other one ends near what comes after it."""
    record = copy.deepcopy(braced)
    wanted = measures.hand_target(record)
    assert wanted is not None
    since = record.time - 0.1
    record["hand_position"][:] = wanted + np.where(since < 0.0, -since, 0.002 + 0.002 * since)[:, None] * [
        1.0,
        0.0,
        0.0,
    ]
    figure = drawn(energy.error(record))
    assert len(figure.axes) == 4
    error = 1e3 * np.abs(record["hand_position"] - wanted).max()
    for start, whole in (figure.axes[:2], figure.axes[2:]):
        assert whole.get_ylim()[1] < 0.1 * error < error < start.get_ylim()[1]
    near = copy.deepcopy(record)
    near["hand_position"][:] = wanted + 0.05 * (record["hand_position"] - wanted)
    for other, scale in ((record, "linear"), (near, "log")):
        compared = drawn(energy.error_comparison({"one": record, "other": other}))
        assert compared.axes[1].get_yscale() == scale
        assert compared.axes[1].get_ylim()[1] < 0.1 * error


def test_side_plane_of_an_arm_along_minus_y() -> None:
    record = Record([0.0])
    record.add("hand_position", [[0.0, -2.0, 0.1]], "m", labels=("x", "y", "z"))
    segments = np.array([[[0.0, 0.0, 0.0], [0.0, -1.0, 0.3]], [[0.0, -1.0, 0.3], [0.0, -2.0, 0.1]]])
    plane = posture.side_plane(record, [segments])
    np.testing.assert_allclose(plane.project(np.array([0.0, -2.0, 0.1])), [2.0, 0.1], atol=1e-12)


def test_a_free_body_hangs_on_nothing(tmp_path: Path):
    """Of a body that floats with an arm on it, the posture is the arm: no line leads there from the world."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    (tmp_path / "free.urdf").write_text(
        f'<robot name="free"><link name="base"/><link name="body">{inertial}</link><link name="arm">{inertial}</link>'
        '<joint name="root" type="floating"><parent link="base"/><child link="body"/></joint>'
        '<joint name="hinge" type="continuous"><origin xyz="0.5 0 0"/><parent link="body"/><child link="arm"/></joint>'
        "</robot>"
    )
    (tmp_path / "free.yaml").write_text(
        "duration_s: 0.01\n"
        "plant: {type: urdf_arm, file: free.urdf, hand: {body: arm, point_m: [0.2, 0, 0]},"
        " initial_pose: {root: {position_m: [1, 2, 3]}}}\n"
    )
    body, _ = posture.skeleton(dynsim.simulate(load_scenario(tmp_path / "free.yaml")))
    assert body is not None
    drawn = [segment for segment in body.segments(0) if np.ptp(segment, axis=0).any()]
    np.testing.assert_allclose(drawn, [[[1, 2, 3], [1.5, 2, 3]], [[1.5, 2, 3], [1.7, 2, 3]]], atol=1e-15)


@pytest.fixture(scope="module")
def real() -> Record:
    return dynsim.simulate(load_scenario("elbow_comparison_floor", "two_elbows", SHORT))


def test_real_contacts_have_bands_that_end_at_their_events(real: Record) -> None:
    """Elbow 7 slides, leaves, lands and slides: each band is of one mode, and what they add up to is the summary's."""
    for contact in real.summary["contacts"]:
        bands = contacts.mode_bands(real, contact["name"])
        assert bands[0][0] == 0.0
        assert bands[-1][1] == real.time[-1]
        assert all(band[1] == following[0] for band, following in itertools.pairwise(bands))
        times = {event.time for event in real.events if event.name == contact["name"]}
        assert {begin for begin, _, _ in bands[1:]} <= times
        open_for = sum(end - begin for begin, end, mode in bands if mode == 0)
        # Phases between two samples have no band.
        assert open_for / real.time[-1] == pytest.approx(1.0 - contact["closed_fraction"], abs=0.005 / real.time[-1])


def test_real_contact_figure_names_modes_and_marks_events(real: Record) -> None:
    figure = drawn(contacts.forces(real))
    assert not says(texts(figure), "pulling")
    for contact in real.summary["contacts"]:
        assert lines_with(texts(figure), contact["name"], f"{100 * contact['closed_fraction']:.1f} %")
        assert lines_with(texts(figure), f"{100 * contact['sliding_fraction']:.1f} %", phrase="slides")
    kinds = {event.kind for event in real.events}
    assert {"lift_off", "landing"} <= kinds
    modes = {" ".join(text.get_text().split()) for text in figure.legends[0].texts}
    assert modes >= {"contact open", "contact slides", "event"}
    start, whole = figure.axes[-2:]
    for axes in (start, whole):
        assert_marked(axes, [event.time for event in real.events if event.name == "elbow_7"])
    # Nothing lies on the bands.
    assert not any(axes.child_axes for axes in figure.axes)
    assert whole.get_ylim()[1] < start.get_ylim()[1]


def rug(axes: Axes) -> list[list[float]]:
    """Return the times of the marks above a panel, one row per kind of event."""
    return [list(part.get_xdata()) for part in style.rug_rows(axes)]


def event_lines(axes: Axes) -> list[float]:
    """Return the times of the lines that mark events."""
    marks = [part for part in axes.collections if part.get_label() == f"{style.UNLISTED}event"]
    return sorted(float(path.vertices[0, 0]) for part in marks for path in part.get_paths())


def assert_marked(axes: Axes, times: Sequence[float]) -> None:
    """Every event within the axes has a line, or one that is closer than a line of its own would be legible."""
    low, high = axes.get_xlim()
    shown, inside = event_lines(axes), [time for time in times if low <= time <= high]
    assert set(shown) <= set(inside)
    apart = contacts.APART * (high - low)
    assert all(min(abs(time - line) for line in shown) < apart for time in inside)
    assert (np.diff(shown) >= apart).all()


def test_every_time_figure_marks_the_events_of_contacts(real: Record, braced: Record) -> None:
    for draw in (energy.error, energy.energy, energy.ledger, energy.motors):
        figure = drawn(draw(real))
        landings = sum(event.kind == "landing" for event in real.events)
        assert re.search(rf"landing \({landings}[ )]", figure.caption)
        assert [bool(rug(axes)) for axes in figure.axes].count(True) in (1, 2)
        for axes in figure.axes:
            if not axes.get_title(loc="left").startswith("with "):  # the small panel aside
                assert_marked(axes, [event.time for event in real.events])
        # Nothing happens to what is glued.
        assert not any(map(event_lines, drawn(draw(braced)).axes))


def test_friction_of_joints_has_names_apart_from_contacts(real: Record) -> None:
    both = copy.copy(real)
    both.events = [Event(0.01, "slip_start", "joint_2"), Event(0.02, "slip_start", "elbow_7")]
    caption = drawn(energy.energy(both)).caption
    assert all(mentions(caption, f"{text} (1)") for text in contacts.MARKS["slip_start"])


def test_comparisons_name_curves_that_coincide_and_mark_no_events(real: Record, braced: Record) -> None:
    records = {"glued": braced, "real": real, "same": real}
    for name in ("compare_tracking_error", "compare_energy", "compare_hand_path", "compare_contact_forces"):
        figure = dynsim.figure(records, name)
        assert not any(map(event_lines, figure.axes))
        assert mentions(figure.caption, "real and same")
        assert not mentions(dynsim.figure({"glued": braced, "moved": shifted(real)}, name).caption, "coincide")


TIME = np.linspace(0.0, 10.0, 400)
WAVE = np.sin(TIME)


@pytest.mark.parametrize(
    ("other", "note"),
    [
        (WAVE + 1e-3, "Curves that coincide: a2 and b."),
        (WAVE + 0.3 * (np.abs(TIME - 5.0) < 0.5), "Curves that nearly coincide: a2 and b except 4.5–5.5 s."),
        (WAVE + 0.3 * (TIME < 3.0), ""),
        (WAVE + 0.3 * (TIME > 6.0), "Curves that coincide: a2 and b until 6.0 s."),
        (WAVE + 0.3, ""),
    ],
)
def test_notes_measure_the_distance_of_curves_in_the_picture(other: Any, note: str) -> None:
    figure = style.new_figure(2.0, "")
    axes = figure.subplots()
    for name, values in {"a2": WAVE, "b": other, "c": 2.0 + WAVE}.items():
        axes.plot(TIME, values, label=f"{name}: 3 mm", linewidth=1.0)
    axes.set(xlabel="time [s]", ylabel="error [mm]", xlim=(0.0, 10.0), ylim=(-1.2, 3.2))
    list(style.with_panels([("", figure)]))
    assert figure.notes == note
    lower, upper, apart = (line.get_linewidth() for line in axes.get_lines())
    assert (lower > 1.0) == bool(note)
    assert upper == apart == 1.0


def test_curves_that_fill_an_area_are_below_the_others() -> None:
    figure = style.new_figure(2.0, "")
    axes = figure.subplots()
    axes.plot(TIME, WAVE, label="smooth")
    axes.plot(TIME, WAVE * (-1.0) ** np.arange(400), label="vibrates")
    axes.set_ylabel("error [mm]")
    list(style.with_panels([("", figure)]))
    smooth, vibrates = axes.get_lines()
    assert smooth.get_zorder() > vibrates.get_zorder()


def test_notes_shorten_numbered_names() -> None:
    names = ["wheel1L", "wheel2L", "wheel3L", "joint_1", "joint_2", "tip"]
    assert overlap.listed(names) == "wheel1L–wheel3L, joint_1, joint_2 and tip"


def shifted(record: Record) -> Record:
    """Return a record whose energies, forces and hand are far from the original."""
    moved = copy.deepcopy(record)
    for name in ("energy_electrical", "work_mechanical", "contact_normal_force", "hand_position"):
        moved[name][:] = 3.0 * moved[name] + 0.5
    return moved


@pytest.mark.parametrize("size", [7.2, 3.4])
def test_note_on_many_events_overlaps_nothing(real: Record, size: float) -> None:
    """All kinds of events, three digits each."""
    crowded = copy.copy(real)
    crowded.events = [Event(0.001 * k, kind, "elbow_7") for k in range(100) for kind in contacts.MARKS]
    for name in ("energy", "contact_forces"):
        figure = dynsim.figure(crowded, name, size=size)
        assert name != "energy" or re.search(r"landing \(100 in \d+ marks\)", figure.caption)
        # So many lines would hide the curves.
        assert not event_lines(figure.axes[-1])
        assert layout_faults(figure) == []


def test_shares_near_none_and_all_are_told_from_them() -> None:
    shares = (0.0, 3e-4, 2e-6, 0.0314, 0.5, 0.9996, 1.0 - 1e-6, 1.0)
    texts = [measures.percent(share) for share in shares]
    assert texts == ["0.0 %", "0.03 %", "0.0002 %", "3.1 %", "50.0 %", "99.96 %", "99.9999 %", "100.0 %"]


def test_close_events_share_a_line(pendulum: Record) -> None:
    record = copy.copy(pendulum)
    record.events = []
    for time in (0.0, 0.001, 0.5, 0.5 + 2.0 * contacts.APART, 0.501, 1.5):
        record.add_event(time, "bounce", "tip")
    axes = style.new_figure(2.0, "").subplots()
    axes.set_xlim(0.0, 1.0)
    contacts.mark(axes, contacts.marked(record))
    assert event_lines(axes) == [0.0, 0.5, 0.5 + 2.0 * contacts.APART]
    assert contacts.marked(record, ["other"]) == []
    assert axes.get_xlim() == (0.0, 1.0)


def test_numbers_have_powers_of_ten() -> None:
    assert style.number(4.41e-13, 2) == "4.4 × 10⁻¹³"
    assert (style.number(-1e-6), style.number(12345678.0), style.number(0.25)) == ("−10⁻⁶", "1.235 × 10⁷", "0.25")


def test_ledger_figure_has_the_losses_of_impacts(real: Record, braced: Record) -> None:
    assert says(texts(drawn(energy.ledger(real))), "impacts")
    assert not says(texts(drawn(energy.ledger(braced))), "impacts")


def test_contacts_that_never_touch_are_not_drawn(real: Record) -> None:
    """Of candidates on every joint most stay in the air; comparing, only those runs that touched have a curve."""
    overrides = {**SHORT, "contacts.candidates": "joints", "contacts.points": {}}
    record = dynsim.simulate(load_scenario("elbow_comparison_floor", "two_elbows", overrides))
    assert len(record.summary["contacts"]) > 5
    figure = drawn(contacts.forces(record))
    assert {axes.get_ylabel().split("\n")[0] for axes in figure.axes} - {""} == {"joint_4", "joint_7"}
    body, _ = posture.skeleton(record)
    assert body is not None
    assert [point.name for point, *_ in body.contacts()] == ["joint_4", "joint_7"]
    mixed = drawn(contacts.forces_comparison({"points": real, "joints": record}))
    assert {axes.get_ylabel().split("\n")[0] for axes in mixed.axes} - {""} == {
        "elbow_4", "elbow_7", "joint_4", "joint_7",
    }  # fmt: skip
    assert not says(texts(mixed), "pulling")


@pytest.mark.long
def test_glued_beside_real(real: Record, braced: Record, tmp_path: Path) -> None:
    figure = drawn(contacts.forces_comparison({"glued": braced, "real": real}))
    assert lines_with(texts(figure), "glued")
    assert lines_with(texts(figure), "real")
    assert says(texts(figure), "pulling")
    assert_pngs(figures.draw_comparison({"glued": braced, "real": real}, tmp_path), tmp_path, COMPARISONS)


@pytest.mark.parametrize(("more", "curves"), [(1.0, 1), (1.2, 2)])
def test_drawn_energy_is_a_curve_where_it_differs_from_net(braced: Record, more: float, curves: int) -> None:
    record = without(braced, "energy_electrical_drawn")
    record.add("energy_electrical_drawn", more * braced["energy_electrical"], "J")
    top = drawn(energy.energy(record)).axes[0]
    assert len([line for line in top.get_lines() if not str(line.get_label()).startswith("_")]) == curves
    assert "taken from the supply" in texts(drawn(energy.energy(record)))


def test_ten_motors_are_an_envelope_and_six(braced: Record) -> None:
    shown = texts(drawn(energy.motors(braced))).splitlines()
    assert mentions(shown[0], "10")
    assert len(shown) == 1 + energy.LARGEST


SERVOS = """\
duration_s: 0.3
plant:
  type: serial_arm
  link: {mass_kg: 0.2, length_m: 0.2, motor: {type: servo, voltage_V: 12, stall_torque_N_m: 0.9,
    no_load_speed_rad_per_s: 5, k_p_V_per_rad: 40, nominal_torque_N_m: 0.5}}
  chain: [{axis: z}, {axis: y, initial_deg: 40}, {axis: y, initial_deg: 20}]
controller: {type: joint_pd}
"""


def test_limits_and_ratings_of_motors_are_drawn(tmp_path: Path) -> None:
    (tmp_path / "servos.yaml").write_text(SERVOS)
    record = dynsim.simulate(load_scenario(tmp_path / "servos.yaml"))
    bars = drawn(energy.torques(record)).axes[0]
    widths = [patch.get_width() for patch in bars.patches]
    loads = record.summary["motors"]
    assert widths == [motor[key] for key in ("torque_max_N_m", "torque_rms_N_m") for motor in loads]
    marks = [tuple(line.get_xdata()) for line in bars.get_lines()]
    assert marks == [(pytest.approx(0.9),) * 2] * 3 + [(0.5, 0.5)] * 3
    assert bars.get_xlim()[1] > 0.9
    figure = drawn(energy.motors(record))
    levels = [abs(line.get_ydata()[0]) for line in figure.axes[0].get_lines() if len(line.get_xdata()) == 2]
    levels = [level for level in levels if level > 0.0]
    assert {round(level, 9) for level in levels} == {0.9, 0.5}
    assert "limit of the torque" in texts(figure)
    record["torque"][:] *= 0.1
    assert "limit of the torque" in drawn(energy.motors(record)).caption


def test_what_lies_below_a_surface_is_marked(braced: Record) -> None:
    body, _ = posture.skeleton(braced)
    assert body is not None
    assert robot.penetrations(braced, body.scene, np.array([0])) == []
    sunk = copy.copy(braced)
    sunk.signals = dict(braced.signals)
    moved = braced["body_position"].copy()
    moved[:, 4:, 2] -= 0.25
    sunk.signals["body_position"] = dataclasses.replace(braced.signals["body_position"], data=moved)
    body, _ = posture.skeleton(sunk)
    assert body is not None
    marked = robot.penetrations(sunk, body.scene, np.array([len(sunk) - 1]))
    # Of a horizontal floor at zero the depth is the height of the lowest point.
    lowest = -body.segments(len(sunk) - 1)[..., 2].min()
    assert max(penetration.depth.max() for penetration in marked) == pytest.approx(lowest, rel=1e-12)
    assert {penetration.surface for penetration in marked} == {"floor"}
    assert lines_with(texts(drawn(posture.posture(sunk))), "floor", "250 mm")
    assert not lines_with(texts(drawn(posture.posture(braced))), "floor")


@pytest.mark.parametrize(("angle", "read"), [(-1e-9, "0"), (-0.4, "0"), (-30.2, "−30"), (180.0, "180")])
def test_the_azimuth_of_the_side_plane_has_no_minus_zero(angle: float, read: str) -> None:
    turn = np.radians(angle)
    plane = posture.SidePlane(np.zeros(3), np.array([[np.cos(turn), np.sin(turn), 0.0], [0.0, 0.0, 1.0]]))
    assert f" {read}°" in plane.label


def test_a_figure_for_a_paper_has_no_title() -> None:
    scenario = load_scenario("elbow_comparison", "two_elbows", {"duration_s": 0.1})
    record = dynsim.simulate(scenario)
    titled, bare = (dynsim.figure(record, "energy", title=title) for title in (True, False))
    assert titled.get_suptitle().startswith("elbow comparison")
    assert bare.get_suptitle() == ""
    assert len(bare.axes) == len(titled.axes) > 0
    both = dynsim.figure({"one": record, "two": record}, "compare_energy", title=False)
    assert both.axes
    with raises(RecordError, "enrgy", "hand_path, tracking_error"):
        dynsim.figure(record, "enrgy")
    with raises(RecordError, "base"):
        dynsim.figure(record, "base")
    with raises(RecordError):
        dynsim.figure({}, "compare_energy")
