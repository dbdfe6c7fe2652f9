"""The benchmark in short: errors of all programs, dashes where a peer is missing. No times are asserted."""

from __future__ import annotations

import io
import json
import math
import sys

import pytest
from rich.console import Console
from studies.bench import job, precision, programs, right_hand_side, run, snake
from studies.bench.table import format_table
from support.messages import lines_with, mentions

from dynsim.scenario import variant_names

pytestmark = pytest.mark.long


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "SIZES", (10,))
    monkeypatch.setattr(job, "CASES", {"free arm": job.CASES["free arm"]})
    # All six are compared with the paper by tests/published and tests/oracle.
    monkeypatch.setattr(snake, "TABLE_III", {"x": snake.TABLE_III["x"]})


def text(result: dict) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    for table in format_table(result):
        assert table.__rich_measure__(console, console.options.update(max_width=200)).maximum <= 80
        console.print(table)
    return console.export_text()


def test_quick_run(small: None) -> None:
    pytest.importorskip("mujoco", minversion="4.0")
    messages: list[str] = []
    result = json.loads(json.dumps(run.run_bench(quick=True, tell=messages.append)))
    assert lines_with(messages, "10 s", "free arm")
    assert {row["program"] for row in result["right_hand_side"]} == set(programs.RIGHT_HAND_SIDES)
    assert result["machine"]["cpu"]
    assert result["versions"]["mujoco"]
    errors = {row["program"]: row["hand_error_max_m"] for row in result["job"]}
    assert errors[programs.DYNSIM_RADAU5] < 1e-6
    # First order at 1 ms, but the same arm: a millimetre, not a centimetre.
    assert 1e-5 < errors[programs.MUJOCO_EULER] < 3e-3
    exact = [row for row in result["precision"] if row["method"] == "radau5"]
    assert [row["rtol"] for row in exact] == list(precision.RTOLS)
    assert all(row["error"] < row["rtol"] and row["ledger"] < row["rtol"] and row["finished"] for row in exact)
    assert [row["error"] for row in exact] == sorted((row["error"] for row in exact), reverse=True)
    times = [row["median_us"] for row in result["right_hand_side"]]
    times += [row["cpu_median_s"] for row in result["job"]] + [row["cpu_minimum_s"] for row in result["variants"]]
    times += [row["us_per_step"] for row in result["snake"]]
    assert all(math.isfinite(time) and time > 0.0 for time in times)
    assert "–" not in text(result)
    snakes = {row["program"]: row for row in result["snake"]}
    assert tuple(snakes) == snake.SNAKES
    assert snakes[snake.DYNSIM]["z_rms_m"] < 8e-3
    alone, whole = (snakes[program]["displacements"] for program in (snake.COMMANDED, snake.DYNSIM))
    assert alone[0] == pytest.approx(whole[0], abs=1e-7)  # the same motion without the controller
    assert [row["failed"] for row in result["sweeps"]] == [0] * len(result["sweeps"])
    assert {row["runs"] for row in result["sweeps"]} == {25, 50, 100}
    assert [row["variant"] for row in result["variants"]] == variant_names(programs.SCENARIO)


def test_without_mujoco(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setattr(precision, "RTOLS", precision.RTOLS[:1])
    result = run.run_bench(quick=True)
    assert mentions(result["unavailable"]["mujoco"], "mujoco", "pip install")
    rows = [line for line in text(result).splitlines() if "MuJoCo " in line and "µs" not in line]
    # Two each: times, the job of the one case; three: the snake.
    assert len(rows) == 7
    assert all("–" in row for row in rows)
    assert json.dumps(result)


def test_without_pinocchio_its_rows_are_left_out_and_the_reason_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    assert mentions(run._why_no_pinocchio(), "pinocchio", "pip install")
    rows = right_hand_side.measure((10,), 2, 1e-4, with_mujoco=False, with_pinocchio=False)
    assert {row["program"] for row in rows} == {programs.DYNSIM_FREE, programs.DYNSIM_CONTACTS}
