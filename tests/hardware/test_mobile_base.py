"""The arm of a mobile base on servos: the record has a base that no servo moves, and more coordinates than rates."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import dynsim
from dynsim import cli
from dynsim.hardware.replay.compare import compare_records
from dynsim.record import Record
from dynsim.scenario import load_scenario

DRIVING_AND_TURNING = {
    "duration_s": 1.2,
    "metrics.settle_s": 0.2,
    "controller.hand": None,
    "controller.joints": {"joint_1": {"times_s": [0, 0.5, 1.1], "angles_deg": [0, 20, -5]}},
    "controller.base.path": {"type": "arc", "radius_m": 0.4, "angle_deg": 40, "duration_s": 0.9, "start_s": 0.1},
}


@pytest.mark.long
def test_joints_of_the_arm_are_replayed_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = dynsim.simulate(load_scenario("mobile_elbow_comparison_driving", "no_elbow", DRIVING_AND_TURNING))
    path, out = record.save(tmp_path / "record.h5"), tmp_path / "out"
    arguments = ["hw", "replay", str(path), "--map", "arm", "--port", "virtual", "--out", str(out), "--quiet"]
    monkeypatch.setattr(sys, "argv", ["dynsim", *arguments])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    assert not leaving.value.code, capsys.readouterr().err
    measured = Record.load(out / "measured.h5")
    joints = [label for label in record.labels["q"] if label.startswith("joint_")]
    assert measured.complete
    assert list(measured.labels["q"]) == joints
    compared = compare_records(record, measured)
    assert [joint.joint for joint in compared.joints] == joints
    # Joint 1 went to and fro by 25°; at each end the friction of the gear costs some mrad.
    assert np.ptp(measured["q"][:, 0]) == pytest.approx(
        np.ptp(record["q"][:, record.labels["q"].index("joint_1")]), abs=0.02
    )
    # What is left is the lag of the servos' position loops.
    assert max(joint.rms_delay_removed for joint in compared.joints) < 0.005
