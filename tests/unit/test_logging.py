"""Log messages: their content, and silence where logging was not requested."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest

import dynsim
from dynsim.errors import SimulationStopped
from dynsim.scenario import load_scenario

SHORT = {"duration_s": 0.3, "metrics.settle_s": 0.1}


def test_a_run_logs_what_takes_long_and_its_warnings(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "dynsim")
    record = dynsim.simulate(load_scenario("elbow_comparison", overrides=SHORT))
    assert {entry.name for entry in caplog.records} == {
        "dynsim.engine",
        "dynsim.engine.stopping",
        "dynsim.engine.prepare",
        "dynsim.engine.simulation",
    }
    messages = [entry.getMessage() for entry in caplog.records if entry.levelno == logging.INFO]
    title = "elbow_comparison (two_elbows): "
    assert messages[:2] == [f"{title}planning references over 0.3 s", messages[1]]
    assert messages[1].startswith(f"{title}planned references in 0.")
    assert messages[-3].split(" in ")[0] in ("loaded the kernels", "compiled the kernels")
    assert messages[-2] == f"{title}integrating 0.3 s by radau5"
    assert messages[-1].startswith(f"{title}integrated 0.3 s in {record.summary['steps']} steps, ")
    warned = [entry.getMessage() for entry in caplog.records if entry.levelno == logging.WARNING]
    assert warned == [title + warning for warning in record.summary["warnings"]]
    assert warned


def test_the_snake_logs_too(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "dynsim")
    dynsim.simulate(load_scenario("snake_operator", overrides={"duration_s": 0.05}))
    messages = [entry.getMessage() for entry in caplog.records if entry.name == "dynsim.engine.kinematic"]
    assert messages[-2] == "snake_operator: integrating 0.05 s in 10 control periods"
    assert messages[-1].startswith("snake_operator: integrated 10 control periods in ")


def test_a_run_that_stops_logs_why(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SimulationStopped):
        dynsim.simulate(load_scenario("elbow_comparison", overrides={"integrator.step_max_s": 1e-13}))
    assert caplog.records[-1].getMessage().startswith("elbow_comparison (two_elbows): incomplete: stopped at t = ")


def test_workers_log_in_their_parent(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "dynsim")
    records = dynsim.compare("elbow_comparison", overrides=SHORT, jobs=2)
    messages = [entry.getMessage() for entry in caplog.records]
    for variant, record in records.items():
        title = f"elbow_comparison ({variant}): "
        assert f"{title}integrating 0.3 s by radau5" in messages
        for warning in record.summary["warnings"]:
            assert title + warning in messages


def test_a_script_that_asks_for_nothing_is_told_nothing() -> None:
    code = "import dynsim; r = dynsim.simulate(dynsim.load_scenario('elbow_comparison', overrides={'duration_s': 0.1}))"
    code += "; print(bool(r.summary['warnings']))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert (result.stdout, result.stderr) == ("True\n", "")


@pytest.mark.parametrize("verbose", [False, True])
def test_only_verbose_shows_it_and_only_on_stderr(tmp_path: Path, verbose: bool) -> None:
    command = [sys.executable, "-m", "dynsim", *(["-v"] if verbose else []), "run", "elbow_comparison", "--no-figures"]
    command += ["--quiet", "--set", "duration_s=0.3", "--set", "metrics.settle_s=0.1"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=True)
    assert result.stdout == ""
    assert ("INFO elbow_comparison (two_elbows): integrating 0.3 s" in result.stderr) is verbose
    assert ("WARNING elbow_comparison (two_elbows): elbow_4: the floor pulls" in result.stderr) is verbose
    assert bool(result.stderr) is verbose
