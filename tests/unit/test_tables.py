"""Tables of summaries: at most one screen unless all rows are wanted; joint stops, and references beyond these."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions, says

import dynsim
from dynsim.cli.comparison import print_comparison, print_summary
from dynsim.cli.tables import print_starts, rows_of
from dynsim.record import Record
from dynsim.record.csv_rows import csv_table
from dynsim.studies.sweep import flat
from dynsim.system.terminal import Terminal

ARM = """\
duration_s: 1.0
metrics: {settle_s: 0.2}
plant:
  type: serial_arm
  chain:
    - {axis: y, mass_kg: 0.8, length_m: 0.5, limit_deg: [-30, 40], initial_deg: 20, motor: {type: wang_minami}}
controller:
  type: joint_pd
  joints: {joint_1: {times_s: [0, 0.8], angles_deg: [20, GOAL]}}
contacts: {law: unilateral}
"""


def reached(folder: Path, goal: float) -> Record:
    path = folder / f"to_{goal:g}.yaml"
    path.write_text(ARM.replace("GOAL", str(goal)))
    return dynsim.simulate(dynsim.load_scenario(path))


@pytest.fixture(scope="module")
def beyond(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return reached(tmp_path_factory.mktemp("stops"), 52.0)


def shown(summaries: dict[str, dict], width: int | None = None, every: bool = False) -> str:
    output = io.StringIO()
    terminal = Terminal(file=output, width=width, emoji=False)
    if len(summaries) == 1:
        print_summary(terminal, next(iter(summaries.values())), every)
    else:
        print_comparison(terminal, summaries, every)
    return output.getvalue()


def test_a_reference_beyond_a_stop_is_told(beyond: Record, tmp_path: Path) -> None:
    (warning,) = lines_with(beyond.summary["warnings"], "joint_1", phrase="reference")
    # The spline of the references swings over by thousandths of a degree.
    check_message(warning, "40°", "0.6981 rad", re.compile(r"\b12(\.00\d)?° "))
    (hit,) = [event for event in beyond.events if event.kind == "stop_hit"]
    match = re.search(r"\bt = ([\d.]+) s", warning)
    assert match is not None
    first = float(match[1])
    # The joint is close behind its reference.
    assert first == pytest.approx(hit.time, abs=0.1)
    within = reached(tmp_path, 39.0)
    assert not lines_with(within.summary["warnings"], phrase="reference")


def test_variants_without_contacts_stand_beside_those_with_some() -> None:
    """As the kinematic snake beside the dynamic one."""
    forces = {"normal_force_mean_N": 2.0, "normal_force_min_N": 1.0, "normal_force_max_N": 3.0, "pulling_fraction": 0.0}
    touching = {"scenario": "snake", "contacts": [{"name": "head", "closed_fraction": 1.0, **forces}]}
    shown_both = shown({"dynamic": touching, "kinematic": {"scenario": "snake"}})
    assert lines_with(shown_both, "head", re.compile(r"\b2\.00 +–"))


def test_zeros_print_as_zeros() -> None:
    summary = {
        "scenario": "arm", "variant": "", "energy_turnover_J": 100.0, "electrical_energy_J": 3e-11,
        "mechanical_work_J": -0.0, "friction_heat_J": 3e-10, "energy_residual_relative": 0.0,
        "constraint_drift_max_m": 0.0,
        "contacts": [{
            "name": "elbow", "closed_fraction": 1.0, "pulling_fraction": 0.0, "normal_force_mean_N": -0.0,
            "normal_force_min_N": -0.001, "normal_force_max_N": 0.004,
        }],
    }  # fmt: skip
    numbers = [line.split()[-1] for line in shown({"": summary}).splitlines() if line.strip()]
    assert numbers == ["arm", "0", "0", "3e-10", "0", "0", "0", "0.00", "0.00", "0"]


def test_rounding_errors_next_to_other_runs_and_ratings_are_zero() -> None:
    motor = {"joint": "joint_1", "current_rms_A": 1e-12, "nominal_current_A": 4.0}
    summaries = {
        "rest": {"scenario": "arm", "hand_error_rms_m": -3.469e-17, "cost_final": 1e-11, "motors": [motor]},
        "moves": {"scenario": "arm", "hand_error_rms_m": 0.0, "cost_final": 40.0},
    }
    text = shown(summaries)
    for row, cells in (("cost", ["0", "40"]), ("joint_1", ["0", "of", "4", "–"])):
        (line,) = lines_with(text, re.compile(rf"(?i){row}"))
        assert line.split()[-len(cells) :] == cells


def test_battery_and_worst_joint_have_rows() -> None:
    worst = {"joint": "psi2", "torque_rms_N_m": 3.172, "nominal_torque_N_m": 1.68, "stall_torque_N_m": 8.4}
    summary = {"scenario": "one", "variant": "", "battery_energy_Wh": 0.082754, "worst_joint": worst}
    text = shown({"one": summary})
    assert len(lines_with(text, "0.0828")) == len(lines_with(text, "psi2", "3.17", "1.68")) == 1
    unrated = {**summary, "worst_joint": {key: worst[key] for key in worst if key != "nominal_torque_N_m"}}
    some = {"one": summary, "other": unrated, "none": {**summary, "worst_joint": None}}
    for width in (60, 80, 200):
        assert {("3.17", "1.68"), ("3.17", "8.4")} <= set(re.findall(r"psi2 ([\d.]+) \D+([\d.]+)", shown(some, width)))


def test_coordinates_that_are_rounding_of_zero_are_zero() -> None:
    output = io.StringIO()
    console = Terminal(file=output, emoji=False)
    point = np.array([0.30000000000000004, -0.0, 5.781049840155092e-17])
    print_starts(console, {"": dynsim.engine.Start(hand=point, contacts={"elbow": point[::-1]})})
    rows = [line.partition("[") for line in output.getvalue().splitlines()[1:]]
    assert [(names.split()[-1], point) for names, _, point in rows] == [
        ("hand", "0.30000000000000004, 0.0, 0.0]"),
        ("elbow", "0.0, 0.0, 0.30000000000000004]"),
    ]


def test_joint_stops_have_rows(beyond: Record, tmp_path: Path) -> None:
    (stop,) = beyond.summary["joint_stops"]
    assert stop["force_max"] == pytest.approx(-beyond["stop_force"].min(), rel=1e-12)
    assert stop["force_max"] > 0.0
    lines = shown({"": beyond.summary}).splitlines()
    k = next(k for k, line in enumerate(lines) if mentions(line, "joint_1", "40°"))
    assert [line.split()[-1] for line in lines[k : k + 4]] == [
        str(stop["hits"]),
        f"{stop['force_max']:.3g}",
        f"{100 * stop['closed_fraction']:.1f}",
        f"{stop['impact_loss_J']:.3g}",
    ]
    assert mentions(lines[k + 1], "[N m]")
    both = shown({"within": reached(tmp_path, 39.0).summary, "beyond": beyond.summary}).splitlines()
    row = next(line for line in both if mentions(line, "joint_1", "40°"))
    assert row.split()[-2:] == ["–", str(stop["hits"])]


def test_tables_of_all_rows_are_whole_in_pipes(beyond: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a pipe all variants are in one table, no name is cut off and no warning broken; COLUMNS is handled."""
    monkeypatch.delenv("COLUMNS", raising=False)
    names = [f"a_variant_with_quite_a_long_name_{k}" for k in range(9)]
    text = shown(dict.fromkeys(names, beyond.summary), every=True)
    assert len(lines_with(text, phrase="energy row")) == 1
    header = next(line for line in text.splitlines() if names[0] in line)
    assert header.split() == names
    assert "…" not in text
    for warning in beyond.summary["warnings"]:
        assert f"warning: {', '.join(names)}: {warning}" in text.splitlines()
    monkeypatch.setenv("COLUMNS", "100")
    narrow = shown(dict.fromkeys(names, beyond.summary), every=True)
    assert len(lines_with(narrow, phrase="energy row")) > 1
    assert max(map(len, narrow.splitlines())) <= 100


