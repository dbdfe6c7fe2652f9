"""Stationary mobile base."""

from __future__ import annotations

from typing import Literal

import numpy as np

from dynsim.compile.control import BasePath
from dynsim.compile.protocols import BuildContext
from dynsim.config.base import StrictConfig
from dynsim.model.description import Array


class Config(StrictConfig):
    """Stationary base: the wheels hold their position, as they do if no path is set."""

    type: Literal["hold"]

    def motion(self, t: Array) -> Array:
        """Return zero distance and turn at times t [s], shape (T, 2)."""
        return np.zeros((len(t), 2))


def build(config: Config, context: BuildContext) -> BasePath:
    """Return the configuration itself, which implements the `BasePath` interface."""
    return config
