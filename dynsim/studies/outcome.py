"""Outcome of one run of a batch: a summary or an error."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dynsim.record import Record


@dataclass(frozen=True)
class RunResult:
    """Outcome of one run of a batch.

    Attributes
    ----------
    summary : dict
        Summary of the run, up to the stop if it stopped early; empty if nothing was simulated.
    reason : str
        Reason for the failure, "" for a successful run.
    lost : bool
        True if its worker process was lost; another attempt may succeed.
    record : Record or None
        Record of the run, if requested.
    wall_s : float
        Total computing time of the run [s].
    """

    summary: dict[str, Any] = field(default_factory=dict)
    reason: str = ""
    lost: bool = False
    record: Record | None = field(default=None, repr=False)
    wall_s: float = 0.0

    @property
    def ok(self) -> bool:
        """True if the run completed."""
        return not self.reason
