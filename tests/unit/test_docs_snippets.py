"""The scripts of docs/extending.md and docs/python.md run, and do what the text says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynsim import Record, load_scenario, simulate
from dynsim.draw.figures import arm, draw

DOCS = Path(__file__).parents[2] / "docs"


def script(page: str, heading: str, last: int = -1) -> dict[str, Any]:
    """What the last block of Python below a heading leaves behind."""
    text = (DOCS / page).read_text(encoding="utf-8")
    section = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    names: dict[str, Any] = {}
    exec(compile(re.findall(r"```python\n(.*?)```", section, flags=re.DOTALL)[last], page, "exec"), names)
    return names


def test_stepping() -> None:
    names = script("extending.md", "Stepping: ticks, events, pushes")
    # The joint that is held has stayed, the base beyond its event too.
    record, joint = names["record"], names["joint"]
    assert np.abs(record["q"][:, joint] - names["start"]).max() < 0.05
    assert {happening.kind for happening in names["simulation"].happened} == {"contact_force", "joint_position"}
    reached = next(event.time for event in record.events if event.name == "joint_1")
    base = np.interp(reached, record.time, record["q"][:, 0])
    assert base == pytest.approx(-0.01, abs=1e-5)
    assert record["q"][-1, 0] == pytest.approx(-0.01, abs=2e-3)
    assert 1e-4 < np.abs(names["pushed"].q - names["free"].q).max() < 0.1
    assert record.time[-1] == 0.6
    assert names["again"].time == 1.0
    assert names["again"].finished


def test_stepping_of_the_python_page() -> None:
    names = script("python.md", "Step through a simulation")
    # The step that would pass 1.5 s is not in the record yet; the step size is below two samples.
    assert 1.49 <= names["record"].time[-1] <= 1.5
    assert not names["simulation"].finished
    plain = simulate(load_scenario("elbow_comparison", "two_elbows", {"duration_s": 2}))
    assert np.array_equal(names["state"].q, plain["q"][100])
    assert not np.array_equal(names["record"]["q"][200], plain["q"][200])


def test_a_free_body_falls() -> None:
    names = script("extending.md", "A free body")
    robot = names["robot"]
    assert (len(robot.position_names), len(robot.joint_names)) == (7, 6)
    acceleration = names["Model"](robot).forward_dynamics(robot.initial, np.zeros(6), np.zeros(6))
    np.testing.assert_allclose(acceleration, [0, 0, -9.81, 0, 0, 0], atol=1e-14)


def test_a_live_operator() -> None:
    record = script("extending.md", "A live operator")["record"]
    assert record.complete
    # It has driven 10 cm and a little further, and stopped.
    assert 0.1 < record["w"][-1, 0] - record["w"][0, 0] < 0.15


def test_a_measured_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "results" / "elbow_comparison" / "two_elbows"
    folder.mkdir(parents=True)
    simulate(load_scenario("elbow_comparison", "two_elbows", {"duration_s": 0.1})).save(folder / "record.h5")
    script("extending.md", "Draw a measured record")
    record = Record.load("measured.h5")
    assert record["hand_position"].shape == (401, 3)
    assert record.labels["winding"] == ("joint_9",)


def test_a_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(arm, "FIGURES", dict(arm.FIGURES))
    folder = tmp_path / "results" / "elbow_comparison" / "two_elbows"
    folder.mkdir(parents=True)
    record = simulate(load_scenario("elbow_comparison", "two_elbows", {"duration_s": 0.1}))
    record.save(folder / "record.h5")
    script("extending.md", "A figure")
    assert (tmp_path / "power.pdf").stat().st_size > 0
    # With the figures of dynsim, for every run.
    assert tmp_path / "power.png" in draw(record, tmp_path)
