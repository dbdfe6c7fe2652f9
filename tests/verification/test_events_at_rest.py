"""Events between two instants of rest: nothing but the forces changes, so nothing else limits the steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dynsim.engine import simulate
from dynsim.scenario.reading import scenario_from_resolved

TIMES = [0.0, 0.4, 0.45, 0.5, 1.0]


def scene(kind: str, method: str) -> dict[str, Any]:
    """A link without weight, held by a stop, a wall or dry friction, whose torque lets it go for 0.1 s."""
    link: dict[str, Any] = {"axis": "y", "length_m": 0.3, "mass_kg": 0.3, "motor": {"type": "torque"}}
    torques = [1.0, 1.0, -1.0, 1.0, 1.0]
    data: dict[str, Any] = {"name": kind, "duration_s": 1.0, "contacts": {"law": "unilateral"}}
    if kind == "stop":
        link["limit_deg"] = [-90, 0]
    elif kind == "friction":
        link["friction_N_m"], torques = 1.5, [0.5, 0.5, 4.0, 0.5, 0.5]
    else:
        data["surfaces"] = {"wall": {"type": "plane", "normal": [-1, 0, 0]}}
        data["contacts"]["points"] = {"tip": {"body": "link_1", "point_m": [0, 0, 0.3], "surface": "wall"}}
    plan = {"joint_1": {"times_s": TIMES, "torques_N_m": torques}}
    return data | {
        "plant": {"type": "serial_arm", "gravity_m_s2": [0, 0, 0], "chain": [link]},
        "controller": {"type": "joint_pd", "torques": plan},
        "integrator": {"method": method},
        "record": {"rate_hz": 500},
    }


@pytest.mark.parametrize("kind", ["stop", "contact", "friction"])
def test_an_event_while_everything_rests_is_located(kind: str) -> None:
    """Explicit steps grew to 0.3 s, past the instants at which the link left and came back."""
    explicit, implicit = (simulate(scenario_from_resolved(scene(kind, method))) for method in ("dopri5", "radau5"))
    assert len(explicit.events) == len(implicit.events) > 0
    times = [[event.time for event in record.events] for record in (explicit, implicit)]
    np.testing.assert_allclose(*times, rtol=0, atol=1e-5)
    # Both to rtol 1e-6.
    np.testing.assert_allclose(explicit["q"], implicit["q"], rtol=0, atol=1e-4)
    if kind == "contact":
        assert explicit["contact_normal_force"].min() >= -1e-6
