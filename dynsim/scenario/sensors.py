"""The ``sensors:`` section of a scenario: rate, delay, resolution and noise of a sampled controller's inputs."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, StrictInt

from dynsim.config.base import NonNegative, StrictConfig

# Rate of a sensor [Hz]; limited because each sample is a call of Python.
Rate = Annotated[float, Field(gt=0.0, le=1e5)]
# Resolution of the MX series [deg]: 4096 positions in a turn (data sheet).
MX_RESOLUTION = math.degrees(2.0 * math.pi / 4096)


class Sensor(StrictConfig):
    """What all sensors have: the last sample that has arrived is held."""

    rate_hz: Rate | None = Field(None, description="of its samples; default: one at every tick of the controller")
    delay_s: NonNegative = Field(0.0, description="from a sample to its arrival")


class Encoders(Sensor):
    """Positions of joints; their rates are differences of samples."""

    resolution_deg: NonNegative = Field(
        MX_RESOLUTION, description="angles are rounded to it; default: 4096 positions in a turn, as MX servos have"
    )
    noise_deg: NonNegative = Field(0.0, description="standard deviation, before rounding")
    resolution_m: NonNegative = Field(0.0, description="the same of prismatic joints")
    noise_m: NonNegative = Field(0.0, description="the same of prismatic joints")


class MotionCapture(Sensor):
    """Position and attitude of the controlled point of a snake ([T] V.A)."""

    rate_hz: Rate | None = Field(100.0, description="of its samples (assumed)")
    delay_s: NonNegative = Field(0.01, description="from a sample to its arrival (assumed)")
    position_noise_m: NonNegative = Field(2e-4, description="standard deviation of each coordinate (assumed)")
    attitude_noise_rad: NonNegative = Field(5e-4, description="standard deviation of each angle (assumed)")


class Sensors(StrictConfig):
    """Sensors of the robot; one that is not there tells the truth at once."""

    seed: StrictInt = Field(0, ge=0, description="of all noise: the same seed, the same noise")
    encoders: Encoders | None = None
    motion_capture: MotionCapture | None = None
