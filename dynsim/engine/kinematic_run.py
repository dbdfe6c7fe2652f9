"""State of one simulation of the kinematic snake."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.snake.description import CommandBlock, CommandSource, SnakeDescription, TaskSpaceController
from dynsim.snake.kinematics import SnakeModel
from dynsim.snake.state import Rig, State, Trace


@dataclass
class Run:
    """One simulation on its way: the robot, its controller, the commands known now, the state, what was recorded."""

    description: SnakeDescription
    model: SnakeModel
    controller: TaskSpaceController
    source: CommandSource
    ticks: int  # control periods of the whole run
    block: CommandBlock  # commands from tick ``block_start`` on
    block_start: int
    gripper: NDArray[np.int64]  # (ticks,) as far as it was read
    state: State
    rig: Rig
    trace: Trace
    stride: int
    blocked: bool = False  # the last command was not carried out
    recovering: bool = False  # switching modes until the base joints are released
    switch_due: bool = False  # and begins to at the next tick
