"""Figures of an arm, fixed or on a mobile base: one run, or overlays of variants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from matplotlib.figure import Figure

from dynsim.draw.figures import base, contacts, energy, posture, style
from dynsim.record import Record

# Drawing functions by file name; they return None if the record has no data.
FIGURES: dict[str, Callable[[Record], Figure | None]] = {
    "hand_path": energy.path,
    "tracking_error": energy.error,
    "energy": energy.energy,
    "energy_ledger": energy.ledger,
    "contact_forces": contacts.forces,
    "motors": energy.motors,
    "torques": energy.torques,
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
    """Return the drawing functions of one run by file name; they return None if the record has no data."""
    return FIGURES


def comparisons(records: Mapping[str, Record]) -> Mapping[str, Callable[[Mapping[str, Record]], Figure | None]]:
    """Return the drawing functions of several runs by file name."""
    return COMPARISONS


def draw(record: Record, folder: Path, kind: str = "png") -> list[Path]:
    """Draw all figures, see :func:`dynsim.draw.figures.draw`."""
    return style.save_all(FIGURES, record, folder, kind)


def draw_comparison(records: Mapping[str, Record], folder: Path, kind: str = "png") -> list[Path]:
    """Draw all comparisons, see :func:`dynsim.draw.figures.draw_comparison`."""
    return style.save_all(COMPARISONS, records, folder, kind)
