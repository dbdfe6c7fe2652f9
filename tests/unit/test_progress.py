"""Progress display of long work; quiet mode prints nothing."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from dynsim.cli import output
from dynsim.cli.commands import app
from dynsim.compile.references import inverse_kinematics
from dynsim.engine import REFERENCES, simulate
from dynsim.scenario import load_scenario

SHORT = {"duration_s": 0.2}


@pytest.fixture
def slow_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every knot of a path takes long enough for a report."""
    monkeypatch.setattr(inverse_kinematics, "QUIET_S", 0.0)
    monkeypatch.setattr(inverse_kinematics, "REPORT_S", 0.0)
    monkeypatch.setattr(inverse_kinematics, "PIECE", 1)


def stages() -> list[tuple[str, float]]:
    seen = []
    simulate(
        load_scenario("elbow_comparison", overrides=SHORT),
        lambda time, stage="simulation": seen.append((stage, time)),
    )
    return seen


@pytest.mark.usefixtures("slow_machine")
def test_long_references_report_their_time_before_the_simulation_does():
    seen = stages()
    # A knot every 20 ms, and then the integration.
    references = [time for stage, time in seen if stage == "references"]
    assert references == pytest.approx([0.02 * k for k in range(11)])
    assert [stage for stage, _ in seen[:12]] == ["references"] * 11 + ["simulation"]
    assert seen[-1] == ("simulation", 0.2)


def test_short_references_are_silent(monkeypatch):
    monkeypatch.setattr(inverse_kinematics, "QUIET_S", float("inf"))
    assert {stage for stage, _ in stages()} == {"simulation"}


@pytest.mark.usefixtures("slow_machine")
@pytest.mark.parametrize("quiet", [False, True])
def test_the_terminal_shows_it_unless_quiet(monkeypatch, tmp_path: Path, quiet):
    shown = io.StringIO()
    monkeypatch.setattr(output, "console", Console(file=shown, force_terminal=True, width=120))
    arguments = ["run", "elbow_comparison", "--no-figures", "--set", "duration_s=0.2", "--out", str(tmp_path)]
    app([*arguments, *(["-q"] if quiet else [])], standalone_mode=False)
    assert ("s references" in shown.getvalue()) is not quiet
    assert ("simulated" in shown.getvalue()) is not quiet


def test_eighty_columns_hold_the_times(monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(output, "console", Console(file=shown, width=80, force_terminal=True, color_system=None))
    scenario = load_scenario("elbow_comparison", overrides={"duration_s": 9999})
    scenario = replace(scenario, variant="a_variant_with_quite_a_long_name")
    with output.progress([scenario], quiet=False) as report:
        report(scenario.variant, 9998.99, REFERENCES)
        report(scenario.variant, 9998.99)
    text = "9998.99 / 9999 s {} 0:00:00 to go -:--:--"
    lines = shown.getvalue().splitlines()
    for stage in ("references", "simulated"):
        assert any("a_variant_with_quite_…" in line and line.endswith(text.format(stage)) for line in lines)
