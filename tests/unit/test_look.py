"""Size, font and style of figures: options of the user, settings of matplotlib, style sheets, and errors."""

from __future__ import annotations

import re
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib
import pytest
from cycler import cycler
from matplotlib.legend import Legend
from PIL import Image
from support.layout import layout_faults
from support.messages import lines_with, raises

import dynsim
from dynsim.cli import main
from dynsim.draw.figures import draw, style
from dynsim.draw.figures.look import Look
from dynsim.draw.figures.style import POINTS, WIDTH, Drawing
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.scenario import load_scenario


@pytest.fixture(scope="module")
def record() -> Record:
    changes = {"duration_s": 0.3, "metrics.settle_s": 0.1}
    return dynsim.simulate(load_scenario("elbow_comparison", "two_elbows", changes))


def drawn(record: Record | dict[str, Record], name: str = "tracking_error", **options: object) -> Drawing:
    figure = dynsim.figure(record, name, **options)
    assert isinstance(figure, Drawing)
    return figure


def test_default_size_and_font(record: Record) -> None:
    figure = drawn(record)
    label = figure.axes[0].yaxis.label
    assert (figure.get_figwidth(), label.get_fontsize()) == (WIDTH, POINTS)


def test_settings_of_matplotlib_are_respected(record: Record) -> None:
    with matplotlib.rc_context():
        matplotlib.rcParams.update(
            {
                "font.family": "serif",
                "font.size": 6.0,
                "axes.labelsize": 7.0,
                "figure.figsize": (3.4, 2.9),
                "lines.linewidth": 3.0,
                "axes.prop_cycle": cycler(color=["#112233", "#445566", "#778899"]),
            }
        )
        figure = drawn(record)
        before = dict(matplotlib.rcParams)
        drawn(record, "motors")
        assert dict(matplotlib.rcParams) == before
    assert figure.get_figwidth() == 3.4
    assert figure.get_figheight() >= 2.9
    components, distance = figure.axes
    assert components.yaxis.label.get_family() == ["serif"]
    assert components.yaxis.label.get_fontsize() == 7.0
    assert components.yaxis.get_ticklabels()[0].get_fontsize() == pytest.approx(0.88 * 6.0)
    assert [line.get_color() for line in components.get_lines()[:3]] == ["#112233", "#445566", "#778899"]
    assert distance.get_lines()[0].get_linewidth() == 3.0


@pytest.mark.parametrize(
    ("size", "width", "height"), [(5.0, 5.0, None), ("86mm", 86 / 25.4, None), ((4.0, 3.0), 4.0, 3.0), ("4x3", 4, 3)]
)
def test_size_of_figure(record: Record, size: object, width: float, height: float | None) -> None:
    figure = drawn(record, size=size)
    assert figure.get_figwidth() == pytest.approx(width)
    assert height is None or figure.get_figheight() == height


def test_font_scales_all_letters(record: Record) -> None:
    figure = drawn(record, font="serif 12")
    assert figure.axes[0].yaxis.label.get_fontsize() == 12.0
    assert figure.axes[0].yaxis.label.get_family() == ["serif"]
    legend = figure.axes[-1].get_legend()
    assert legend is not None
    assert legend.get_texts()[0].get_fontsize() == pytest.approx(0.88 * 12.0)


@pytest.mark.parametrize(
    ("family", "symbols"), [("serif", "dejavuserif"), ("sans-serif", "dejavusans"), ("STIXGeneral", "stix")]
)
def test_symbols_match_the_font(record: Record, family: str, symbols: str) -> None:
    label = drawn(record, "hand_path", font=family).axes[-1].xaxis.label
    assert (label.get_family(), label.get_math_fontfamily()) == ([family], symbols)


@pytest.mark.parametrize("kind", ["pdf", "eps"])
def test_vector_files_have_no_fonts_of_type_3(record: Record, tmp_path: Path, kind: str) -> None:
    figure = drawn(record)
    figure.savefig(tmp_path / f"figure.{kind}")
    content = (tmp_path / f"figure.{kind}").read_bytes()
    assert b"CIDFontType2" in content or b"FontType 42" in content
    assert b"/Type3" not in content
    assert b"FontType 3" not in content


