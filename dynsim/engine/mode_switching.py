"""Fixing and switching states of the robot, and the choice of the next mode ([T] IV.C.5, V.E)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dynsim.model.snake import FIXING, SWITCHING, Policy


@dataclass
class ModeSwitcher:
    """Fixing and switching states: follows requests, and picks a mode at every switching time t_k = t_0 + k dT.

    A mode that would tip (support margin not above ``least_margin``) is refused. When every candidate would tip the
    present mode stays.

    Attributes
    ----------
    policy : "fixed" ignores requests to switch; "cyclic" takes the next of ``order`` ([T]'s heuristic); "predictive"
        takes the one with the lowest cost after a simulated period.
    fixing_row, order : rows of the mode table.
    period_ticks : dT in control periods.
    margin_now : margin_now(row) -> support margin of the present posture in a mode [m].
    predict : predict(row) -> (cost after dT, smallest support margin on the way [m]).
    row : present mode.
    switches, refused : counts of changes of mode and of candidates refused.
    """

    policy: Policy
    fixing_row: int
    order: tuple[int, ...]
    period_ticks: int
    least_margin: float
    margin_now: Callable[[int], float]
    predict: Callable[[int], tuple[float, float]]
    row: int = 0
    switching: bool = False
    next_switch: int = 0
    switches: int = 0
    refused: int = 0
    _place: int = 0

    def __post_init__(self) -> None:
        self.row = self.fixing_row

    def at_tick(self, tick: int, request: int) -> int:
        """Row of the mode from this tick on; ``request`` is a row + 1, NO_REQUEST, SWITCHING or FIXING."""
        row = self.row
        if request > 0:
            row, self.switching = request - 1, False
        elif request == FIXING:
            row, self.switching = self.fixing_row, False
        elif request == SWITCHING and not self.switching and self.policy != "fixed":
            self.switching, self.next_switch, self._place = True, tick, 0
        if self.switching and tick >= self.next_switch:
            row = self._cyclic() if self.policy == "cyclic" else self._predictive()
            self.next_switch = tick + self.period_ticks
        self.switches += row != self.row
        self.row = row
        return row

    def next_event(self) -> int | None:
        """Tick of the next switching time, None in the fixing state."""
        return self.next_switch if self.switching else None

    def _cyclic(self) -> int:
        for step in range(len(self.order)):
            place = (self._place + step) % len(self.order)
            if self.margin_now(self.order[place]) > self.least_margin:
                self._place = (place + 1) % len(self.order)
                return self.order[place]
            self.refused += 1
        return self.row

    def _predictive(self) -> int:
        best, lowest = self.row, np.inf
        for row in self.order:
            cost, margin = self.predict(row)
            if not margin > self.least_margin:
                self.refused += 1
            elif cost < lowest:
                best, lowest = row, cost
        return best
