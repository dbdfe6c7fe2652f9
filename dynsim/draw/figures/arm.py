"""The set of figures of an arm, fixed or on a mobile base: of one run, or of variants over each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from matplotlib.figure import Figure

from dynsim.draw.figures import base, contacts, energy, posture, style
from dynsim.record import Record

# File name → figure, None where the record has no data for it.
FIGURES: dict[str, Callable[[Record], Figure | None]] = {
    "hand_path": energy.path,
    "tracking_error": energy.error,
    "energy": energy.energy,
    "energy_ledger": energy.ledger,
    "contact_forces": contacts.forces,
    "motors": energy.motors,
    "posture": posture.posture,
    "base": base.top_view,
    "overturning": base.overturning,
    "base_tracking": base.tracking,
}
COMPARISONS: dict[str, Callable[[Mapping[str, Record]], Figure | None]] = {
    "compare_hand_path": energy.path_comparison,
    "compare_tracking_error": energy.error_comparison,
    "compare_energy": energy.energy_comparison,
    "compare_contact_forces": contacts.forces_comparison,
    "compare_posture": posture.posture_comparison,
    "compare_tip_margin": base.margin_comparison,
}


def figures(record: Record) -> Mapping[str, Callable[[Record], Figure | None]]:
    """Makers of the figures of one run by file name; a maker gives None where the record has no data for it."""
    return FIGURES


def comparisons(records: Mapping[str, Record]) -> Mapping[str, Callable[[Mapping[str, Record]], Figure | None]]:
    """Makers of the figures of several runs by file name."""
    return COMPARISONS


def draw(record: Record, folder: Path, kind: str = "png") -> list[Path]:
    """See :func:`dynsim.draw.figures.draw`."""
    return style.save_all(FIGURES, record, folder, kind)


def draw_comparison(records: Mapping[str, Record], folder: Path, kind: str = "png") -> list[Path]:
    """See :func:`dynsim.draw.figures.draw_comparison`."""
    return style.save_all(COMPARISONS, records, folder, kind)
