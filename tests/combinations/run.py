"""What is left of a scene that was run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dynsim.record import Record
from dynsim.scenario import Scenario


@dataclass(frozen=True)
class Run:
    """A scene run with a method, in one of several ways.

    Attributes
    ----------
    scenario : as a scenario file would have it, with the method
    resolved : the scenario as dynsim read it; None: it was refused while reading
    method : ``auto``, ``dopri5``, ``radau5`` or ``time_stepping``; ``m_star`` appended where that solver was asked for
    way : ``simulate``, ``pieces``, ``batch``
    record : None where there is none: it was refused, or stopped before the first sample
    error : with which it was refused or stopped
    warnings : of the record's summary
    checked : the text with which ``check`` refused it; None: it did not
    """

    scenario: Mapping[str, Any]
    resolved: Scenario | None
    method: str
    way: str
    record: Record | None
    error: Exception | None
    warnings: list[str] = field(default_factory=list)
    checked: str | None = None