@pytest.mark.parametrize("even", [False, True])
def test_lines_are_not_wider_than_the_figure_and_keep_units(even: bool) -> None:
    text = "WIDE AND HEAVY MASSES MMMM WWWW at 0.123 N m, 12.5 s, 3 mm and 4 kg; " * 3
    lines = style.broken(text, 2.0, 8.0, even=even).split("\n")
    assert " ".join(lines) == text.strip()
    assert all(style.text_width(line, 8.0) <= 144.0 for line in lines)
    assert not any(line.split()[0].rstrip(",;") in ("N", "s", "mm", "kg") for line in lines)


def test_later_style_sheet_takes_precedence(record: Record, tmp_path: Path) -> None:
    for name, width in (("thin", 0.5), ("wide", 2.5)):
        (tmp_path / f"{name}.mplstyle").write_text(f"lines.linewidth: {width}\naxes.facecolor: eeeeee\n")
    sheets = [tmp_path / "wide.mplstyle", tmp_path / "thin.mplstyle"]
    axes = drawn(record, style=sheets).axes[-1]
    assert axes.get_lines()[0].get_linewidth() == 0.5
    assert matplotlib.colors.to_hex(axes.get_facecolor()) == "#eeeeee"
    assert drawn(record, style=f"{sheets[1]},{sheets[0]}").axes[-1].get_lines()[0].get_linewidth() == 2.5


def test_caption_has_the_notes_even_if_they_are_not_drawn(record: Record) -> None:
    figures = [drawn(record, "contact_forces", caption=caption) for caption in (True, False)]
    assert "5 ms" in figures[0].caption
    assert figures[0].caption == figures[1].caption
    shown = ["5 ms" in " ".join(text.get_text() for text in figure.texts) for figure in figures]
    assert shown == [True, False]
    assert figures[0].get_figheight() > figures[1].get_figheight()


@pytest.mark.parametrize(("points", "fault"), [(-3.0, True), (0.5, True), (2.0, False)])
def test_layout_faults_include_text_near_the_edge(record: Record, points: float, fault: bool) -> None:
    figure = drawn(record)
    figure.text(points / 72.0 / figure.get_figwidth(), 0.5, "iii", rotation=90)
    assert bool(lines_with(layout_faults(figure), "iii", "edge")) is fault


def test_caption_names_subject_run_and_axes(record: Record) -> None:
    assert drawn(record).caption.splitlines()[0] == (
        "Tracking error (elbow comparison / two_elbows): hand − target [mm], distance from target [mm] over time [s]."
    )
    path = drawn(record, "hand_path", title=False).caption.splitlines()[0]
    assert path == "Hand path (elbow comparison / two_elbows): y [m], z [m] over x [m]; z [m] over y [m]."


def test_caption_describes_lines_and_logarithmic_axes(record: Record) -> None:
    caption = drawn({"one": record, "two": record}, "compare_tracking_error").caption
    assert re.search(r"one: [^;]* \(blue, solid\); two: [^;]* \(green, dashed\)", caption)
    figure = drawn(record)
    assert "Logarithmic axes" not in figure.caption
    for axes in figure.axes[2:]:
        axes.set_yscale("log")
    assert "Logarithmic axes: distance from target." in figure.caption


def test_style_sheet_sets_the_resolution_of_files(record: Record, tmp_path: Path) -> None:
    sheet = tmp_path / "fine.mplstyle"
    sheet.write_text("savefig.dpi: 300\n")
    (fine,) = draw(record, tmp_path / "fine", look=Look.of(3.4, style=sheet, panels="distance"))
    (usual,) = draw(record, tmp_path / "usual", look=Look.of(3.4, panels="distance"))
    with Image.open(fine) as large, Image.open(usual) as small:
        assert (large.width, small.width) == (1020, 578)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"size": "wide"}, ("size", "wide", "3.4x2.4")),
        ({"size": 0.2}, ("size", "0.2", "1", "40")),
        ({"size": (3.0, 2.0, 1.0)}, ("size", "pair")),
        ({"size": True}, ("size", "True", "pair")),
        ({"size": 10**400}, ("size", "40")),
        ({"font": "nosuchfont 8"}, ("font", "nosuchfont")),
        ({"font": "serif 80"}, ("font", "80", "40")),
        ({"font": ""}, ("font", "family")),
        ({"style": "nosuchsheet"}, ("style", "nosuchsheet", "ggplot")),
    ],
)
def test_unusable_look_is_an_error(record: Record, options: dict[str, object], words: tuple[str, ...]) -> None:
    with raises(RecordError, *words):
        dynsim.figure(record, "tracking_error", **options)


