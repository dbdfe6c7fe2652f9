"""Who understands what is on the line: servos sorted by bit rate, protocol and ID, as they are set now."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import MAX_ID
from dynsim.hardware.virtual.registers import ServoRegisters


@dataclass
class Hearing:
    """Servos of one bit rate and protocol, named by the ID they had at first.

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


class Addresses:
    """Sorts servos; :meth:`sort` again when one of their settings has changed."""

    def __init__(self, servos: Mapping[int, ServoRegisters]) -> None:
        self._servos = servos
        self.sort()

    def sort(self) -> None:
        """Take over what the registers say now."""
        self._hearing: dict[tuple[int, int], Hearing] = {}
        self._protocols: dict[int, tuple[int, ...]] = {}
        for place, (first_id, registers) in enumerate(self._servos.items()):
            baud, protocol = registers.baud, registers["protocol"]
            hearing = self._hearing.setdefault((baud, protocol), Hearing())
            hearing.members = np.append(hearing.members, place)
            self._protocols[baud] = tuple({*self._protocols.get(baud, ()), protocol})
            hearing.by_id.setdefault(registers["id"], []).append(first_id)
            if registers["shadow_id"] <= MAX_ID and registers["shadow_id"] != registers["id"]:
                hearing.by_shadow.setdefault(registers["shadow_id"], []).append(first_id)

    def protocols(self, baud: int) -> tuple[int, ...]:
        """Protocols of the servos that are set to a bit rate [bit/s]; none where nobody is."""
        return self._protocols.get(baud, ())

    def hearing(self, baud: int, protocol: int) -> Hearing:
        """Those who understand a packet."""
        return self._hearing[baud, protocol]
