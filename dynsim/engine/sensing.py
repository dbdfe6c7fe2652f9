"""Sensors between a simulation and a sampled controller: samples at a rate, with noise, that come late and are held."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from dynsim.engine.stepped import State
from dynsim.model.description import Array

# Arrivals this close to a tick belong to it [s].
ROUNDING = 1e-9


class Stateful(Protocol):
    """A simulation that tells its state."""

    @property
    def state(self) -> State:
        """See :attr:`dynsim.engine.simulation.Simulation.state`."""
        ...


class SampledSensor:
    """Called when a sample is due; :meth:`value` is the last one that has arrived.

    A sample of x is x + σ ξ with ξ standard normal, rounded to the resolution where there is one.

    Parameters
    ----------
    read : the true value of a state, (k,)
    period : of the samples [s]
    delay : from a sample to its arrival [s]
    noise : (k,) standard deviations σ
    resolution : 0 for none
    seed : of the noise
    """

    def __init__(
        self,
        read: Callable[[State], Array],
        *,
        period: float,
        delay: float,
        noise: Array,
        resolution: float,
        seed: list[int],
    ) -> None:
        self.period = period
        self._read, self._delay, self._noise, self._resolution = read, delay, noise, resolution
        self._random = np.random.default_rng(seed)
        self._samples: deque[tuple[float, Array]] = deque()

    def __call__(self, simulation: Stateful) -> None:
        """Take a sample."""
        state = simulation.state
        x = self._read(state) + self._noise * self._random.standard_normal(len(self._noise))
        if self._resolution > 0.0:
            x = self._resolution * np.rint(x / self._resolution)
        # The first is known from the start.
        delay = self._delay if self._samples else 0.0
        self._samples.append((state.time + delay, x))

    def value(self, time: float) -> Array:
        """The last sample that has arrived at a time [s], (k,)."""
        while len(self._samples) > 1 and self._samples[1][0] <= time + ROUNDING:
            self._samples.popleft()
        return self._samples[0][1]

    def remembered(self) -> dict[str, Any]:
        """What the future depends on."""
        return {"samples": list(self._samples), "random": self._random.bit_generator.state}

    def restore(self, kept: dict[str, Any]) -> None:
        """Go back to what :meth:`remembered` gave."""
        self._samples = deque(kept["samples"])
        self._random.bit_generator.state = kept["random"]
