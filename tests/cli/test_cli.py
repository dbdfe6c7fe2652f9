"""The command line: files, exit codes, one-line errors, completion, help, ASCII terminals, a folder that is gone."""

import csv
import io
import json
import os
import re
import subprocess
import sys
import warnings
from contextlib import ExitStack, chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from ruamel.yaml import YAML
from support.messages import check_message, lines_with, mentions, says

from dynsim._version import __version__
from dynsim.cli import commands, drawing, main
from dynsim.cli.tables import _CONTACT_ROWS
from dynsim.engine import check
from dynsim.jit.kernel import cache_folder
from dynsim.record import FORMAT, Record
from dynsim.scenario import SHIPPED, build, build_model, load_scenario

SHORT = ["--set", "duration_s=0.2", "--set", "metrics.settle_s=0.05"]


def dynsim(*arguments: str, folder: Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """The command in this process; in one of its own where that has options, such as an environment."""
    if options:
        command = [sys.executable, "-m", "dynsim", *arguments]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, **options)
    output, errors = io.StringIO(), io.StringIO()
    with ExitStack() as inside, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["dynsim", *arguments])
        # As outside of pytest: a warning is printed.
        inside.enter_context(warnings.catch_warnings())
        warnings.simplefilter("default")
        for part in (chdir(folder), redirect_stdout(output), redirect_stderr(errors)):
            inside.enter_context(part)
        with pytest.raises(SystemExit) as ended:
            main()
    return subprocess.CompletedProcess(arguments, int(ended.value.code or 0), output.getvalue(), errors.getvalue())


