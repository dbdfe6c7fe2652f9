"""Robot files of makers: each one loads, if necessary after corrections, agrees with Pinocchio and falls."""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path

import pytest
from support.robot_files import ENERGY, FOLDER, NOT_ROBOTS, PACKAGES, outcomes

KEPT = Path(__file__).parents[2] / "results" / "reference" / "robot_files.json"


@pytest.mark.slow
def test_files_of_makers_load_agree_and_fall(tmp_path: Path) -> None:
    folder = os.environ.get(FOLDER)
    if not folder:
        pytest.skip(f"{FOLDER} must name the folder in which the packages of {PACKAGES.name} are installed")
    kept = json.loads(KEPT.read_text(encoding="utf-8"))["files"]
    outcome = dict(outcomes(Path(folder), tmp_path))
    assert outcome.keys() == kept.keys()
    for name, result in outcome.items():
        if Path(name).name in NOT_ROBOTS:
            assert result["read"] == "refused", name
            continue
        assert result["read"] != "refused", (name, result)
        # A file that is a template shows its problems only when it is expanded.
        assert result.get("messages", 0) <= 1, (name, result)
        assert result.get("agrees", True), name
        assert result["motion"] == "without masses" or abs(result["ledger"]) <= ENERGY, (name, result)
        assert {**result, "ledger": 0} == {**kept[name], "ledger": 0}, name


def test_record_of_files_has_no_failure() -> None:
    kept = json.loads(KEPT.read_text(encoding="utf-8"))["files"]
    counts = Counter(result["read"] for result in kept.values())
    assert counts["refused"] == len(NOT_ROBOTS)
    assert max(abs(result.get("ledger", 0.0)) for result in kept.values()) <= ENERGY
