"""Commands of controllers on records: continuous commands, and commands held from tick to tick."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from combinations.observed import Observed
from dynsim.model.drives import Motor

Array = NDArray[np.float64]
Finding = Iterator[str]

# At a tick the record shows the voltage that is held from then on (False), or that was held until then (True).
SHOWS_HELD_UNTIL_TICK = False


def commands(seen: Observed) -> Finding:
    """Check that voltages are the controller's commands now, or at the last tick, for constant references."""
    controller = seen.config.get("controller") or {}
    if controller.get("type") != "joint_pd" or any(
        controller.get(key) for key in ("hand", "operator", "brace", "torques")
    ):
        return
    # Encoders measure other states; an equilibrium start shifts the references.
    if seen.reads_sensors or (seen.config.get("initial") or {}).get("equilibrium"):
        return
    if controller.get("feed_forward", "none") != "none":
        return
    moved = set(controller.get("joints") or {})
    period = seen.sample_time
    for a, motor in enumerate(seen.robot.motors):
        if not isinstance(motor, Motor) or motor.joint in moved:
            continue
        i = seen.joints.index(motor.joint)
        k_p, k_d = (_gain(controller, key, motor.joint) for key in ("k_p_V_per_rad", "k_d_V_s_per_rad"))
        if k_p is None or k_d is None:
            continue
        q, v = seen.q[:, seen.bodies.places[i]], seen.v[:, i]
        command = np.clip(
            k_p * (seen.robot.initial[seen.bodies.places[i]] - q) - k_d * v, -motor.voltage_limit, motor.voltage_limit
        )
        shown = seen.record["voltage"][:, a]
        if np.isfinite(motor.current_limit):
            continue
        off = np.abs(shown - command) if period is None else _held_command_errors(seen, command, shown, period)
        allowed = 1e-6 * (np.abs(command).max() + abs(k_p) + abs(k_d) * (1.0 + np.abs(v).max())) + 1e-9
        if off.max(initial=0.0) > allowed:
            t = int(off.argmax())
            yield (
                f"{motor.joint} at t = {seen.time[t]:.6g} s: {shown[t]:.6g} V, {off[t]:.3g} V off the command of the "
                f"state"
            )


def _gain(controller: Mapping[str, Any], key: str, joint: str) -> float | None:
    value = controller.get(key)
    if isinstance(value, Mapping):
        value = value.get(joint)
    return None if value is None or isinstance(value, Sequence) else float(value)


def _held_command_errors(seen: Observed, command: Array, shown: Array, period: float) -> Array:
    """Return how much voltages differ from the command at their tick, if that is a sample, (T,) [V]."""
    count = seen.time / period
    at_tick = np.abs(count - np.round(count)) < 1e-6
    tick = np.where(at_tick, np.round(count), np.floor(count)).astype(int)
    if SHOWS_HELD_UNTIL_TICK:
        tick = np.where(at_tick & (tick > 0), tick - 1, tick)
    sample_of_tick = {int(tick_): i for i, tick_ in enumerate(np.round(count).astype(int)) if at_tick[i]}
    off = np.zeros(len(seen))
    for i, number in enumerate(tick):
        if int(number) in sample_of_tick:
            off[i] = abs(shown[i] - command[sample_of_tick[int(number)]])
    return off
