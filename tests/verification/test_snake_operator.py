"""Failures of an operator's input: a failing source, a path too fast, a path out of reach."""

from __future__ import annotations

import numpy as np
import pytest
from support.messages import lines_with, raises

from dynsim.engine import kinematic
from dynsim.errors import ModelError, SimulationInterrupted, SimulationStopped
from dynsim.library.controllers.snake_commands import Circle
from dynsim.record import Record
from dynsim.scenario import load_scenario
from dynsim.snake.description import NO_REQUEST, CommandBlock

PERIOD = 0.005


def scenario(duration: float, paths=(), commands=(), **changes):
    changes = {"duration_s": duration, "controller.paths": list(paths), "controller.commands": list(commands)} | changes
    return load_scenario("snake_positioning", "x", changes)


def ramp(duration: float, **displacement: float) -> dict:
    names = ("x", "y", "z", "alpha", "beta", "gamma")
    displacements = [displacement.get(name, 0.0) for name in names]
    return {"type": "ramp", "start_s": 0.5, "duration_s": duration, "displacement": displacements, "profile": "smooth"}


class Live:
    """Source of one command per period: ahead at 5 cm/s, and the result of ``then()`` from t = 1 s on."""

    def __init__(self, then):
        self.then = then

    def read(self, first, count, period, feedback):
        if feedback.time >= 1.0 - 1e-9:
            return self.then()
        return step([0.05, 0, 0, 0, 0, 0])


def step(velocity, request=NO_REQUEST):
    return CommandBlock(np.array([velocity], dtype=float), np.array([request]), np.array([0]))


def failing(error):
    def now():
        raise error

    return now


@pytest.mark.parametrize(
    ("then", "names"),
    [
        (lambda: step([0, np.nan, 0, 0, 0, 0]), ["y", "0", "1", "nan"]),
        (lambda: step([0, 0, 0, 0, 0, -np.inf]), ["gamma", "0", "1", "-inf"]),
        (lambda: step([0] * 6, request=9), ["controller.commands", "9", "1, 2, 3, 4, 5, 6"]),
        (lambda: step([0] * 3), ["velocity (1, 3)", "(T, 6)"]),
        (lambda: None, ["Live", "AttributeError"]),
        (failing(OSError("joystick unplugged")), ["Live", "OSError('joystick unplugged')"]),
    ],
)
def test_a_live_source_that_fails_is_named_and_what_it_did_is_kept(then, names) -> None:
    with raises(SimulationStopped, "1 s", *names) as stopped:
        kinematic.simulate(scenario(5.0), source=Live(then))
    kept = stopped.value.record
    assert stopped.value.time == 1.0
    assert not kept.complete
    assert kept.time[-1] == pytest.approx(1.0)
    assert all(np.isfinite(kept[name]).all() for name in ("phi", "rho", "w", "w_target", "base_pose"))
    whole = kinematic.simulate(scenario(1.0), source=Live(failing(AssertionError("asked too late"))))
    for name in whole.signals:
        np.testing.assert_array_equal(kept[name], whole[name], err_msg=name)
    assert lines_with(kept.summary["warnings"], phrase="incomplete")


def test_the_cause_of_a_failure_is_there_with_its_traceback() -> None:
    cause = ZeroDivisionError("in the joystick's driver")
    with pytest.raises(SimulationStopped) as stopped:
        kinematic.simulate(scenario(5.0), source=Live(failing(cause)))
    assert stopped.value.__cause__ is cause


def test_ctrl_c_within_a_source_is_no_failure_of_it() -> None:
    with raises(SimulationInterrupted, "1.000 s", "5 s") as stopped:
        kinematic.simulate(scenario(5.0), source=Live(failing(KeyboardInterrupt())))
    assert not stopped.value.record.complete


def test_a_source_that_fails_at_once_has_nothing_to_keep() -> None:
    class Broken:
        def read(self, first, count, period, feedback):
            return step([np.nan] * 6)

    with raises(ModelError, "0 s", "x", "nan"):
        kinematic.simulate(scenario(5.0), source=Broken())


def displacement(record: Record) -> np.ndarray:
    return np.array(record.summary["target_displacement"])