def snake(k: int, wheels: int = 14) -> dict:
    """Return a summary like that of a dynamic snake, with numbers that depend on ``k``."""
    contacts = [
        {
            "name": f"wheel{i}{'LR'[i % 2]}", "normal_force_min_N": 1.0 + i, "normal_force_mean_N": 5.0 + i + k,
            "normal_force_max_N": 40.0 + i + k, "closed_fraction": 1.0, "pulling_fraction": 0.0,
            "sticking_fraction": 0.5, "lift_offs": i, "landings": k, "bounces": 0, "slip_starts": i,
            "impact_loss_J": 0.0,
        }
        for i in range(1, wheels + 1)
    ]  # fmt: skip
    motors = [{"joint": f"psi{i}", "torque_rms_N_m": 0.1 * i + k, "nominal_torque_N_m": 2.0} for i in range(1, 9)]
    slipping = [f"wheel{i}: slips for {k + i} % of the run" for i in range(1, 4)]
    return {
        "scenario": "snake", "variant": f"v{k}", "electrical_energy_J": 100.0 + k, "mechanical_work_J": 1.0 + k,
        "final_position_error_m": 0.01 * k, "mode_switches": 0, "cost_final": 2.0 * k, "method": "time_stepping",
        "contacts": contacts, "motors": motors, "warnings": [*slipping, "the head sags; lift it"] if k % 2 else [],
    }  # fmt: skip


