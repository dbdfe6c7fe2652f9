"""Log messages: their content, and silence where logging was not requested."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.messages import check_message, lines_with

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
    planning, planned, kernels, integrating, integrated = *messages[:2], *messages[-3:]
    assert all(message.startswith(title) for message in (planning, planned, integrating, integrated))
    check_message(planning, "0.3 s")
    check_message(planned, re.compile(r"\b0\.\d+ s$"))
    check_message(kernels, re.compile(r"\b\d+\.\d s$"))
    check_message(integrating, "0.3 s", "radau5")
    check_message(integrated, "0.3 s", str(record.summary["steps"]))
    warned = [entry.getMessage() for entry in caplog.records if entry.levelno == logging.WARNING]
    assert warned == [title + warning for warning in record.summary["warnings"]]
    assert warned


def test_the_snake_logs_too(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "dynsim")
    dynsim.simulate(load_scenario("snake_operator", overrides={"duration_s": 0.05}))
    messages = [entry.getMessage() for entry in caplog.records if entry.name == "dynsim.engine.kinematic"]
    check_message(messages[-2], "snake_operator", "0.05 s", "10")
    check_message(messages[-1], "snake_operator", "10")


def test_a_run_that_stops_logs_why(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SimulationStopped) as stop:
        dynsim.simulate(load_scenario("elbow_comparison", overrides={"integrator.step_max_s": 1e-13}))
    message = caplog.records[-1].getMessage()
    assert message.startswith("elbow_comparison (two_elbows): ")
    assert str(stop.value) in message


@pytest.mark.long
def test_workers_log_in_their_parent(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "dynsim")
    records = dynsim.compare("elbow_comparison", overrides=SHORT, jobs=2)
    messages = [entry.getMessage() for entry in caplog.records]
    for variant, record in records.items():
        title = f"elbow_comparison ({variant}): "
        assert lines_with(messages, f"elbow_comparison ({variant})", "0.3 s", "radau5")
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
    assert bool(lines_with(result.stderr, "INFO elbow_comparison (two_elbows)", "0.3 s", "radau5")) is verbose
    assert bool(lines_with(result.stderr, "WARNING elbow_comparison (two_elbows)", "elbow_4", "floor")) is verbose
    assert bool(result.stderr) is verbose