@pytest.mark.parametrize(
    ("path", "slow"),
    [
        (ramp(0.1, y=0.15), ramp(4.0, y=0.15)),
        (ramp(0.02, z=0.04), ramp(4.0, z=0.04)),
        (ramp(0.05, gamma=0.5, x=0.05), ramp(4.0, gamma=0.5, x=0.05)),
    ],
)
def test_a_path_that_is_too_fast_is_followed_slower_to_its_end(path, slow) -> None:
    """It takes longer, keeps the rate limit, and is the same path: where the slow one leads, with all six in step."""
    fast, patient = kinematic.simulate(scenario(8.0, [path])), kinematic.simulate(scenario(8.0, [slow]))
    assert patient.summary["path_slowed_s"] == patient.summary["path_late_s"] == 0.0
    summary = fast.summary
    assert summary["waiting_s"] == 0.0
    assert summary["path_slowed_s"] > summary["path_late_s"] > 0.0
    assert summary["out_of_reach"] is None
    np.testing.assert_allclose(displacement(fast), path["displacement"], atol=1e-12)
    assert summary["joint_rate_max_rad_s"] <= 4.7
    assert summary["final_position_error_m"] < 1e-6
    assert lines_with(summary["warnings"], phrase="too fast")
    moved = fast["w_target"] - fast["w_target"][0]
    along = moved @ np.array(path["displacement"]) / np.dot(path["displacement"], path["displacement"])
    np.testing.assert_allclose(moved, np.outer(along, path["displacement"]), atol=1e-12)
    assert (np.diff(along) >= -1e-12).all()
    # Late by what it was slower: it stands still at the end from then on.
    end = 0.5 + path["duration_s"] + summary["path_late_s"]
    moving = np.flatnonzero(np.diff(along) > 1e-12)
    assert fast.time[moving[-1] + 1] == pytest.approx(end, abs=2 * PERIOD + 1 / 200)


def test_a_curved_path_that_is_too_fast_is_not_cut() -> None:
    """Rows of commands are carried out in parts of a period each: every end of a row is still passed."""
    circle = {"type": "circle", "start_s": 0.0, "duration_s": 0.15, "radius_m": 0.03, "plane": "yz"}
    record = kinematic.simulate(scenario(3.0, [circle]))
    assert record.summary["path_slowed_s"] > 0.1
    assert record.summary["waiting_s"] == 0.0
    corner = Circle(**circle).offset(smooth(np.arange(31) / 30))[:, 1:3]
    target = record["w_target"][:, 1:3] - record["w_target"][0, 1:3]
    start, side = corner[:-1], np.diff(corner, axis=0)
    part = np.einsum("tki,ki->tk", target[:, None] - start, side) / (side**2).sum(axis=1)
    nearest = start + np.clip(part, 0.0, 1.0)[..., None] * side
    off = np.linalg.norm(target[:, None] - nearest, axis=2).min(axis=1)
    # A period that passes a corner ends on the next side, and none of them ends off the sides.
    assert off.max() < 1e-12
    np.testing.assert_allclose(displacement(record), 0.0, atol=1e-12)


def smooth(s: np.ndarray) -> np.ndarray:
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def test_a_live_operator_that_asks_too_much_gets_what_is_possible() -> None:
    class Fast:
        waited = 0

        def read(self, first, count, period, feedback):
            self.waited += feedback.waiting
            return step([0, 2.0 if 0.5 <= feedback.time < 0.55 else 0.0, 0, 0, 0, 0])

    source = Fast()
    record = kinematic.simulate(scenario(2.0), source=source)
    assert source.waited == 0
    moved = displacement(record)[1]
    # What a slower target has not done in its period is lost: a joystick says anew what it wants.
    assert 0.0 < moved < 0.1
    assert moved == pytest.approx(2.0 * (0.05 - record.summary["path_late_s"]), abs=1e-12)


@pytest.mark.parametrize("duration", [0.05, 0.2, 5.0])
def test_a_path_out_of_reach_is_called_that_however_fast(duration) -> None:
    """The head, held level at x = 0.249 m with psi3 at 110 deg, can be raised by 50 mm and no further."""
    record = kinematic.simulate(scenario(8.0, [ramp(duration, z=0.12)]))
    gone = record.summary["out_of_reach"]
    assert gone["reason"] == "singular posture"
    assert gone["since_s"] < 0.5 + duration + 1.0
    assert 0.045 < displacement(record)[2] < 0.051
    assert np.ptp(record["w_target"][record.time > gone["since_s"] + 0.01], axis=0).max() == 0.0
    assert lines_with(record.summary["warnings"], f"{gone['since_s']:.2f} s", phrase="out of reach")


def test_a_target_that_waits_for_a_while_only_is_not_out_of_reach() -> None:
    back = [{"at_s": 0.5, "velocity": [0, 0, 0.05, 0, 0, 0]}, {"at_s": 3.0, "velocity": [0, 0, -0.05, 0, 0, 0]}]

    class UpAndDown:
        def read(self, first, count, period, feedback):
            return step([0, 0, 0.05 if feedback.time < 3.0 else -0.05 if feedback.time < 3.5 else 0.0, 0, 0, 0])

    record = kinematic.simulate(scenario(5.0), source=UpAndDown())
    assert record.summary["waiting_s"] > 1.0
    assert record.summary["out_of_reach"] is None
    # A script waits with its target, and never comes to what it has after that.
    assert kinematic.simulate(scenario(5.0, commands=back)).summary["out_of_reach"] is not None
