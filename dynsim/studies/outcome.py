"""Outcome of one run of a batch: summary, or error."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dynsim.record import Record


@dataclass(frozen=True)
class RunResult:
    """Outcome of one run of a batch.

    Attributes
    ----------
    summary : numbers of the run, of a stopped one those until its stop; empty when nothing was simulated
    reason : why it failed, "" when it did not
    lost : whether its process was lost, so that another attempt may succeed
    record : if requested
    wall_s : total computing time [s]
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
