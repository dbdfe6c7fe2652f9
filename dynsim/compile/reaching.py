"""Kernel tables for the inverse kinematics of a hand: hand point, moving joints with limits, braces, workspace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dynsim.compile.model import Model
from dynsim.compile.shapes import compile_shapes
from dynsim.compile.tables import compile_contacts
from dynsim.dynamics.inverse_kinematics import PathArrays
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Contact


def path_arrays(
    model: Model, joints: Sequence[str], braces: Sequence[Contact] = (), limited: bool = False
) -> PathArrays:
    """Return tables for joints that move the hand of a robot along a path while braces stay on their surfaces.

    With ``limited``, the joint limits are enforced along the path.
    """
    columns = [model.joint_names.index(name) for name in joints]
    link, point = model.robot.attach(*model.robot.hand)
    # Remove friction, which has no effect here, so that the runs of a sweep over friction share the same path.
    points = [replace(contact, tip=None, friction=0.0) for contact in braces]
    rows = 3 + len(braces)
    links = [model.robot.links[column] for column in columns if limited]
    return PathArrays(
        link=link,
        point=reals(point),
        braces=compile_contacts(model.robot, points),
        shapes=compile_shapes(model.robot, points),
        column=integers(columns),
        place=integers([model.robot.position_index[column] for column in columns]),
        lower=reals([link.lower for link in links] or np.full(len(columns), -np.inf)),
        upper=reals([link.upper for link in links] or np.full(len(columns), np.inf)),
        jacobian=np.zeros((3, model.n)),
        rates=np.zeros((rows, len(columns))),
        system=np.zeros((rows, rows)),
        error=np.zeros(rows),
        change=np.zeros(len(columns)),
        position=np.zeros(3),
    )