def test_run_writes_everything_that_is_promised(tmp_path: Path):
    result = dynsim("run", "elbow_comparison", "--variant", "elbow_7", "--no-figures", *SHORT, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    folder = tmp_path / "results" / "elbow_comparison" / "elbow_7"
    assert {path.name for path in folder.iterdir()} == {"record.h5", "summary.json", "scenario.yaml"}
    summary = json.loads((folder / "summary.json").read_text())
    promised = {
        "scenario", "variant", "dynsim_version", "duration_s", "integration_wall_s", "real_time_factor", "steps",
        "rhs_evaluations", "hand_error_rms_m", "hand_error_max_m", "hand_error_z_rms_m", "electrical_energy_J",
        "electrical_energy_supply_J", "electrical_energy_drawn_J", "mechanical_work_J", "joule_heat_J",
        "energy_residual_relative", "constraint_drift_max_m", "contacts", "sinking", "warnings",
    }  # fmt: skip
    assert promised <= set(summary)
    in_contacts = {
        "name", "normal_force_min_N", "normal_force_mean_N", "normal_force_max_N", "closed_fraction",
        "pulling_fraction", "slip_distance_m",
    }  # fmt: skip
    assert in_contacts <= set(summary["contacts"][0])
    # The resolved scenario runs by itself and gives the same numbers.
    again = dynsim("run", str(folder / "scenario.yaml"), "--no-figures", "--out", "again", "-q", folder=tmp_path)
    assert (again.returncode, again.stdout) == (0, "")
    repeated = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert repeated["electrical_energy_J"] == summary["electrical_energy_J"]


def test_compare_prints_the_table_and_writes_the_comparison(tmp_path: Path):
    result = dynsim("compare", "elbow_comparison", "--no-figures", *SHORT, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    # The heading of the table: names of contacts are those of variants.
    assert any(line.split() == ["two_elbows", "elbow_7", "elbow_4", "no_elbow"] for line in result.stdout.splitlines())
    folder = tmp_path / "results" / "elbow_comparison"
    variants = json.loads((folder / "comparison.json").read_text())["variants"]
    assert list(variants) == ["two_elbows", "elbow_7", "elbow_4", "no_elbow"]
    rows = (folder / "comparison.csv").read_text().splitlines()
    assert len(rows) == 5
    assert rows[0].startswith("variant,")
    assert [row.split(",")[0] for row in rows[1:]] == list(variants)
    assert {"elbow_4.closed_fraction", "elbow_4.slip_distance_m"} <= set(rows[0].split(","))


def test_comparison_table_contains_all_entries_and_warnings(tmp_path: Path):
    result = dynsim("compare", "elbow_comparison", "--no-figures", "-q", *SHORT, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    folder = tmp_path / "results" / "elbow_comparison"
    summaries = json.loads((folder / "comparison.json").read_text())["variants"]
    with (folder / "comparison.csv").open(newline="") as stream:
        rows = {row["variant"]: row for row in csv.DictReader(stream)}
    for variant, summary in summaries.items():
        row = rows[variant]
        assert row["warnings"] == "; ".join(summary["warnings"])
        assert [row[key] for key in ("method", "steps")] == [summary["method"], str(summary["steps"])]
        for motor in summary["motors"]:
            assert float(row[f"{motor['joint']}.torque_rms_N_m"]) == motor["torque_rms_N_m"]
        for sunk in summary["sinking"]:
            assert float(row[f"{sunk['body']}.{sunk['surface']}.depth_m"]) == sunk["depth_m"]
    assert any(summary["sinking"] for summary in summaries.values())


def test_tables_of_the_paper_are_written_without_figures(tmp_path: Path):
    result = dynsim("compare", "snake_positioning", "--no-figures", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    folder = tmp_path / "results" / "snake_positioning"
    assert not list(folder.glob("*.png"))
    rows = list(csv.reader((folder / "table_iii.csv").read_text().splitlines()))
    assert len(rows) == 1 + 4 * 6
    assert "rows" not in result.stdout  # the table fits on the screen


@pytest.mark.parametrize(
    ("few", "options", "single"),
    [
        (4, [], True),
        (4, ["--no-variant-figures"], False),
        (3, [], False),
        (3, ["--variant-figures"], True),
        (3, ["--variant-figures", "--panels", "error"], False),
    ],
)
def test_compare_draws_the_figures_of_few_variants(
    few: int, options: list[str], single: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Those of many on request; never their animations."""
    drawn: list[drawing.Figures] = []
    monkeypatch.setattr(commands, "draw_all", lambda wanted, page, quiet: drawn.extend(wanted))
    monkeypatch.setattr(commands, "FEW", few)
    result = dynsim("compare", "elbow_comparison", "-q", *options, *SHORT, "--out", "out", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    together, *others = drawn
    assert len(together.records) == 4
    assert [name for figures in others for name in figures.records] == (list(together.records) if single else [])
    assert not any(figures.look.film for figures in others)


def test_compare_says_what_real_contacts_did(tmp_path: Path):
    result = dynsim("compare", "elbow_comparison_floor", "--no-figures", "--rows", "all", *SHORT, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    said = result.stdout.splitlines()
    for heading, _, real in _CONTACT_ROWS:
        assert any(heading.strip() in line for line in said) is (real is not False), heading
    folder = tmp_path / "results" / "elbow_comparison_floor"
    with (folder / "comparison.csv").open(newline="") as stream:
        by_variant = {row["variant"]: row for row in csv.DictReader(stream)}
    for variant, summary in json.loads((folder / "comparison.json").read_text())["variants"].items():
        assert float(by_variant[variant]["impact_loss_J"]) == summary["impact_loss_J"]
        having = {contact["name"]: contact for contact in summary["contacts"]}
        for name in ("elbow_4", "elbow_7"):
            for key in (
                "sticking_fraction",
                "sliding_fraction",
                "lift_offs",
                "landings",
                "slip_starts",
                "impact_loss_J",
            ):
                cell = by_variant[variant][f"{name}.{key}"]
                assert cell == (str(having[name][key]) if name in having else "")


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["run", "nonsense.yaml"], ("nonsense.yaml",)),
        (["run", "elbow_comparison", "--variant", "elbow_5"], ("elbow_5", "'elbow_7'")),
        (["run", "elbow_comparison", "--set", "integrator.rtol"], ("--set integrator.rtol", "integrator.rtol=1e-8")),
        (["run", "elbow_comparison", "--set", "plant.link.mass_kg=-1"], ("plant.link.mass_kg = -1",)),
        (
            ["run", "elbow_comparison", "--set", "plant.link.motor.inductance_H=0"],
            ("plant.link.motor.inductance_H = 0",),
        ),
        (["compare", "single_pendulum"], ("single_pendulum",)),
        (["check", "elbow_comparison", "--set", "duraton_s=1"], ("duraton_s", "'duration_s'")),
        (["plot", "missing.h5"], ("missing.h5",)),
        (["run", "elbow_comparison", "--set", "record.rate_hz=1e7"], ("record.rate_hz", "GB")),
        (["run", "."], (re.compile(r"^error: \.: "),)),
        (
            ["run", "elbow_comparison", "--set", "plant.initial_deg.1=40"],
            (".yaml:46 (two_elbows): contacts.points.elbow_4", "+0.03698 m", "floor"),
        ),
        (
            ["check", "elbow_comparison", "--set", "controller.hand.path.radius_m=0.6"],
            ("controller.hand.path", "0.000 s", "0.34 m"),
        ),
        (
            ["check", "six_axis_arm", "--set", "plant.motor.inductance_H=0"],
            ("plant.motor.inductance_H = 0",),
        ),
        (["check", "elbow_comparison", "--set", "a:b"], ("--set a:b", "integrator.rtol=1e-8")),
        (
            [
                "check",
                "elbow_comparison",
                "--set",
                "plant.link.motor.inductance_H=1e-9",
                "--set",
                "integrator.method=dopri5",
            ],
            ("integrator.method: auto", "radau5"),
        ),
        (["plot", "other.h5"], ("other.h5", "SHA-256")),
        (["plot", "other.h5", "--trust"], ("other.h5",)),
        (["run", "single_pendulum", "--out", "other.h5"], ("other.h5",)),
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture, arguments: list[str], names: tuple
):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.attrs["format"] = FORMAT
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["dynsim", *arguments])
    with pytest.raises(SystemExit) as exit_code:
        main()
    assert exit_code.value.code == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if line.strip()]
    assert len(lines) == 1
    check_message(lines[0], *names)
    assert not (tmp_path / "results").exists()


def test_plot_keeps_apart_records_of_the_same_variant(tmp_path: Path):
    for name in ("a", "b"):
        arguments = ["single_pendulum", "--no-figures", "--set", "duration_s=0.2", "--set", "metrics.settle_s=0.05"]
        assert dynsim("run", *arguments, "--out", f"{name}/pendulum", folder=tmp_path).returncode == 0
    result = dynsim("plot", "a/pendulum/record.h5", "b/pendulum/record.h5", "--out", "figures", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    folders = {path.name for path in (tmp_path / "figures").iterdir() if path.is_dir()}
    assert folders == {"pendulum", "pendulum_2"}
    assert (tmp_path / "figures" / "compare_hand_path.png").is_file()


@pytest.mark.parametrize("arguments", [["run", "a\nb"], ["sweep", "single_pendulum", "--grid", "a\nb"]])
def test_error_with_a_line_break_in_an_option_is_one_line(arguments: list[str], tmp_path: Path):
    result = dynsim(*arguments, folder=tmp_path)
    assert result.returncode == 2
    check_message(result.stderr, r"a\nb")


def test_plot_rejects_records_without_a_common_overlay_before_it_draws(tmp_path: Path):
    arm, other = Record([0.0, 1.0]), Record([0.0, 1.0])
    arm.add("hand_position", [[0.0, 0.0, 1.0]] * 2, "m", labels=("x", "y", "z"))
    other.add("pressure", [0.0, 1.0], "Pa")
    arm.save(tmp_path / "arm.h5")
    other.save(tmp_path / "other.h5")
    result = dynsim("plot", "arm.h5", "other.h5", "--out", "figures", folder=tmp_path)
    assert result.returncode == 2
    check_message(result.stderr, "other", "pressure")
    assert not (tmp_path / "figures").exists()


@pytest.mark.long
def test_figures_in_another_format_replace_those_of_the_run_before(tmp_path: Path):
    arguments = ["run", "single_pendulum", "--set", "duration_s=0.2", "--set", "metrics.settle_s=0.05", "--out", "out"]
    assert dynsim(*arguments, folder=tmp_path).returncode == 0
    figures = tmp_path / "out" / "figures"
    names = {"hand_path", "energy_ledger", "posture"}
    assert {path.name for path in figures.iterdir()} == {"captions.txt", *(f"{name}.png" for name in names)}
    assert dynsim(*arguments, "--format", "svg", folder=tmp_path).returncode == 0
    assert {path.name for path in figures.iterdir()} == {"captions.txt", *(f"{name}.svg" for name in names)}
    result = dynsim("plot", "out/record.h5", "--format", "pdf", "--out", "pdf", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert {path.name for path in (tmp_path / "pdf").iterdir()} == {"captions.txt", *(f"{name}.pdf" for name in names)}
    assert dynsim("plot", "out/record.h5", "--format", "gif", folder=tmp_path).returncode == 2


def test_plot_writes_nothing_outside_of_its_folder_and_shows_names_as_they_are(tmp_path: Path):
    evil = "\x1b[31m[red]x[/]"
    for name, variant in (("a", "../../../outside"), ("b", str(tmp_path / "outside")), ("c", ".."), ("d", evil)):
        record = Record([0.0, 1.0], provenance={"engine": "dynamics", "scenario": {"name": evil, "variant": variant}})
        record.add("hand_position", [[0.0, 0.0, 1.0]] * 2, "m", labels=("x", "y", "z"))
        record.summary = {"variant": variant}
        record.save(tmp_path / "in" / name / "record.h5")
    records = [str(path) for path in sorted((tmp_path / "in").glob("*/record.h5"))]
    before = set(tmp_path.rglob("*"))
    result = dynsim("plot", *records, "--out", "deep/down/figures", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    written = {path for path in set(tmp_path.rglob("*")) - before if path.is_file()}
    assert written
    assert all(path.is_relative_to(tmp_path / "deep" / "down" / "figures") for path in written)
    assert "\x1b" not in result.stdout + result.stderr


@pytest.mark.parametrize("missing", ["posture", "q"])
def test_a_record_that_lacks_what_a_figure_needs_is_one_line(tmp_path: Path, missing: str):
    # [link] and [red] would be taken for markup.
    record = Record([0.0, 1.0], provenance={"engine": "kinematic", "scenario": {"name": "[red]x\x1b[0m"}})
    record.add(missing, [0.0, 0.0], "m")
    record.save(tmp_path / "[red]\x1b[0m" / "record.h5")
    result = dynsim("plot", "[red]\x1b[0m/record.h5", folder=tmp_path)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("error: ")
    assert "\x1b" not in result.stdout + result.stderr


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names are POSIX")
@pytest.mark.parametrize("format_", ["csv", "joint-trajectory", "urdf-log"])
def test_export_to_a_pipe_is_refused(tmp_path: Path, format_: str):
    record = Record([0.0, 1.0])
    for name, unit in (("q", "rad"), ("v", "rad/s")):
        record.add(name, [[0.0, 0.5]] * 2, unit, labels=("joint_1", "yes"))
    record.save(tmp_path / "record.h5")
    os.mkfifo(tmp_path / "pipe")
    result = dynsim("export", "record.h5", "--format", format_, "--out", "pipe", folder=tmp_path)
    assert result.returncode == 2
    check_message(result.stderr, re.compile("^error: "), "pipe")
    assert {path.name for path in tmp_path.iterdir()} == {"record.h5", "pipe"}


def test_a_run_that_stops_ends_with_code_3_and_keeps_what_there_is(tmp_path: Path):
    # Held for so long, the commands of the controller sway the arm until its forces have no bound.
    held = "controller.sample_time_s=0.1"
    result = dynsim("run", "elbow_comparison", "--no-figures", "--set", held, folder=tmp_path)
    assert result.returncode == 3
    assert mentions(result.stderr, re.compile(r"\bt = 0\.182\d* s"), "controller.sample_time_s = 0.1 s")
    record = Record.load(tmp_path / "results" / "elbow_comparison" / "two_elbows" / "record.h5")
    assert not record.complete
    assert len(record["q"]) > 0
    assert "q" in record.provenance["stopped"]["state"]


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_variant_that_stops_does_not_keep_the_others_from_the_comparison(tmp_path: Path, jobs: str):
    text = (SHIPPED / "elbow_comparison.yaml").read_text().partition("\nvariants:")[0]
    # Held for so long, the commands of the controller sway the arm until its forces have no bound.
    variants = "variants: {one: {}, bad: {controller: {sample_time_s: 0.1}}, two: {contacts: {friction: 0.2}}}"
    (tmp_path / "three.yaml").write_text(f"{text}\n{variants}\n")
    arguments = ["three.yaml", "--no-figures", "--jobs", jobs, "--out", "out", "--set", "duration_s=2.5"]
    result = dynsim("compare", *arguments, folder=tmp_path)
    assert result.returncode == 3, result.stderr
    saved, error = result.stderr.splitlines()
    check_message(saved, "bad", "out/bad")
    check_message(error, re.compile(r"^error: bad: .*\bt = "))
    assert list(json.loads((tmp_path / "out" / "comparison.json").read_text())["variants"]) == ["one", "two"]
    with (tmp_path / "out" / "comparison.csv").open(newline="") as stream:
        ended = {row["variant"]: (row["status"], row["reason"]) for row in csv.DictReader(stream)}
    assert list(ended) == ["one", "bad", "two"]
    assert ended["one"] == ended["two"] == ("ok", "")
    assert ended["bad"][0] == "failed"
    assert ended["bad"][1] in error
    assert "failed, not in the table: bad" in result.stdout
    assert says(result.stdout, "energy row")
    assert not Record.load(tmp_path / "out" / "bad" / "record.h5").complete


def test_a_full_disk_is_one_line_and_leaves_no_half_file(tmp_path: Path):
    resource = pytest.importorskip("resource", reason="limits of file sizes are POSIX")
    # A limit on the size of files stands for the full disk: writing fails half-way through the record.
    result = dynsim(
        "run", "single_pendulum", "--no-figures", "--out", "full", folder=tmp_path,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
    )  # fmt: skip
    assert result.returncode == 2, result.stderr
    (error,) = result.stderr.splitlines()
    check_message(error, re.compile("^error: "), "full/record.h5", "File too large")
    assert list((tmp_path / "full").iterdir()) == []


def test_check_prints_positions_that_can_be_copied_into_a_surface(tmp_path: Path):
    """What is printed reads back to the same doubles, but for rounding of zero; the surface through it is accepted."""
    scenario = load_scenario("elbow_comparison", "two_elbows")
    start = check(scenario)
    model, robot = build_model(scenario), build.robot(scenario)
    assert start.hand.tolist() == model.point_position(*robot.hand, robot.initial).tolist()
    assert list(start.contacts) == ["elbow_4", "elbow_7"]
    shown = dynsim("check", "elbow_comparison", "snake_operator", folder=tmp_path).stdout.splitlines()
    assert mentions(shown[0], "elbow_comparison", "4")
    assert mentions(shown[1], "two_elbows", "[m]")
    assert mentions(shown[2], "hand", str(start.hand.tolist()))
    assert mentions(shown[3], "elbow_4", str([*start.contacts["elbow_4"].tolist()[:2], 0.0]))
    assert [line.split(",")[0] for line in shown if line.endswith("[m]:")][1:4] == [
        "  elbow_7", "  elbow_4", "  no_elbow",
    ]  # fmt: skip
    copied = shown[4][shown[4].index("[") :]
    assert mentions(shown[4], "elbow_7")
    tilted = [
        "check",
        "elbow_comparison",
        "--set",
        f"surfaces.tilted={{type: plane, normal: [0.2, -0.1, 1], point_m: {copied}}}",
    ]
    # The references leave the tilted plane, which is not the matter here.
    tilted += ["--set", "contacts.reference_tolerance_m=1"]
    again = dynsim(*tilted, "--set", "contacts.points.elbow_7.surface=tilted", folder=tmp_path)
    assert again.returncode == 0, again.stderr
    # The snake has no contact points; its head starts where its record does.
    snake = check(load_scenario("snake_operator"))
    assert shown[-2].endswith("[m]:")
    assert mentions(shown[-1], "hand", str(snake.hand.tolist()))
    assert not snake.contacts


def test_check_writes_a_page_of_start_postures_also_if_it_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
):
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    # The path is out of reach, which the page of the postures helps to see.
    far = "controller.hand.path.radius_m=0.6"
    code, out, errors = in_process(monkeypatch, capfd, "check", "elbow_comparison", "--view", "--set", far)
    assert code == 2
    assert len(errors) == 1
    assert mentions(out, "results/elbow_comparison/start.html")
    assert says(out, "no browser")
    page = (tmp_path / "results" / "elbow_comparison" / "start.html").read_text(encoding="utf-8")
    assert page.startswith("<!DOCTYPE html>")


def test_pose_prints_the_start_and_its_keys_without_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
):
    monkeypatch.chdir(tmp_path)
    lower = ("pose", "elbow_comparison", "--print", "--set", "plant.initial_deg.1=50")
    code, text, errors = in_process(monkeypatch, capfd, *lower)
    assert (code, errors) == (0, [])
    keys, lines = YAML(typ="safe").load(text), text.splitlines()
    model = build_model(load_scenario("elbow_comparison", overrides={"plant.initial_deg.1": 50}))
    hand = model.point_position(*model.robot.hand, model.robot.initial)
    assert lines[0] == f"# hand at {np.round(hand, 6).tolist()} m"
    assert lines[1] == "# elbow_4 at [0.298858, 0.298858, -0.036977] m, gap -36.9770 mm from floor"
    assert lines[3] == "# link_6: axis 100.1 mm below floor"
    assert keys["plant"] == {"initial_deg": [0, 50, 90, -90, 45, 45, -90, 45, -45, 45]}
    assert keys["controller"]["hand"]["path"]["center_m"] == pytest.approx((hand - [0.1, 0, 0]).tolist())
    code, text, errors = in_process(monkeypatch, capfd, "pose", "snake_operator", "--print")
    assert (code, errors) == (0, [])
    assert YAML(typ="safe").load(text)["plant"]["initial_base_pose"] == [0, 0, 0]
    assert list(tmp_path.iterdir()) == []


def test_check_says_where_it_starts_before_it_refuses(tmp_path: Path):
    """Hand and gaps, also of a path out of reach and of points off their surfaces; and what puts these there."""
    path = "controller.hand.path.center_m=[9, 9, 9]"
    reach = dynsim("check", "elbow_comparison", "--set", path, folder=tmp_path)
    assert reach.returncode == 2
    start = check(load_scenario("elbow_comparison", "two_elbows"))
    assert lines_with(reach.stdout, "hand", str(start.hand.tolist()))
    assert lines_with(reach.stdout, "elbow_4", "0 m")
    assert abs(start.gaps["elbow_4"]) < 1e-12
    assert mentions(" ".join(reach.stderr.split()), "controller.hand.path", "0.000 s")
    off = dynsim("check", "elbow_comparison", "--set", "plant.chain.0.length_m=0.02", folder=tmp_path)
    line = "initial: {on_surface: [elbow_4, elbow_7]}"
    assert line in off.stdout
    assert f"`{line}`" in off.stderr
    # What it offers works, also where points are disabled: all variants start in one posture.
    posed = ["--set", "plant.chain.0.length_m=0.02", "--set", "initial={on_surface: [elbow_4, elbow_7]}"]
    posed += ["--set", "contacts.law=bilateral", "--set", "controller.hand=null"]
    solved = dynsim("check", "elbow_comparison", *posed, folder=tmp_path)
    assert solved.returncode == 0, solved.stderr
    moved = [" ".join(line.split()) for line in lines_with(solved.stdout, "set by `initial`")]
    assert len(moved) % 4 == 0
    assert len(set(moved)) == len(moved) // 4 > 0


@pytest.mark.long
def test_a_list_in_a_pipe_is_lines_with_tabs_and_names_papers(tmp_path: Path):
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    listed = dynsim("list", folder=tmp_path, env=environment).stdout
    lines = listed.splitlines()
    assert lines[0] == "scenarios"
    row = next(line for line in lines if line.startswith("bouncing_link")).split("\t")
    assert row[:2] == ["bouncing_link", "half, dead, lively"]
    assert all(line == line.rstrip() and "  " not in line for line in lines)
    assert "[" not in re.sub(r"\[(m|rad)\]", "", listed), "a paper is named"
    assert mentions(listed, "Wang", "Minami")
    wide = dynsim("list", folder=tmp_path, env=environment | {"COLUMNS": "90"}).stdout
    assert max(map(len, wide.splitlines())) <= 90


def test_list_check_schema_and_version(tmp_path: Path):
    for arguments, expected in (
        (["list"], "wang_minami"),
        (["check", "elbow_comparison", "single_pendulum"], "single_pendulum: "),
        (["schema"], "duration_s"),
        (["--version"], f"{__version__}\n"),
        (["run", "--help"], "--variant"),
    ):
        result = dynsim(*arguments, folder=tmp_path)
        assert result.returncode == 0, result.stderr
        assert expected in result.stdout


def in_process(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture, *arguments: str
) -> tuple[int, str, list[str]]:
    """Exit code, output and lines of errors of the command line, run here: starting Python takes a second."""
    monkeypatch.setattr(sys, "argv", ["dynsim", *arguments])
    with pytest.raises(SystemExit) as finished:
        main()
    captured = capfd.readouterr()
    return finished.value.code, captured.out, [line for line in captured.err.splitlines() if line.strip()]


@pytest.mark.parametrize("command", [[], ["run"], ["compare"], ["plot"], ["list"], ["hw", "replay"]])
def test_help_shows_flags_without_a_type(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture, command: list[str]
):
    code, output, _ = in_process(monkeypatch, capfd, *command, "--help")
    assert code == 0
    assert "--help " in output
    for noise in ("bool", "int range", "...}"):
        assert noise not in output


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("dynsim ru", ["run"]),
        ("dynsim run elbow_comparison_v", ["elbow_comparison_vertical"]),
        ("dynsim check single_pendulum six", ["six_axis_arm"]),
        ("dynsim compare mine/a", ["mine/a.yaml"]),
        ("dynsim run elbow_comparison --variant elb", ["elbow_7", "elbow_4"]),
        ("dynsim run mine/a.yaml --variant ", ["one", "two"]),
        ("dynsim run gone.yaml --variant ", []),
        ("dynsim run mine/bad.yaml --variant ", []),
    ],
)
def test_the_shell_completes_scenarios_and_variants(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture, words: str, expected: list[str]
):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a.yaml").write_text("variants: {one: {}, two: {}}")
    (tmp_path / "mine" / "bad.yaml").write_text("variants: [")
    (tmp_path / "mine" / "a.txt").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("_DYNSIM_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(words.count(" ")))
    code, output, errors = in_process(monkeypatch, capfd)
    assert (code, output.split(), errors) == (0, expected, [])


def test_the_shell_can_be_taught_to_complete(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture):
    _, output, _ = in_process(monkeypatch, capfd, "--help")
    assert "--install-completion" in output


def test_completing_loads_nothing_heavy(tmp_path: Path):
    heavy = "numpy numba scipy pydantic h5py matplotlib pinocchio"
    code = f"import sys; from dynsim import cli; print(*(name for name in {heavy.split()} if name in sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert (result.returncode, result.stdout, result.stderr) == (0, "\n", "")


def test_names_that_no_file_can_have_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
):
    monkeypatch.chdir(tmp_path)
    long, undecodable = "x" * 300, os.fsdecode(b"n\xff")
    for arguments in (["run", long], ["check", long], ["plot", long], ["run", undecodable]):
        code, _, errors = in_process(monkeypatch, capfd, *arguments)
        assert code == 2
        assert len(errors) == 1
    code, _, (error,) = in_process(monkeypatch, capfd, "run", "single_pendulum", "--out", long)
    assert code == 2
    assert error.endswith("File name too long")


def test_a_working_directory_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    code, output, _ = in_process(monkeypatch, capfd, "check", "single_pendulum")
    assert (code, output.partition(" ")[0]) == (0, "single_pendulum:")
    code, _, errors = in_process(monkeypatch, capfd, "run", "single_pendulum")
    assert code == 2
    (error,) = errors
    check_message(error, re.compile("^error: "))


@pytest.mark.long
def test_a_terminal_that_knows_ascii_only(tmp_path: Path):
    for arguments in (["list"], ["run", "--help"], ["run", "−.yaml"]):
        result = dynsim(*arguments, folder=tmp_path, env={**os.environ, "PYTHONIOENCODING": "ascii"})
        assert result.returncode == (2 if "−.yaml" in arguments else 0), result.stderr
        assert "Traceback" not in result.stderr


def test_a_damaged_kernel_cache_is_a_warning_in_one_line(tmp_path: Path):
    build_model(load_scenario("single_pendulum")).joint_positions([0.0])
    files = sorted(cache_folder().glob("dynsim.dynamics.*.kernel"))
    cache = tmp_path / "dynsim" / cache_folder().name
    cache.mkdir(parents=True, mode=0o700)
    # One that takes little to compile.
    damaged = [file for file in files if file.name.startswith("dynsim.dynamics.tree.joints.point_position-")]
    assert damaged
    for file in files:
        (cache / file.name).write_bytes(file.read_bytes()[: -1 if file in damaged else None])
    done = dynsim("check", "single_pendulum", folder=tmp_path, env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)})
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("warning: ")
    assert mentions(line, damaged[0].name)


def test_the_command_line_starts_without_libraries_for_computation():
    """Help, versions and completion need no arrays; commands import these when they run."""
    heavy = ("numpy", "numba", "pydantic", "matplotlib", "dynsim.record")
    code = f"import sys, dynsim.cli.commands; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert result.stdout == "[]\n"
