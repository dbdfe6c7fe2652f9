"""Measured values of [T], to be set beside simulated ones.

[T]: M. Tanaka et al., "Task-Space Control of Articulated Mobile Robots With a Soft Gripper for Operations", IEEE
Transactions on Robotics 35(1), 2019.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dynsim.record import Record

COORDINATES = ("x", "y", "z", "alpha", "beta", "gamma")


class Displacement(NamedTuple):
    """Relative displacement of the head, x, y, z [m], alpha, beta, gamma [rad]."""

    target: tuple[float, ...]
    mean: tuple[float, ...]
    deviation: tuple[float, ...]  # standard deviation of five runs


# [T] Table III, by the coordinate that is moved.
TABLE_III: dict[str, Displacement] = {
    "x": Displacement(
        (0.20, 0, 0, 0, 0, 0),
        (0.20, 0.0052, 0.0024, 0.0092, -0.0047, -0.012),
        (0.0025, 0.0015, 0.00082, 0.0061, 0.015, 0.0059),
    ),
    "y": Displacement(
        (0, 0.1, 0, 0, 0, 0),
        (-0.069, 0.066, 0.014, -0.055, -0.055, -0.075),
        (0.0036, 0.0033, 0.00071, 0.0053, 0.0047, 0.0039),
    ),
    "z": Displacement(
        (0, 0, -0.1, 0, 0, 0),
        (-0.011, 0.0040, -0.10, 0.013, -0.013, 0.0075),
        (0.0017, 0.00081, 0.00090, 0.0042, 0.0050, 0.0033),
    ),
    "alpha": Displacement(
        (0, 0, 0, np.pi / 2, 0, 0),
        (-0.054, -0.035, 0.030, 1.54, -0.060, -0.063),
        (0.0042, 0.0018, 0.0011, 0.014, 0.0051, 0.0037),
    ),
    "beta": Displacement(
        (0, 0, 0, 0, -np.pi / 6, 0),
        (0.00062, 0.0015, 0.0061, 0.019, -0.55, -0.0060),
        (0.0013, 0.0011, 0.00094, 0.0061, 0.0063, 0.0047),
    ),
    "gamma": Displacement(
        (0, 0, 0, 0, 0, np.pi / 4),
        (-0.018, 0.00032, 0.027, 0.050, -0.12, 0.79),
        (0.0020, 0.0016, 0.00057, 0.0073, 0.0070, 0.0084),
    ),
}


def displacement(record: Record) -> np.ndarray:
    """Relative displacement of the controlled point as [T] V.A takes it, (6,).

    Mean over the last second of the run minus mean over its first.
    """
    first, last = record.time <= 1.0, record.time >= record.time[-1] - 1.0
    return record["w"][last].mean(axis=0) - record["w"][first].mean(axis=0)


def table_iii(records: Mapping[str, Record]) -> list[list[str]]:
    """Rows of Table III: target, measured in [T], simulated; head line first. Only manoeuvres that were run."""
    rows = [["moved", "what", *COORDINATES]]
    for moved, published in TABLE_III.items():
        if moved in records:
            rows.append([moved, "target", *(f"{v:.4g}" for v in published.target)])
            rows.append([moved, "[T] mean", *(f"{v:.3g}" for v in published.mean)])
            rows.append([moved, "[T] standard deviation", *(f"{v:.2g}" for v in published.deviation)])
            rows.append([moved, "simulated", *(f"{v:.6f}" for v in displacement(records[moved]) + 0.0)])
    return rows
