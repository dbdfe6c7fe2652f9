"""Sensors of a sampled controller: sampling, noise, resolution, delay and hold."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from dynsim.engine.stepped import State
from dynsim.model.description import Array, Robot
from dynsim.record import Record
from dynsim.scenario.sensors import Encoders

# A sample that arrives this little after a tick is available at that tick [s].
ROUNDING = 1e-9


class Stateful(Protocol):
    """A simulation whose state can be read."""

    @property
    def state(self) -> State:
        """See :attr:`dynsim.engine.simulation.Simulation.state`."""
        ...


class SampledSensor:
    """Called when a sample is due; :meth:`value` is the last one that has arrived.

    A sample of x is x + σ ξ with ξ standard normal, rounded to the resolution ρ where there is one: ρ round(x/ρ).

    Parameters
    ----------
    read : the true value of a state, (k,)
    period : of the samples [s]
    delay : from a sample to its arrival [s]
    noise, resolution : (k,) standard deviations σ, and ρ, 0 for none
    seed : of the noise
    """

    def __init__(
        self,
        read: Callable[[State], Array],
        *,
        period: float,
        delay: float,
        noise: Array,
        resolution: Array,
        seed: list[int],
    ) -> None:
        self.period = period
        self._read, self._delay, self._noise, self._resolution = read, delay, noise, resolution
        self._random = np.random.default_rng(seed)
        self._samples: deque[tuple[float, Array]] = deque()
        self._before: Array | None = None

    def __call__(self, simulation: Stateful) -> None:
        """Take a sample."""
        state = simulation.state
        x = self._read(state) + self._noise * self._random.standard_normal(len(self._noise))
        rounded = self._resolution > 0.0
        x[rounded] = self._resolution[rounded] * np.rint(x[rounded] / self._resolution[rounded])
        # The first is known from the start.
        delay = self._delay if self._samples else 0.0
        self._samples.append((state.time + delay, x))

    def value(self, time: float) -> Array:
        """The last sample that has arrived at a time [s], (k,)."""
        while len(self._samples) > 1 and self._samples[1][0] <= time + ROUNDING:
            self._before = self._samples.popleft()[1]
        return self._samples[0][1]

    def rate(self, time: float) -> Array:
        """By what the last two samples that have arrived differ, over the period, (k,); zero before there are two."""
        value = self.value(time)
        return np.zeros_like(value) if self._before is None else (value - self._before) / self.period

    def remembered(self) -> dict[str, Any]:
        """What the future depends on."""
        samples = list(self._samples)
        return {"samples": samples, "before": self._before, "random": self._random.bit_generator.state}

    def restore(self, kept: dict[str, Any]) -> None:
        """Go back to what :meth:`remembered` gave."""
        self._samples, self._before = deque(kept["samples"]), kept["before"]
        self._random.bit_generator.state = kept["random"]


class EncodedCommands:
    """A sampled controller that sees its joints through encoders: at its ticks it takes all commands by what they tell.

    q̂ is the last sample that has arrived and v̂ the difference to the one before it over their period, as servo drives
    make it: resolution ρ and period T of the encoders give steps of ρ/T in v̂.

    Parameters
    ----------
    take : takes the commands at measured positions and rates of the motors' joints, (na,) [rad or m, rad/s or m/s]
    period : of the controller [s]
    """

    def __init__(
        self, encoders: Encoders, seed: int, robot: Robot, period: float, take: Callable[[Array, Array], None]
    ) -> None:
        self.period, self._take = period, take
        places = dict(zip(robot.joint_names, robot.position_index, strict=True))
        at = np.array([places[motor.joint] for motor in robot.motors], dtype=np.int64)
        turns = {link.joint: link.units[0] == "rad" for link in robot.links}
        revolute = np.array([turns[motor.joint] for motor in robot.motors], dtype=np.bool_)
        self._joints, self._unit = (
            tuple(motor.joint for motor in robot.motors),
            " or ".join(unit for unit, there in (("rad", revolute.any()), ("m", not revolute.all())) if there),
        )
        self.sensor = SampledSensor(
            lambda state: state.q[at],
            period=period if encoders.rate_hz is None else 1.0 / encoders.rate_hz,
            delay=encoders.delay_s,
            noise=np.where(revolute, np.radians(encoders.noise_deg), encoders.noise_m),
            resolution=np.where(revolute, np.radians(encoders.resolution_deg), encoders.resolution_m),
            seed=[seed],
        )
        self._measured: list[tuple[float, Array]] = []

    def __call__(self, simulation: Stateful) -> None:
        """A tick of the controller."""
        time = simulation.state.time
        measured = self.sensor.value(time)
        self._measured.append((time, measured))
        self._take(measured, self.sensor.rate(time))

    def remembered(self) -> dict[str, Any]:
        """What the future depends on, and what was told."""
        return {"sensor": self.sensor.remembered(), "measured": list(self._measured)}

    def restore(self, kept: dict[str, Any]) -> None:
        """Go back to what :meth:`remembered` gave."""
        self.sensor.restore(kept["sensor"])
        self._measured = list(kept["measured"])

    def add_to(self, record: Record) -> None:
        """What the controller was told, held from tick to tick."""
        times = np.array([time for time, _ in self._measured]) - ROUNDING
        rows = np.searchsorted(times, record.time, side="right") - 1
        # A run may have stopped before its first tick.
        readings = np.reshape([positions for _, positions in self._measured], (len(times), len(self._joints)))
        text = "joints as the controller's encoders tell them"
        record.add("q_measured", readings[rows], self._unit, labels=self._joints, description=text)
