"""Ends of links touch once by time stepping too, where spheres and the nearest point of the axis are both near."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dynsim import Record, simulate
from dynsim.scenario import scenario_from_resolved

SURFACES: dict[str, dict[str, Any]] = {
    "plane": {"type": "plane"},
    "box": {"type": "box", "center_m": [0, 0, -1], "edges_m": [20, 20, 2]},
}


def fallen(surface: str) -> Record:
    """Three links that fall on a floor at a slant, which a plane is, or the top of a wide box."""
    axes = ([0.3, 1.0, 0.2], [0.2, 1.0, -0.4], [0.1, 0.9, 0.3])
    chain = [
        {"axis": axis, "length_m": 0.2, "mass_kg": 0.3, "radius_m": 0.02, "damping_N_m_s_per_rad": 0.01}
        for axis in axes
    ]
    plant = {"type": "serial_arm", "base": {"position_m": [0, 0, 0.25]}, "chain": chain}
    plant["initial_deg"] = [80.0, 20.0, -25.0]
    return simulate(
        scenario_from_resolved(
            {
                "name": "fall",
                "duration_s": 0.6,
                "plant": plant,
                "surfaces": {"floor": SURFACES[surface]},
                "contacts": {"law": "unilateral", "candidates": "links", "friction": 0.4},
                "integrator": {"method": "time_stepping", "step_s": 5e-4},
            }
        )
    )


def test_ends_of_links_slide_on_the_top_of_a_box_as_on_a_plane() -> None:
    """A plane has the spheres at the ends alone; a box the nearest points of the axes too, which slide otherwise."""
    plane, box = fallen("plane"), fallen("box")
    assert plane.summary["friction_heat_J"] > 0.05
    assert any(event.kind == "landing" for event in plane.events)
    assert np.abs(plane["q"] - box["q"]).max() == pytest.approx(0.0, abs=1e-6)
