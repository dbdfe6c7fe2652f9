"""Figures of a plan, and the page of its best beside the unbraced arm."""

from __future__ import annotations

from pathlib import Path

from dynsim.planner.answer import BracePlan


def draw_plan(plan: BracePlan, folder: Path, kind: str) -> None:
    """Figures into ``figures/``, and ``view.html``."""
