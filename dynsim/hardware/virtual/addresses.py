"""Who understands what is on the line: servos sorted by bit rate, protocol and ID, as they are set now."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

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
    members : list of int
        Their places in the order of the line.
    """

    by_id: dict[int, list[int]] = field(default_factory=dict)
    by_shadow: dict[int, list[int]] = field(default_factory=dict)
    members: list[int] = field(default_factory=list)


class Addresses:
    """Sorts servos; :meth:`sort` again when one of their settings has changed."""

    def __init__(self, servos: Mapping[int, ServoRegisters]) -> None:
        self._servos = servos
        self.sort()

    def sort(self) -> None:
        """Take over what the registers say now."""
        self._hearing: dict[tuple[int, int], Hearing] = {}
        for place, (first_id, registers) in enumerate(self._servos.items()):
            hearing = self._hearing.setdefault((registers.baud, registers["protocol"]), Hearing())
            hearing.members.append(place)
            hearing.by_id.setdefault(registers["id"], []).append(first_id)
            if registers["shadow_id"] <= MAX_ID and registers["shadow_id"] != registers["id"]:
                hearing.by_shadow.setdefault(registers["shadow_id"], []).append(first_id)

    def protocols(self, baud: int) -> list[int]:
        """Protocols of the servos that are set to a bit rate [bit/s]; none where nobody is."""
        return [protocol for rate, protocol in self._hearing if rate == baud]

    def hearing(self, baud: int, protocol: int) -> Hearing:
        """Those who understand a packet."""
        return self._hearing[baud, protocol]
