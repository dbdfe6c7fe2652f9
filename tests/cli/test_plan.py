"""``dynsim plan``: its files, its answers in words, and plans that run."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from studies.planner_scenes import scene
from support.messages import check_message, lines_with, mentions, says
from typer.testing import CliRunner

from dynsim.cli.app import app
from dynsim.cli.plan import _notes
from dynsim.errors import ModelError, ScenarioError, UnreachableReference
from dynsim.planner.answer import Size
from dynsim.planner.verify import Corner, Verdict
from dynsim.scenario import load_scenario, to_yaml, variant_names

import dynsim.cli.commands  # noqa: F401  # isort: skip


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """The smallest of the scenes, as a file."""
    path = tmp_path / "small.yaml"
    path.write_text(to_yaml(scene(11)), encoding="utf-8")
    return path


@pytest.mark.long
def test_a_plan_leaves_its_files_and_a_scenario_that_runs(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan"
    command = ["plan", str(small), "--count", "0:1", "--starts", "1", "--budget", "0", "--no-verify", "--out", str(out)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert lines_with(result.output, "link_6", "floor")
    plan = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    none, single = plan["sizes"]
    assert (none["count"], none["braces"], single["count"]) == (0, [], 1)
    assert set(single["braces"][0]) >= {"body", "point_m", "surface"}
    assert set(single) >= {"count", "braces", "heat_W", "times_s", "q_rad", "forces_N", "survives", "reason"}
    assert len(single["times_s"]) == len(single["q_rad"]) == len(single["forces_N"]) >= 101
    assert single["heat_W"] < 0.1 * none["heat_W"]
    assert variant_names(out / "plan.yaml") == ["braces_1", "braces_0"]
    record = load_scenario(out / "plan.yaml").duration_s
    assert record == 10.0
    names = {path.name for path in (out / "figures").iterdir()}
    assert names == {"plan_posture.png", "plan_heat.png", "plan_single_braces.png", "captions.txt"}
    assert (out / "view.html").stat().st_size > 1000
    assert (out / "plan_table.csv").read_text(encoding="utf-8").startswith("count,braces,heat_W")


@pytest.mark.long
def test_plans_for_several_values_leave_a_table_a_figure_and_the_best_plan(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan"
    require = ["--require", "hand_sag_m=0.5", "--require", "hand_force_N=[0,0,-1]"]
    vary = ["--vary", "surfaces.floor.point_m.2=-0.02:0:2", "--vary", "contacts.friction=0.1,0.2"]
    command = ["plan", str(small), "--count", "0:1", "--candidates", "link_6", "--budget", "0", "--no-verify"]
    result = CliRunner().invoke(app, [*command, *require, *vary, "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert mentions(" ".join(result.output.split()), "surfaces.floor.point_m.2", "hand sag")
    # Both tables have the unit: that of the values, and that of the best plan.
    assert result.output.count("[mm]") == 2
    table = json.loads((out / "vary_table.json").read_text(encoding="utf-8"))
    values = [(row["surfaces.floor.point_m.2"], row["contacts.friction"]) for row in table]
    assert values == [(-0.02, 0.1), (-0.02, 0.2), (0.0, 0.1), (0.0, 0.2)]
    margins = [1.0 - row["hand_sag_m"] / 0.5 for row in table]
    assert [row["hand_sag_m_margin"] for row in table] == pytest.approx(margins, abs=1e-12)
    best = json.loads((out / "vary.json").read_text(encoding="utf-8"))["best"]
    least = min(table, key=lambda row: row["heat_W"])
    assert best == {key: least[key] for key in best}
    plan = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    assert plan["sizes"][plan["best"]]["heat_W"] == least["heat_W"]
    (requirement,) = plan["sizes"][1]["requirements"]
    assert (requirement["key"], requirement["limit"], requirement["reason"]) == ("hand_sag_m", 0.5, "")
    assert (out / "figures" / "plan_vary.png").exists()
    assert (out / "vary_table.csv").read_text(encoding="utf-8").startswith("surfaces.floor.point_m.2,contacts.friction")
    result = CliRunner().invoke(app, [*command, "--no-figures", "--out", str(out)])
    assert not (out / "vary.json").exists()


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (["--vary", "contacts.friction=low"], ("--vary contacts.friction", "0:1:5")),
        (["--vary", "contacts.friction=0:1:1"], ("--vary contacts.friction=0:1:1", "2")),
        (["--require", "hand_sag=1"], ("requirements.hand_sag", "hand_sag_m")),
        (["--count", "two"], ("--count two", "0:3")),
        (["--phases", "two"], ("--phases two", "1:2")),
        (["--phases", "0:2"], ("phases = 0:2", "1 to 4")),
        (["--count", "99"], ("99", "5")),
        (["--weight", "heat=1"], ("--weight heat=1", "peak=0.5")),
        (["--gains", "0"], ("--gains 0", "500,100,20")),
        (["--along", "1.5"], ("along = [1.5]", "0", "1")),
        (["--candidates", "link_4:link_3"], ("'link_4:link_3'", "link_3:link_4")),
        (["--candidates", ","], ("--candidates ,",)),
        (["--radius", "inf"], ("radius_m = inf",)),
        (["--min-force", "inf"], ("min_N = inf",)),
        (["--surface-error", "inf"], ("shift_m = inf",)),
        (["--seed", "-1"], ("seed = -1",)),
    ],
)
def test_options_that_make_no_sense_are_one_error(small: Path, options: list[str], names: tuple[str, ...]) -> None:
    result = CliRunner().invoke(app, ["plan", str(small), *options])
    assert isinstance(result.exception, (ScenarioError, ModelError))
    check_message(result.exception, *names)


def out_of_reach(data: dict[str, Any]) -> None:
    points = data["controller"]["hand"]["path"]["points_m"]
    data["controller"]["hand"]["path"]["points_m"] = [[9.0 + x, y, z] for x, y, z in points]


def weak(data: dict[str, Any]) -> None:
    for link in data["plant"]["chain"]:
        link["motor"]["voltage_limit_V"] = 0.05


def turned_away(data: dict[str, Any]) -> None:
    data["controller"]["hand"]["orientation"] = {"rpy_deg": [180.0, 0.0, 0.0]}


def walled_in(data: dict[str, Any]) -> None:
    data["surfaces"]["box"] = {"type": "box", "center_m": [0.0, 0.0, 0.2], "edges_m": [1.0, 1.0, 1.0]}


@pytest.mark.parametrize(
    ("change", "name", "phrase"),
    [
        pytest.param(
            walled_in,
            "box",
            "no posture",
            marks=pytest.mark.long,
        ),
        (out_of_reach, "", "no posture"),
        pytest.param(weak, "", "no forces", marks=pytest.mark.long),
        (turned_away, "", "no posture"),
    ],
)
def test_a_scene_without_an_answer_ends_with_its_reason_and_code_2(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], name: str, phrase: str
) -> None:
    data = scene(11)
    change(data)
    path, out = tmp_path / "scene.yaml", tmp_path / "plan"
    path.write_text(to_yaml(data), encoding="utf-8")
    (out / "figures").mkdir(parents=True)
    earlier = [out / "plan.yaml", out / "view.html", out / "figures" / "plan_heat.png"]  # of a plan before
    own = out / "figures" / "mine.png"
    for file in (*earlier, own):
        file.write_text("")
    result = CliRunner().invoke(
        app, ["plan", str(path), "--count", "0:1", "--starts", "1", "--budget", "0", "--out", str(out)]
    )
    assert isinstance(result.exception, UnreachableReference)
    assert result.exception.exit_code == 2
    check_message(result.exception, name, phrase=phrase)
    sizes = json.loads((out / "plan.json").read_text(encoding="utf-8"))["sizes"]
    assert [size["survives"] for size in sizes] == [None, None]
    assert all(mentions(size["reason"], name) and says(size["reason"], phrase) for size in sizes)
    assert not any(file.exists() for file in earlier)
    assert own.exists()


@pytest.mark.parametrize(
    ("option", "key"), [("--min-force", "min_N"), ("--clearance", "clearance_m"), ("--radius", "radius_m")]
)
def test_an_option_beyond_its_bounds_is_an_error(option: str, key: str) -> None:
    result = CliRunner().invoke(app, ["plan", "pressing", option, "1e300"])
    assert isinstance(result.exception, ScenarioError)
    check_message(result.exception, key, "1e+300")


def floor_below_reach(data: dict[str, Any]) -> None:
    data["surfaces"]["floor"]["point_m"] = [0.0, 0.0, -5.0]


def floor_that_grips(data: dict[str, Any]) -> None:
    data["contacts"]["friction"] = 6.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "best", "survives", "names"),
    [
        (floor_below_reach, 0, None, ("5",)),
        (floor_that_grips, 1, True, ("on floor",)),
    ],
)
def test_outcome_of_the_run_decides_about_braces(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], best: int, survives: bool | None, names: tuple[str, ...]
) -> None:
    """No surface in reach: the arm hangs. With friction of 6, a brace sticks and still needs less than hanging."""
    data = scene(11)
    change(data)
    path, out = tmp_path / "scene.yaml", tmp_path / "plan"
    path.write_text(to_yaml(data), encoding="utf-8")
    options = ["--count", "0:1", "--starts", "1", "--budget", "0", "--no-figures", "--out", str(out)]
    result = CliRunner().invoke(app, ["plan", str(path), *options])
    assert result.exit_code == 0, result.output
    assert mentions(" ".join(result.output.split()), *names)
    plan = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    assert (plan["best"], plan["sizes"][1]["survives"]) == (best, survives)


def refused(corners: Sequence[Corner], tolerance: tuple[float | None, float | None] | None) -> Size:
    """A size with a plan that some corner refuses."""
    return Size(1, SimpleNamespace(heat=1.0), Verdict(50.0, tuple(corners)), tolerance=tolerance)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("size", "name", "other"),
    [
        (
            refused([Corner(1.0, 0.0, reason="too hot")], None),
            "50 V/rad",
            "%",
        ),
        (
            refused([Corner(1.0, 0.0), Corner(0.8, 0.0, reason="too hot")], (0.005, 0.0)),
            "5 mm",
            "%",
        ),
        (
            refused([Corner(1.0, 0.0), Corner(0.8, 0.0, reason="too hot")], (None, 0.1)),
            "10 %",
            "mm",
        ),
    ],
)
def test_only_errors_that_were_tried_are_spoken_of(size: Size, name: str, other: str) -> None:
    (note,) = _notes(size)
    check_message(note, name)
    assert other not in note
