"""Wrong types of arguments of the public functions: a DynsimError, or a TypeError that names the argument."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dynsim
from dynsim import DynsimError, Record, Scenario, Simulation
from dynsim.system.arguments import names_wrong_types

WRONG = [None, 5, -1.5, "x", [], {}, object(), float("nan"), [None], np.zeros(0), (1, 2, 3), True, b"x"]
JOINT, BODY = "joint_1", "link_1"
SHORT = {"duration_s": 0.02, "metrics.settle_s": 0.01}


@cache
def scenario() -> Scenario:
    return dynsim.load_scenario("single_pendulum", overrides={"duration_s": 0.02})


@cache
def arm() -> Scenario:
    return dynsim.load_scenario("elbow_comparison", "two_elbows", SHORT)


@cache
def record() -> Record:
    return dynsim.simulate(scenario())


NO_WRENCH = (0.0, 0.0, 0.0)
# Right arguments of each public function; methods are called on a new object each time.
RIGHT: dict[str, Callable[[], dict[str, Any]]] = {
    "load_scenario": lambda: {"path": "single_pendulum", "variant": None, "overrides": {}},
    "simulate": lambda: {"scenario": scenario(), "progress": None, "pictured": True},
    "check": lambda: {"scenario": scenario(), "started": None},
    "compare": lambda: {"path": "single_pendulum", "overrides": {"duration_s": 0.02}, "jobs": 1, "finished": None},
    "simulate_batch": lambda: {"scenarios": [scenario()], "jobs": 1, "keep_records": "none", "finished": None},
    "build_model": lambda: {"scenario": scenario()},
    "figure": lambda: {"records": record(), "name": "energy", "title": True},
    "Model": lambda: {"robot": dynsim.build_model(scenario()).robot},
    "Simulation": lambda: {"scenario": scenario(), "state": None, "duration": None, "trace": None, "motors": None},
    "State.of": lambda: {"record": record(), "sample": -1},
    "view.write": lambda: {"records": {"a": record()}, "path": Path("a.html")},
    "Record": lambda: {"time": [0.0, 1.0], "provenance": None},
    "Record.load": lambda: {"path": "record.h5", "trust": False},
    "Record.add": lambda: {
        "name": "q",
        "data": [0.0, 1.0],
        "unit": "m",
        "labels": (),
        "description": "",
        "axis": "time",
    },
    "Record.add_axis": lambda: {"name": "camera", "times": [0.0]},
    "Record.times": lambda: {"name": "q"},
    "Record.add_event": lambda: {"time": 0.0, "kind": "k", "name": "", "value": None, "description": ""},
    "Record.save": lambda: {"path": Path("b.h5")},
    "Record.to_dataframe": lambda: {"axis": "time"},
    "Simulation.advance": lambda: {"until": 0.001},
    "Simulation.end_samples": lambda: {"time": 0.01},
    "Simulation.every": lambda: {"period": 0.01, "call": len, "first": None},
    "Simulation.watch": lambda: {"kind": "joint angle", "subject": JOINT, "level": 0.0, "direction": 0, "call": None},
    "Simulation.set_reference": lambda: {"joint": JOINT, "position": 0.0, "rate": 0.0},
    "Simulation.set_references": lambda: {"lines": {JOINT: (0.0, 0.0)}},
    "Simulation.set_lines": lambda: {"motors": np.array([0]), "lines": np.zeros((1, 2))},
    "Simulation.set_command": lambda: {"joint": JOINT, "command": 0.0},
    "Simulation.set_mode": lambda: {"joint": JOINT, "mode": "position"},
    "Simulation.set_supply": lambda: {"voltage": 12.0},
    "Simulation.set_brake": lambda: {"joint": JOINT, "closed": True},
    "Simulation.set_tie": lambda: {"name": "x", "holds": True, "stiffness": None, "damping": None},
    "Simulation.release": lambda: {"joint": JOINT},
    "Simulation.set_wrench": lambda: {
        "body": BODY,
        "force": NO_WRENCH,
        "torque": NO_WRENCH,
        "point": NO_WRENCH,
        "in_body": False,
    },
    "Simulation.linearize": lambda: {"inputs": ("command",), "outputs": ("hand_position",)},
    "Simulation.restore": lambda: {"snapshot": None},
    "Simulation.record": lambda: {"scenario": None, "pictured": True},
}
NEW: dict[str, Callable[[], Any]] = {"Record": lambda: Record([0.0, 1.0]), "Simulation": lambda: Simulation(arm())}


def function(name: str) -> Callable[..., Any]:
    owner, _, method = name.partition(".")
    if not method or name in ("State.of", "Record.load", "view.write"):
        return pkgutil.resolve_name(f"dynsim:{name}")
    return getattr(NEW[owner](), method)


def failures(name: str) -> Iterator[str]:
    right = RIGHT[name]()
    for argument in right:
        for wrong in WRONG:
            try:
                function(name)(**right | {argument: wrong})
            except DynsimError as error:
                if "\n" in str(error):
                    yield f"{argument} = {wrong!r}: several lines: {error}"
            except TypeError as error:
                if argument not in str(error):
                    yield f"{argument} = {wrong!r}: not named: {error}"
            except Exception as error:
                yield f"{argument} = {wrong!r}: {error!r}"


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", RIGHT)
def test_a_wrong_type_is_named(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    record().save(tmp_path / "record.h5")
    assert list(failures(name)) == []


def test_errors_of_the_caller_are_left_alone() -> None:
    @names_wrong_types
    def call(function: Callable[[], None], number: float) -> None:
        function()

    def fails() -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        call(fails, 1.0)
