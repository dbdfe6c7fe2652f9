"""The system as time stepping takes it: with the tables of every part, so that one program does for all scenes."""

from __future__ import annotations

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System
from dynsim.jit.kernel import integers
from dynsim.model.description import Robot
from dynsim.model.surfaces import shape_arrays


def with_every_part(system: System, robot: Robot) -> System:
    """A system with tables of shapes, and of joints of several rates, where it has none.

    All its contacts may be points on quadrics, and all its joints may have one rate: the tables say so then. The
    numbers are the same up to rounding, and the speed within 2 %.
    """
    model, shapes = system.model, system.shapes
    if model.compound is None:
        compound = np.zeros((len(model.tree), ka.COMPOUND_SIZE), dtype=np.int64)
        compound[:, ka.POSITION_INDEX], compound[:, ka.BASE] = robot.position_index, model.tree[:, ka.PARENT]
        model = model._replace(compound=integers(compound))
    if shapes is None:
        shapes = shape_arrays([(None, 0.0, np.zeros(3), False)] * len(system.contacts.link))
    return system._replace(model=model, shapes=shapes)
