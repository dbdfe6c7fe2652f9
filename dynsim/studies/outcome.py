"""Outcome of one run of a batch: summary, or error."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dynsim.record import Record


@dataclass(frozen=True)
class RunResult:
    """How one run of many ended.

    Attributes
    ----------
    summary : numbers of the run; of one that stopped, what was simulated until then; empty when nothing was
    reason : why it failed, "" when it did not
    lost : with its process, which was ended, so that another attempt may do better
    record : where it was asked for
    wall_s : time that it took, all in all [s]
    """

    summary: dict[str, Any] = field(default_factory=dict)
    reason: str = ""
    lost: bool = False
    record: Record | None = field(default=None, repr=False)
    wall_s: float = 0.0

    @property
    def ok(self) -> bool:
        """True for a run that came to its end."""
        return not self.reason
