"""Sections of a servo map that concern all servos: serial line, supply, and abort limits.

The rules that apply these limits: :mod:`dynsim.hardware.replay.rules`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import Field, model_validator

from dynsim.config.base import Positive, StrictConfig, error_at
from dynsim.hardware.bus.control_table import BAUD_RATES
from dynsim.hardware.strict_yaml import Objection, Within, rounded_up

LONGEST_REACTION = 0.5
"""Longest time from the first cycle that shows a fault to its declaration by a rule [s]."""
STOP_CYCLES = 3
"""Least number of cycles of a stop along the path."""
ROUNDED = 1e-9
"""Relative rounding error by which a number of cycles may exceed a time."""

FaultPolicy = Literal["hold", "decelerate", "off"]

# The servos know 4.5 Mbit/s, the client library does not.
_BAUD_CHOICES = [rate for rate in BAUD_RATES if rate <= 4_000_000]


class BusSettings(StrictConfig):
    """The serial line."""

    baud: int = Field(3_000_000, json_schema_extra={"enum": [*_BAUD_CHOICES]}, description="bit rate [bit/s]")
    rate: Positive = Field(200.0, description="goal and state cycles per second [Hz]")
    latency: Annotated[
        Positive, Within(1e-4, 2.54, "s", "no adapter answers at once, and no watchdog waits longer")
    ] = Field(2e-3, description="what adapter and operating system may add to an answer [s]")
    return_delay: float = Field(0.0, ge=0, le=508e-6, description="longest return delay a servo may have stored [s]")

    @model_validator(mode="after")
    def _baud_is_one_of_the_servos(self) -> BusSettings:
        if self.baud not in _BAUD_CHOICES:
            raise error_at("baud", f"is not one of {', '.join(map(str, _BAUD_CHOICES))}")
        return self


class Supply(StrictConfig):
    """Voltage range in which the robot may move."""

    lowest: Positive = Field(10.0, description="[V]")
    highest: Positive = Field(14.8, description="[V]")


class Safety(StrictConfig):
    """When to abort, and how to stop."""

    policy: FaultPolicy = Field(
        "decelerate",
        description="on a fault: freeze where the robot is; slow down along the path and hold; release the torque",
    )
    stop_time: float = Field(0.3, gt=0, le=3.0, description="time in which `decelerate` comes to rest [s]")
    run_up: Annotated[Positive, Within(0.01, 1e5, "rad/s²", "takes minutes, or is a knock")] = Field(
        2.0, description="acceleration of the stretch added where a record begins or ends in motion [rad/s²]"
    )
    approach_velocity: Annotated[Positive, Within(1e-3, 1.0, "rad/s", "nobody has checked the way to the start")] = (
        Field(0.3, description="top speed of the move to the start posture [rad/s]")
    )
    start_distance: Annotated[
        Positive, Within(1e-3, 2 * math.pi, "rad", "no joint would ever, or always, be asked about")
    ] = Field(0.5, description="a joint further than this from the start posture is asked about once more [rad]")
    watchdog: float = Field(
        0.2, ge=0.02, le=2.54, description="servos stop by themselves when the bus is silent for this long [s]"
    )
    missed_cycles: int = Field(
        3, ge=1, le=100, description="consecutive cycles of one servo without a status that abort"
    )
    late_cycles: int = Field(5, ge=1, le=1000, description="consecutive late cycles that abort")
    following_cycles: int = Field(5, ge=1, le=100, description="consecutive cycles beyond following_error that abort")
    torque_cycles: int = Field(10, ge=1, le=100, description="consecutive cycles beyond limits.torque that abort")
    temperature_max: Positive = Field(65.0, description="of a servo, beyond which the replay aborts [°C]")
    supply: Supply = Field(Supply(), description="beyond which the replay aborts, or does not start")
    at_end: Literal["off", "hold"] = Field(
        "off", description="torque after a run that went well; a robot that falls when limp holds"
    )


def objections_to_times(bus: BusSettings, safety: Safety) -> Iterable[Objection]:
    """Rules that would fire too late to matter at the rate of the map, and stops shorter than cycles."""
    if bus.latency >= safety.watchdog:
        yield "bus.latency", "is not below safety.watchdog: one lost answer would trip the watchdogs"
    for key in ("missed_cycles", "late_cycles", "following_cycles", "torque_cycles"):
        reaction = getattr(safety, key) / bus.rate
        if reaction > LONGEST_REACTION * (1 + ROUNDED):
            most = int(LONGEST_REACTION * bus.rate * (1 + ROUNDED))
            fix = f"use {most} or less" if most else "use a higher bus.rate"
            yield f"safety.{key}", f"takes {reaction:.3g} s at {bus.rate:g} Hz, reactions {LONGEST_REACTION:g} s; {fix}"
    if safety.missed_cycles / bus.rate >= safety.watchdog:
        yield (
            "safety.missed_cycles",
            f"takes {safety.missed_cycles / bus.rate:.3g} s at {bus.rate:g} Hz: the watchdogs would trip first, after "
            f"{safety.watchdog:g} s; use fewer, or a longer safety.watchdog",
        )
    if safety.stop_time < STOP_CYCLES / bus.rate:
        yield (
            "safety.stop_time",
            f"is less than {STOP_CYCLES} cycles of {bus.rate:g} Hz; use {rounded_up(STOP_CYCLES / bus.rate):g} or more",
        )
