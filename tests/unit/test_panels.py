"""Figures of only some panels: names, remaining axes, labels, legends, heights; in Python and on the command line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support.layout import layout_faults
from support.messages import mentions, raises

import dynsim
from dynsim.cli import main
from dynsim.draw.figures import arm, panels
from dynsim.draw.figures.style import Drawing
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.scenario import load_scenario

NAMES = {
    "compare_energy": ["electrical energy", "total energy", "mechanical work"],
    "compare_tracking_error": ["distance from target", "vertical error"],
    "compare_hand_path": ["y over x", "z over x", "z over y"],
    "compare_contact_forces": ["elbow_4 normal force", "elbow_7 normal force"],
    "compare_posture": ["braced", "free"],
}


@pytest.fixture(scope="module")
def records() -> dict[str, Record]:
    changes = {"duration_s": 0.3, "metrics.settle_s": 0.1, "integrator.rtol": 1e-4}
    variants = {"braced": "two_elbows", "free": "no_elbow"}
    return {name: dynsim.simulate(load_scenario("elbow_comparison", v, changes)) for name, v in variants.items()}


def drawn(records: Record | dict[str, Record], name: str, **options: object) -> Drawing:
    figure = dynsim.figure(records, name, **options)
    assert isinstance(figure, Drawing)
    return figure


def legend(figure: Drawing) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


@pytest.mark.parametrize(("name", "size"), [*((name, 3.4) for name in NAMES), ("compare_tracking_error", 7.2)])
def test_each_panel_of_a_comparison_alone(records: dict[str, Record], name: str, size: float) -> None:
    everything = drawn(records, name, size=size)
    assert list(panels.named(everything)) == NAMES[name]
    for panel in NAMES[name]:
        figure = drawn(records, name, size=size, panels=[panel])
        assert list(panels.named(figure)) == [panel]
        assert layout_faults(figure) == []
        assert figure.axes[0].get_xlabel()
        assert figure.get_figwidth() == size
        # At a fixed scale, a panel may use the width of the panels that were beside it.
        if figure.axes[0].get_aspect() == "auto":
            assert figure.get_figheight() < everything.get_figheight()


def test_panels_keep_their_height_and_their_legend(records: dict[str, Record]) -> None:
    everything = drawn(records, "compare_energy", size=3.4)
    figure = drawn(records, "compare_energy", size=3.4, panels="work")
    for drawing in (everything, figure):
        drawing.draw_without_rendering()
    height = everything.axes[2].get_window_extent().height
    assert figure.axes[0].get_window_extent().height == pytest.approx(height, rel=0.05)
    assert legend(figure) == legend(everything) == ["braced", "free"]
    assert figure.axes[0].get_xlabel() == "time [s]"


def test_legend_omits_what_no_panel_shows(records: dict[str, Record]) -> None:
    assert legend(drawn(records, "compare_energy", panels="total")) == []  # the bars have names
    ledger = [legend(drawn(records["free"], "energy_ledger", panels=part)) for part in (None, "without Joule heat")]
    assert [any(text.startswith("Joule heat") for text in texts) for texts in ledger] == [True, False]
    assert set(ledger[1]) < set(ledger[0])


def test_height_of_user_fits_a_single_panel(records: dict[str, Record]) -> None:
    figure = drawn(records, "compare_tracking_error", panels=["distance"], size="3.4x2.2", title=False)
    assert figure.get_figheight() == 2.2
    assert layout_faults(figure) == []
    with raises(RecordError, "3.4x1.2", "fewer panels"):
        drawn(records, "compare_tracking_error", size="3.4x1.2")


def test_exact_name_takes_precedence_over_parts(records: dict[str, Record]) -> None:
    shown = [list(panels.named(drawn(records, "compare_energy", panels=text))) for text in ("Total Energy", "energy")]
    assert shown == [["total energy"], ["electrical energy", "total energy"]]


def test_unknown_panel_is_an_error_with_the_names(records: dict[str, Record]) -> None:
    with raises(RecordError, "'torque'", "electrical energy, total energy, mechanical work"):
        dynsim.figure(records, "compare_energy", panels="work, torque")


def test_plot_draws_only_the_figures_with_the_panels(
    records: dict[str, Record], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [str(record.save(tmp_path / f"{name}.h5")) for name, record in records.items()]
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["dynsim", "plot", *files, "--out", str(out), "--panels", "work,vertical"])
    with pytest.raises(SystemExit, match="0"):
        main()
    assert sorted(path.name for path in out.glob("*.png")) == ["compare_energy.png", "compare_tracking_error.png"]
    monkeypatch.setattr(sys, "argv", ["dynsim", "plot", files[0], "--out", str(tmp_path / "no"), "--panels", "bogus"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code
    assert mentions(capsys.readouterr().err, "'bogus'", "tracking_error: hand − target, distance from target")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("name", list(arm.FIGURES))
def test_names_of_panels_are_words(records: dict[str, Record], name: str) -> None:
    figure = arm.FIGURES[name](records["braced"])
    names = [] if figure is None else panels.named(figure)
    assert bool(names) == (name not in ("base", "overturning", "base_tracking"))
    assert not any("[" in text or "$" in text or "\n" in text for text in names)


@pytest.mark.long
def test_panels_of_a_snake() -> None:
    record = dynsim.simulate(load_scenario("snake_joint_limits", None, {"duration_s": 1.0, "record.rate_hz": 20}))
    for part, name in (("position error", "tracking"), ("yaw", "joints"), ("mode", "redundancy")):
        figure = drawn(record, name, size=3.4, panels=[part])
        assert all(part in panel for panel in panels.named(figure))
        assert layout_faults(figure) == []
    figure = drawn({"one": record, "two": record}, "comparison", panels="cost", size=3.4)
    assert legend(figure) == ["one", "two"]
    assert figure.axes[0].get_xlabel() == "time [s]"