@pytest.mark.parametrize("count", [1, 2, 6, 18, 60])
@pytest.mark.parametrize("width", [None, 80, 120, 200])
def test_tables_fit_on_a_screen(count: int, width: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    text = shown({f"v{k}": snake(k) for k in range(1, count + 1)}, width)
    assert sum(-(-max(len(line), 1) // (width or 120)) for line in text.splitlines()) <= 38
    assert count == 1 or {f"v{k}" for k in range(1, min(count, 12) + 1)} <= set(text.split())


def test_all_rows_are_printed_on_request() -> None:
    every = shown({f"v{k}": snake(k) for k in (1, 2)}, every=True)
    assert all(lines_with(every, f"wheel{i}{'LR'[i % 2]}", "mean") for i in range(1, 15))
    assert all(lines_with(every, f"psi{i}") for i in range(1, 9))


def test_contacts_of_a_kind_are_folded_to_their_extremes_means_and_sums() -> None:
    text = shown({"v1": snake(1), "v2": snake(2)})
    (mean,) = lines_with(text, "wheel × 14", "force, mean")
    assert mean.split()[-2:] == ["13.50", "14.50"]
    assert lines_with(text, "force, max")[0].split()[-2:] == ["55.00", "56.00"]
    assert "105, 14" in lines_with(text, "lift-offs, landings")[0]
    assert lines_with(text, "psi × 8")[0].split()[-6:] == ["55…90,", "mean", "72", "105…140,", "mean", "122"]


def test_folded_cells_of_a_run_do_not_depend_on_the_other_runs() -> None:
    """Contacts that close only in another variant count neither as zeros nor as open."""

    def run(*closed: int) -> dict:
        contacts = [{**contact, "closed_fraction": 0.0, "normal_force_mean_N": 0.0} for contact in snake(0)["contacts"]]
        for k in closed:
            contacts[k] = {**snake(0)["contacts"][k], "closed_fraction": 0.5}
        return {"scenario": "arm", "contacts": contacts}

    alone, together = rows_of([run(3)], True), rows_of([run(3), run(0, 1), run()], True)
    for key, cell in (("force, mean [N]", "9.00"), ("closed [% of time]", "50.0"), ("lift-offs, landings", "4, 0")):
        assert [row.cells for row in alone if row.key == key] == [[cell]]
        assert [row.cells[0] for row in together if row.key == key] == [cell]
    assert [(row.label, row.cells) for row in together if row.key == "touched"] == [
        ("wheel × 3: number touched", ["1", "2", "0"])
    ]
    assert "wheel × 3: closed, mean [% of time]" in [row.label for row in together]


def test_folded_stops_mix_no_forces_with_torques() -> None:
    stops = [
        {
            "joint": joint, "stop": side, "limit": 0.01, "unit": unit, "force_max": force, "force_unit": force_unit,
            "hits": 1, "closed_fraction": 0.5,
        }
        for joint, side, unit, force, force_unit in (
            ("joint_1", "lower", "m", 1.9, "N"), ("joint_1", "upper", "m", 1.2, "N"),
            ("joint_2", "lower", "rad", 6.5, "N m"), ("joint_3", "upper", "rad", 3.0, "N m"),
        )
    ]  # fmt: skip
    rows = {row.label: row.cells for row in rows_of([{"scenario": "arm", "joint_stops": stops}], folded=True)}
    assert rows["joint, prismatic stops × 2: force, max [N]"] == ["1.9"]
    assert rows["joint, revolute stops × 2: force, max [N m]"] == ["6.5"]
    assert rows["joint, revolute stops × 2: hits, sum"] == ["2"]


def test_stops_whose_limits_round_to_the_same_number_are_two(beyond: Record) -> None:
    (stop,) = beyond.summary["joint_stops"]
    assert stop["stop"] == "upper"
    both = {
        "scenario": "arm",
        "joint_stops": [{**stop, "stop": side, "hits": k} for k, side in ((1, "lower"), (2, "upper"))],
    }
    assert [row.cells for row in rows_of([both]) if row.key == "hits"] == [["1"], ["2"]]
    numbers = flat(both)
    assert [numbers[f"joint_1.{side}_stop.hits"] for side in ("lower", "upper")] == [1, 2]


def test_columns_of_causes_are_named_after_the_cause() -> None:
    causes = [
        [{"cause": "motion", "share": 0.9, "joints": ["joint_2", "joint_3"]}],
        [{"cause": "sag", "share": 0.6, "joints": []}, {"cause": "motion", "share": 0.4, "joints": ["joint_1"]}],
    ]
    first, second = (flat({"hand_error_causes": entries}) for entries in causes)
    assert first == {"hand_error_causes.motion.share": 0.9, "hand_error_causes.motion.joints": "joint_2; joint_3"}
    assert (second["hand_error_causes.motion.share"], second["hand_error_causes.sag.share"]) == (0.4, 0.6)


def test_cells_of_lists_are_json() -> None:
    rows = csv.reader(io.StringIO(csv_table(["key"], [{"key": ["a", True]}, {"key": ("b",)}, {"key": {"c": None}}])))
    assert [json.loads(cell) for (cell,) in list(rows)[1:]] == [["a", True], ["b"], {"c": None}]


def test_failed_variants_are_listed_and_the_only_other_one_is_named() -> None:
    output = io.StringIO()
    print_comparison(Terminal(file=output, width=100, emoji=False), {"v1": snake(1)}, failed=["tips", "falls"])
    assert lines_with(output.getvalue(), "failed, not in the table: tips, falls")
    assert [line for line in output.getvalue().splitlines() if line.split() == ["v1"]]
    output = io.StringIO()
    runs = {f"v{k}": snake(k, wheels=1) for k in range(1, 19, 2)}
    print_comparison(Terminal(file=output, width=100, emoji=False), runs, failed=["tips"])
    text = " ".join(output.getvalue().split())
    assert "equal in all completed variants:" in text
    assert "9 of 9 completed variants: the head sags" in text


def test_rows_that_are_equal_in_all_variants_are_in_one_line() -> None:
    text = shown({f"v{k}": snake(k, wheels=1) for k in (1, 2)})
    (equal,) = re.findall(r"equal in all variants:.*", " ".join(text.split()))
    for part in ("mode switches 0", "integration method time_stepping", "wheel1R: loss at impacts 0 J"):
        assert part in equal
    assert not lines_with(text, re.compile(r"^  mode switches"))
    same = shown(dict.fromkeys(("a", "b"), snake(1, wheels=1)))
    assert "electrical energy 101 J" in same


def test_warnings_of_a_kind_are_grouped_with_their_number_and_variants() -> None:
    text = shown({f"v{k}": snake(k) for k in range(1, 19)})
    assert lines_with(text, "9 of 18 variants: wheel1: slips for 2 % of the run (the first of 27)")
    assert lines_with(text, "9 of 18 variants: the head sags; lift it (the first of 9)")


def test_long_warnings_are_whole_in_pipes_and_else_refer_to_all_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    end = "so that this sentence is much wider than any screen, and ends with a remedy"
    runs = {f"v{k}": {**snake(k), "warnings": [f"wheel{i} slips for {k} s, {end}" for i in (1, 2)]} for k in range(30)}
    for summaries in (runs, {"v1": runs["v1"]}):
        piped, narrow = shown(summaries), shown(summaries, width=100)
        assert lines_with(piped, end)
        assert not lines_with(narrow, end)
        assert lines_with(piped, "whole warnings: --rows all")
        assert lines_with(narrow, "whole warnings: --rows all")
        assert not lines_with(shown(summaries, every=True), "--rows")


def test_impact_losses_that_are_rounding_are_zero(beyond: Record) -> None:
    """Beside the energy turned over; a loss that is one stays, and no two rows have the same name."""
    turnover = beyond.summary["energy_turnover_J"]
    for share, read in ((1e-15, "0"), (-1e-15, "0"), (0.01, f"{0.01 * turnover:.4g}")):
        lines = shown({"": {**beyond.summary, "impact_loss_J": share * turnover}}).splitlines()
        (row,) = (line for line in lines if says(line, "impact row"))
        assert row.split()[-1] == read
