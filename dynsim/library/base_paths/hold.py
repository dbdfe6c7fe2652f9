"""The base stays where it stands."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.control import BasePath
from dynsim.compile.protocols import BuildContext
from dynsim.config.base import StrictConfig


class Config(StrictConfig):
    """The wheels hold, as they do without a path."""

    type: Literal["hold"]

    def motion(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """No distance and no turn, (T, 2)."""
        return np.zeros((len(t), 2))


def build(config: Config, context: BuildContext) -> BasePath:
    """The path, which its configuration is."""
    return config