@pytest.mark.parametrize("option", [("--size", "wide"), ("--font", "nosuchfont"), ("--style", "nosuchsheet")])
def test_unusable_option_is_an_error_and_leaves_files(
    option: tuple[str, str],
    record: Record,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = record.save(tmp_path / "record.h5")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "hand_path.png").write_text("before")
    monkeypatch.setattr(sys, "argv", ["dynsim", "plot", str(file), "--out", str(tmp_path / "out"), *option])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code
    assert option[1] in capsys.readouterr().err
    assert [path.read_text() for path in (tmp_path / "out").iterdir()] == ["before"]


def test_height_without_space_is_an_error(record: Record) -> None:
    with raises(RecordError, "size", "3.4x1.2", " in") as caught:
        drawn(record, "motors", size=(3.4, 1.2))
    height = float(re.findall(r"a height of ([\d.]+) in", str(caught.value))[0])
    # Notes on curves that coincide are added later.
    assert height == pytest.approx(drawn(record, "motors", size=3.4).needed, rel=0.05)


@pytest.mark.parametrize(
    ("sheet", "words"),
    [
        ("axes.facecolr: eeeeee", ("axes.facecolr", "line 1")),
        ("lines.linewidth: 1\nfont.size: blah", ("font.size", "line 2", "blah")),
        ("text.usetex: True", ("text.usetex", "mathtext.fontset")),
    ],
)
def test_unusable_style_sheet_is_an_error(record: Record, tmp_path: Path, sheet: str, words: tuple[str, ...]) -> None:
    (tmp_path / "bad.mplstyle").write_text(sheet)
    with raises(RecordError, "bad.mplstyle", *words):
        drawn(record, style=tmp_path / "bad.mplstyle")


def test_latex_is_not_used_for_names(record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also for labels of ticks that are created when the file is written."""
    monkeypatch.setenv("PATH", str(tmp_path))  # without LaTeX
    with matplotlib.rc_context({"text.usetex": True}):
        drawn(record, "hand_path").savefig(tmp_path / "path.png")
        assert matplotlib.rcParams["text.usetex"]
    assert (tmp_path / "path.png").stat().st_size > 10_000


def test_threads_draw_with_their_own_look_and_leave_settings(record: Record) -> None:
    before, interval = dict(matplotlib.rcParams), sys.getswitchinterval()
    looks = [(5.0, None), (9.0, "ggplot"), (13.0, "dark_background"), (20.0, None)]

    def size(points: float, sheet: str | None) -> float:
        return drawn(record, "energy", font=points, style=sheet, size=3.4).axes[0].yaxis.label.get_fontsize()

    one_by_one = [size(*wanted) for wanted in looks * 2]
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(len(looks)) as pool:
            sizes = list(pool.map(size, *zip(*looks * 2, strict=True)))
    finally:
        sys.setswitchinterval(interval)
    assert sizes == one_by_one
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize(
    "name", ["compare_energy", "compare_hand_path", "compare_tracking_error", "compare_contact_forces"]
)
def test_names_with_underscores_or_blanks_have_legend_entries(record: Record, name: str) -> None:
    figure = drawn({"_slow": record, "plain": record, "": record}, name)
    legends = [legend for legend in [*figure.findobj(Legend)] if legend is not None]
    texts = [text.get_text().strip() for legend in legends for text in legend.get_texts()]
    texts += [label.get_text() for axes in figure.axes for label in axes.get_xticklabels() + axes.get_yticklabels()]
    for shown in ("_slow", "plain", "(no name)"):
        assert any(text.startswith(shown) for text in texts)


def test_look_without_options_is_the_default() -> None:
    assert Look.of() == Look()
