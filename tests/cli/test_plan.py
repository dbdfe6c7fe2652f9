"""``dynsim plan``: its files, its answers in words, and plans that run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.planner_scenes import scene
from typer.testing import CliRunner

from dynsim.cli.app import app
from dynsim.errors import ScenarioError
from dynsim.scenario import load_scenario, to_yaml, variant_names

import dynsim.cli.commands  # noqa: F401  # isort: skip


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """The smallest of the scenes, as a file."""
    path = tmp_path / "small.yaml"
    path.write_text(to_yaml(scene(11)), encoding="utf-8")
    return path


def test_a_plan_leaves_its_files_and_a_scenario_that_runs(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan"
    command = ["plan", str(small), "--count", "0:1", "--starts", "1", "--no-verify", "--out", str(out)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "link_6 on floor" in result.output
    plan = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    none, one = plan["sizes"]
    assert (none["count"], none["braces"], one["count"]) == (0, [], 1)
    assert set(one["braces"][0]) >= {"body", "point_m", "surface"}
    assert set(one) >= {"count", "braces", "heat_W", "times_s", "q_rad", "forces_N", "survives", "reason"}
    assert len(one["times_s"]) == len(one["q_rad"]) == len(one["forces_N"]) >= 101
    assert one["heat_W"] < 0.1 * none["heat_W"]
    assert variant_names(out / "plan.yaml") == ["braces_1", "braces_0"]
    record = load_scenario(out / "plan.yaml").duration_s
    assert record == 10.0
    names = {path.name for path in (out / "figures").iterdir()}
    assert names == {"plan_posture.png", "plan_heat.png", "plan_single_braces.png"}
    assert (out / "view.html").stat().st_size > 1000
    assert (out / "plan_table.csv").read_text(encoding="utf-8").startswith("count,braces,heat_W")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--count", "two"], "must look like 0:3"),
        (["--weight", "heat=1"], "must look like peak=0.5"),
        (["--gains", "0"], "must be positive numbers"),
        (["--along", "1.5"], "shares of the way along links"),
    ],
)
def test_options_that_make_no_sense_are_one_error(small: Path, options: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["plan", str(small), *options])
    assert isinstance(result.exception, ScenarioError)
    assert message in str(result.exception)
