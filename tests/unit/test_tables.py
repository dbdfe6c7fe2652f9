"""Tables of summaries: complete in files and pipes, with joint stops, and warnings of references beyond these."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions, says

import dynsim
from dynsim.cli.tables import print_comparison, print_starts, print_summary
from dynsim.record import Record
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


def shown(summaries: dict[str, dict], width: int | None = None, monkeypatch: pytest.MonkeyPatch | None = None) -> str:
    output = io.StringIO()
    terminal = Terminal(file=output, width=width, emoji=False)
    if len(summaries) == 1:
        print_summary(terminal, next(iter(summaries.values())))
    else:
        print_comparison(terminal, summaries)
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


def test_tables_that_nobody_looks_at_are_whole(beyond: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a pipe all variants are in one table, no name is cut off and no warning broken; COLUMNS is handled."""
    monkeypatch.delenv("COLUMNS", raising=False)
    names = [f"a_variant_with_quite_a_long_name_{k}" for k in range(9)]
    text = shown(dict.fromkeys(names, beyond.summary))
    assert len(lines_with(text, phrase="energy row")) == 1
    header = next(line for line in text.splitlines() if names[0] in line)
    assert header.split() == names
    assert "…" not in text
    for warning in beyond.summary["warnings"]:
        assert f"warning: {names[0]}: {warning}" in text.splitlines()
    monkeypatch.setenv("COLUMNS", "100")
    narrow = shown(dict.fromkeys(names, beyond.summary))
    assert len(lines_with(narrow, phrase="energy row")) > 1
    assert max(map(len, narrow.splitlines())) <= 100


def test_impact_losses_that_are_rounding_are_zero(beyond: Record) -> None:
    """Beside the energy turned over; a loss that is one stays, and no two rows have the same name."""
    turnover = beyond.summary["energy_turnover_J"]
    for share, read in ((1e-15, "0"), (-1e-15, "0"), (0.01, f"{0.01 * turnover:.4g}")):
        lines = shown({"": {**beyond.summary, "impact_loss_J": share * turnover}}).splitlines()
        (row,) = (line for line in lines if says(line, "impact row"))
        assert row.split()[-1] == read
