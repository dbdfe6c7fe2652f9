"""``dynsim sweep`` on the command line: its files, messages and exit codes."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from support.messages import lines_with, mentions

from dynsim.cli import main
from dynsim.cli.sweep import _print_table
from dynsim.scenario import Scenario, ScenarioFile, find_scenario, read_scenario
from dynsim.studies.sweep import OK, SweepRow
from dynsim.studies.sweep_plan import Axis, Plan

SHORT = ["--set", "duration_s=0.2", "--set", "metrics.settle_s=0.05"]
LENGTH = "plant.chain.0.length_m"


def sweep(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dynsim", "sweep", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)


@pytest.mark.long
def test_a_sweep_is_named_by_its_scenario(tmp_path: Path):
    content, file = find_scenario("single_pendulum").read_text("utf-8"), tmp_path / "scenario.yaml"
    file.write_text(content.replace("name: single_pendulum", "name: swinging"), encoding="utf-8")
    result = sweep(str(file), "--grid", f"{LENGTH}=0.5,1", *SHORT, "--no-figures", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    folder = tmp_path / "results" / "swinging" / "sweep"
    assert (folder / "sweep.csv").is_file()
    assert not (tmp_path / "results" / "scenario").exists()


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["--grid", "plant.chain.0.lenght_m=0.5,1"], "lenght_m"),
        (["--grid", f"{LENGTH}=0.5,1", "--out", "there"], "there"),
    ],
)
def test_a_sweep_that_is_refused_says_one_line(tmp_path: Path, arguments: list[str], name: str):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "runs.jsonl").touch()
    result = sweep("single_pendulum", "--jobs", "2", *arguments, folder=tmp_path)
    assert result.returncode == 2
    assert result.stdout.strip() == ""
    assert result.stderr.startswith("error: ")
    assert mentions(result.stderr.replace("\n", " "), name)
    assert "Exception in thread" not in result.stderr
    assert "Traceback" not in result.stderr


def test_first_scenario_is_loaded_once_and_again_by_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    loads: list[object] = []
    load = ScenarioFile.load

    def counted(file: ScenarioFile, variant: str | None = None, overrides: object = None) -> Scenario:
        loads.append(overrides)
        return load(file, variant, overrides)

    monkeypatch.setattr(ScenarioFile, "load", counted)
    monkeypatch.chdir(tmp_path)
    grid = ["--grid", f"{LENGTH}=0.5,1", "--jobs", "1", "--no-figures", *SHORT]
    monkeypatch.setattr(sys, "argv", ["dynsim", "sweep", "single_pendulum", *grid])
    with pytest.raises(SystemExit) as finished:
        main()
    assert finished.value.code == 0
    assert [overrides[LENGTH] for overrides in loads] == [0.5, 0.5, 1.0]


@pytest.mark.parametrize(("limits", "well", "code"), [("1,1e-9", 1, 0), ("1e-9,2e-9", 0, 3)])
def test_a_sweep_without_a_good_run_has_failed(tmp_path: Path, limits: str, well: int, code: int):
    grid = f"integrator.wall_limit_s={limits}"
    result = sweep("single_pendulum", "--grid", grid, *SHORT, "--jobs", "1", folder=tmp_path)
    assert mentions(result.stdout, str(well), "2", "results/single_pendulum/sweep")
    assert lines_with(result.stderr, "1", "integrator.wall_limit_s")
    assert ("error: " in result.stderr) == (well == 0)
    assert result.returncode == code


# Names of the standard library and of what dynsim needs.
SHADOWS = ("signal", "json", "pickle", "numpy", "dynsim")


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "name"),
    [
        (["sweep", "single_pendulum", "--grid", f"{LENGTH}=0.5,1", *SHORT], "2"),
        (["compare", "elbow_comparison", "--set", "duration_s=0.05"], "out"),
    ],
    ids=["sweep", "compare"],
)
def test_workers_run_nothing_of_the_working_directory(tmp_path: Path, command: list[str], name: str):
    for module in SHADOWS:
        (tmp_path / f"{module}.py").write_text("raise RuntimeError('not this one')\n")
    dynsim = Path(sys.executable).with_name("dynsim")
    arguments = [*command, "--no-figures", "--jobs", "2", "--out", "out"]
    ended = subprocess.run([dynsim, *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    assert mentions(ended.stdout, name)
    assert "not this one" not in ended.stderr
    assert not (tmp_path / "__pycache__").exists()


@pytest.mark.long
def test_a_number_that_no_run_has_is_refused_and_others_are_drawn_without_runs(tmp_path: Path):
    """What was run is kept: the number is corrected with --resume, which runs nothing again."""
    varied = ["--grid", "contacts.friction=0.1,0.2", "--set", "duration_s=0.1", "--jobs", "1", "--out", "out"]
    wrong = sweep("elbow_comparison", *varied, "--plot", "elbow_4.normal_force_max", folder=tmp_path)
    assert wrong.returncode == 2
    assert mentions(wrong.stderr, "'elbow_4.normal_force_max_N'")
    # As soon as a run has ended, not only after all.
    early = wrong.stderr.index("warning: --plot elbow_4.normal_force_max: ")
    assert early < wrong.stderr.index("error: --plot elbow_4.normal_force_max: ")
    journal = (tmp_path / "out" / "runs.jsonl").read_bytes()
    asked = ["--resume", "--plot", "elbow_4.normal_force_max_N", "--plot", "joint_2.current_rms_A"]
    right = sweep("elbow_comparison", *varied, *asked, folder=tmp_path)
    assert right.returncode == 0, right.stderr
    assert (tmp_path / "out" / "runs.jsonl").read_bytes() == journal
    assert {path.stem for path in (tmp_path / "out").glob("*.png")} == {"sweep_lines"}
    header = (tmp_path / "out" / "sweep.csv").read_text().splitlines()[0].split(",")
    assert "joint_2.current_rms_A" in header


@pytest.mark.parametrize("count", [2, 60])
def test_table_names_quantities_with_units_and_fits_on_a_screen(count: int, capsys: pytest.CaptureFixture[str]):
    grid = Axis.parse(f"{LENGTH}=0.01:0.05:{count}")
    plan = Plan(read_scenario("single_pendulum"), (None,), {}, (grid, Axis("integrator.method", ("dopri5",))))
    rows = [
        SweepRow(point.run, None, point.values, OK, "", {"electrical_energy_J": 2.5, "hand_error_rms_m": 0.004}, "")
        for point in plan.points()
    ]
    rows[1] = replace(rows[1], status="failed", numbers={})
    _print_table("swinging", rows, plan, ())
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40
    rule = next(k for k, line in enumerate(lines) if "──" in line)
    headings = " ".join(" ".join(lines[:rule]).split())
    for word in ("run", "length", "link", "[mm]", "integration", "method", "electrical", "energy", "hand", "rms"):
        assert word in headings, headings
    assert lines[rule + 1].split() == ["0", "10", "dopri5", "2.5", "4"]
    assert lines[rule + 2].split()[-2:] == ["–", "–"]
    assert any(line.split()[:2] == ["…", "and"] for line in lines) == (count == 60)
