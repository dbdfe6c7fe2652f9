"""What the samples of a sweep say of each number: mean, spread, and what each drawn parameter does to it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from dynsim.record.sensitivity import sensitivities, spread
from dynsim.studies.sweep_plan import Plan

if TYPE_CHECKING:
    from dynsim.studies.journal import SweepRow


def statistics(rows: Sequence[SweepRow], plan: Plan) -> list[dict[str, Any]]:
    """For each variant and place of the grid: runs, those without numbers, and of each number that all others have

    its :class:`dynsim.record.sensitivity.Spread` and, where a line fits, what one standard deviation of each drawn key
    does to it (``effect``, with the half width of its interval) and how much of the variance the line explains.
    """
    groups: dict[str, list[SweepRow]] = {}
    for row in rows:
        grid = {axis.key: row.values[axis.key] for axis in plan.grid}
        groups.setdefault(json.dumps([row.variant, grid]), []).append(row)
    entries = []
    for name, group in groups.items():
        variant, grid = json.loads(name)
        good = [row for row in group if row.status == "ok"]
        shared = [key for key in good[0].numbers if all(key in row.numbers for row in good)] if len(good) > 1 else []
        drawn = np.array([[row.values[key] for key in plan.sampled] for row in good], dtype=float)
        table = {key: np.array([row.numbers[key] for row in good], dtype=float) for key in shared}
        entries.append(
            {
                "variant": variant,
                "grid": grid,
                "runs": len(group),
                "without_numbers": len(group) - len(good),
                "numbers": {key: _of(drawn, values, plan.sampled) for key, values in table.items()},
            }
        )
    return entries


def _of(drawn: np.ndarray, values: np.ndarray, keys: Sequence[str]) -> dict[str, Any]:
    fit = sensitivities(drawn, values)
    if fit is None:
        return asdict(spread(values))
    effect = dict(zip(keys, fit.effect.tolist(), strict=True))
    half_width = dict(zip(keys, fit.half_width.tolist(), strict=True))
    return asdict(spread(values)) | {"effect": effect, "half_width": half_width, "explained": fit.explained}
