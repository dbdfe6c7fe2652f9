"""Who understands what is on the line: servos sorted by bit rate and ID, as they are set now."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import MAX_ID
from dynsim.hardware.virtual.registers import ServoRegisters

PROTOCOL = 2
"""That of the line. A servo in which another one is set is silent for good, as nobody speaks it."""


@dataclass
class Hearing:
    """Servos of one bit rate, named by the ID they had at first.

    Attributes
    ----------
    by_id : dict of int to list of int
        By the ID they have now; more than one where they share it.
    by_shadow : dict of int to list of int
        By their secondary ID: they obey what is written to it, and do not answer.
    members : int array
        Their places in the order of the line.
    """

    by_id: dict[int, list[int]] = field(default_factory=dict)
    by_shadow: dict[int, list[int]] = field(default_factory=dict)
    members: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def by_bit_rate(servos: Mapping[int, ServoRegisters]) -> dict[int, Hearing]:
    """Who understands a packet, by its bit rate [bit/s]; as the registers say now."""
    hearings: dict[int, Hearing] = {}
    for index, (first_id, registers) in enumerate(servos.items()):
        if registers["protocol"] != PROTOCOL:
            continue
        hearing = hearings.setdefault(registers.baud, Hearing())
        hearing.members = np.append(hearing.members, index)
        hearing.by_id.setdefault(registers["id"], []).append(first_id)
        if registers["shadow_id"] <= MAX_ID and registers["shadow_id"] != registers["id"]:
            hearing.by_shadow.setdefault(registers["shadow_id"], []).append(first_id)
    return hearings
