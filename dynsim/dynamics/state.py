"""Layout of the state vector and of a row of recorded outputs; no other file defines it.

The state y is one vector with these blocks, in this order:

    q        (nq,)  joint positions [rad or m; quaternions]
    v        (n,)   joint rates
    current  (k,)   currents of the motors that have a circuit [A]
    ledger   (LEDGER_SIZE,) integrals of power [J], see dynsim.dynamics.ledger
    contact  (2 c,) impulse of the normal force [N s] and slip [m] of each contact point
    load     (l,)   work of each external wrench [J]
    loss     (2,)   energy lost in impacts of contacts and of joint stops [J]; only under the unilateral law
    scheme   (1,)   energy lost by discretisation [J]; only in time stepping, see dynsim.integrators.stepping.step
    elastic  (2,)   energy stored by contacts and ties since the start, and dissipated by their dampers [J];
                    only with compliant contacts or ties, see dynsim.integrators.stepping.contacts

Error control covers the first three blocks; the other blocks are integrals on which the motion does not depend.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Integrals of the ledger, all in joules. DRAWN, MECHANICAL and SUPPLY are reported, but are not part of the balance.
ELECTRICAL, DRAWN, JOULE, GEAR, JOINT, FRICTION, CONSTRAINT, MECHANICAL, SUPPLY = 0, 1, 2, 3, 4, 5, 6, 7, 8
LEDGER_SIZE = 9
# Per contact: impulse of the normal force [N s], slip distance [m].
IMPULSE, SLIP = 0, 1
CONTACT_SIZE = 2
# Losses of impacts [J].
IMPACT_LOSS, JOINT_STOP_LOSS = 0, 1
LOSSES = 2
# Compliant contacts and ties [J].
STORED, DAMPED = 0, 1
ELASTIC_SIZE = 2


class StateLayout(NamedTuple):
    """First index of each block of the state, and other sizes that kernels need."""

    q: int
    v: int
    current: int
    ledger: int
    contact: int
    load: int
    loss: int
    scheme: int
    elastic: int
    size: int
    tracked: int  # number of leading entries under error control: all entries that derivatives depend on
    extra: int  # nq − n
    circuits: int  # number of currents in the state


def state_layout(
    nq: int, n: int, circuits: int, contacts: int, loads: int = 0, losses: int = 0, scheme: int = 0, elastic: int = 0
) -> StateLayout:
    """Return the layout for nq positions, n rates and the numbers of circuits, contact points and wrenches.

    ``losses``, ``scheme`` and ``elastic`` are the sizes of the last blocks.
    """
    sizes = [nq, n, circuits, LEDGER_SIZE, CONTACT_SIZE * contacts, loads, losses, scheme, elastic]
    starts = [int(start) for start in np.cumsum([0, *sizes])]
    # Under error control are the entries before the ledger.
    return StateLayout(*starts, starts[3], nq - n, circuits)


class OutputLayout(NamedTuple):
    """First column of each recorded output that is not a state; ``contact`` has OUTPUTS_PER_CONTACT for each point.

    ``support`` exists for robots with a mobile base, see dynsim.dynamics.tree.support.
    """

    vdot: int
    current: int
    voltage: int
    torque: int
    hand: int
    energy: int
    contact: int
    support: int
    stop: int
    dry: int
    tie: int
    size: int


def block(layout: StateLayout | OutputLayout, name: str) -> slice:
    """Return the slice of the block ``name``, which extends to the start of the next block."""
    names = layout._fields
    return slice(getattr(layout, name), getattr(layout, names[names.index(name) + 1]))


# Kinetic, potential and magnetic energy.
ENERGIES = 3
# Per contact: f_n, force vector (3), gap, slip velocity (3), mode, point where it touches (3), normal (3).
OUT_FORCE, OUT_VECTOR, OUT_GAP, OUT_SLIP, OUT_MODE, OUT_POSITION, OUT_NORMAL = 0, 1, 4, 5, 8, 9, 12
OUTPUTS_PER_CONTACT = 15


def output_layout(
    n: int, motors: int, contacts: int, support: int = 0, stops: int = 0, dry: int = 0, ties: int = 0
) -> OutputLayout:
    """Return the columns for n joints and the numbers of motors, contact points, joint stops, dry frictions and ties.

    ``support`` is the number of columns for the support of a mobile base.
    """
    parts = [n, motors, motors, motors, 3, ENERGIES, OUTPUTS_PER_CONTACT * contacts, support, stops, dry, ties]
    starts = np.cumsum([0, *parts])
    return OutputLayout(*(int(start) for start in starts))
