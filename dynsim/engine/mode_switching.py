"""Mode changes of the snake: which wheel pairs are lifted next, and when ([T] IV.C.5, V.E)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from dynsim.snake.description import FIXING, SWITCHING, ModeTable, Policy


class Refusal(NamedTuple):
    """A mode that was requested, or was a candidate, and in which the robot would tip."""

    tick: int
    row: int
    margin: float  # its support margin [m]
    taken: bool  # all the same, because the present mode would tip more


@dataclass
class ModeSwitcher:
    """Fixing and switching states: follows requests, and picks a mode at every switching time t_k = t_0 + k dT.

    Every change of mode is tested by simulating the mode for one period with the present command. It tips when its
    support margin is anywhere not above ``least_margin``; such a mode is not taken and the present one stays. Only
    if the present mode tips as well, the mode of largest support margin is taken; the fixing mode is a candidate too.

    Attributes
    ----------
    policy : "fixed" ignores requests to switch; "cyclic" takes the next of ``order`` ([T]'s heuristic); "predictive"
        takes the one with the lowest cost after a simulated period.
    modes : table of the modes; ``fixing_row``, ``order`` and ``row`` are rows of it.
    period_ticks : dT in control periods.
    predict : predict(row) -> (cost after dT, smallest support margin on the way [m]).
    row : present mode.
    switches : changes of mode.
    refusals : modes that would tip, in the order they were met.
    """

    policy: Policy
    modes: ModeTable
    fixing_row: int
    order: tuple[int, ...]
    period_ticks: int
    least_margin: float
    predict: Callable[[int], tuple[float, float]]
    row: int = 0
    switching: bool = False
    next_switch: int = 0
    switches: int = 0
    refusals: list[Refusal] = field(default_factory=list)
    _place: int = 0

    def __post_init__(self) -> None:
        self.row = self.fixing_row

    def at_tick(self, tick: int, request: int) -> int:
        """Row of the mode from this tick on; ``request`` is a mode number, NO_REQUEST, SWITCHING or FIXING.

        A request for one mode ends the switching state, whether the mode is taken or refused.
        """
        row = self.row
        if request > 0 or request == FIXING:
            row = self.fixing_row if request == FIXING else self.modes.row(request, "mode request")
            row, self.switching = self._asked(tick, row), False
        elif request == SWITCHING and not self.switching and self.policy != "fixed":
            self.switching, self.next_switch, self._place = True, tick, 0
        if self.switching and tick >= self.next_switch:
            row = self._cyclic(tick) if self.policy == "cyclic" else self._predictive(tick)
            self.next_switch = tick + self.period_ticks
        self.switches += row != self.row
        self.row = row
        return row

    def next_event(self) -> int | None:
        """Tick of the next switching time, None in the fixing state."""
        return self.next_switch if self.switching else None

    def _asked(self, tick: int, row: int) -> int:
        if row == self.row or (margin := self.predict(row)[1]) > self.least_margin:
            return row
        return self._least_tipping(tick, {row: margin})

    def _cyclic(self, tick: int) -> int:
        tipping: dict[int, float] = {}
        for step in range(len(self.order)):
            position = (self._place + step) % len(self.order)
            row = self.order[position]
            margin = self.predict(row)[1]
            if margin > self.least_margin:
                self._refuse(tick, tipping)
                self._place = (position + 1) % len(self.order)
                return row
            tipping[row] = margin
        return self._least_tipping(tick, tipping)

    def _predictive(self, tick: int) -> int:
        predictions = {row: self.predict(row) for row in self.order}
        tipping = {row: margin for row, (_, margin) in predictions.items() if not margin > self.least_margin}
        standing = {row: cost for row, (cost, _) in predictions.items() if row not in tipping}
        if standing:
            self._refuse(tick, tipping)
            return min(standing, key=lambda row: standing[row])
        return self._least_tipping(tick, tipping)

    def _least_tipping(self, tick: int, tipping: dict[int, float]) -> int:
        """Every candidate would tip: the present mode if it stands, else the one of all that stands best.

        The fixing mode is among those: it need not be in the order.
        """
        rows = (self.row, self.fixing_row, *tipping)
        margins = {row: tipping[row] if row in tipping else self.predict(row)[1] for row in rows}
        best = max(margins, key=lambda row: margins[row])
        taken = self.row if margins[self.row] > self.least_margin else best
        self._refuse(tick, tipping, taken)
        return taken

    def _refuse(self, tick: int, tipping: dict[int, float], taken: int = -1) -> None:
        self.refusals += [Refusal(tick, row, margin, row == taken) for row, margin in tipping.items()]
