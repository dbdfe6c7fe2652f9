"""Turnover and residual of a record's ledger, added up from its signals as docs/physics.md defines them."""

from __future__ import annotations

import numpy as np

from combinations.observed import Observed

# Share of the turnover above which a ledger must warn.
RESIDUAL = 1e-6


def residual_floor(seen: Observed) -> float:
    """Least energy to which a residual is compared, as docs/physics.md has it [J]."""
    reach, lever, mass = {}, 0.0, 0.0
    for link in seen.bodies.robot.links:
        reach[link.name] = 0.0 if link.parent is None else reach[link.parent] + float(np.linalg.norm(link.p_PJ))
        lever += link.inertia.mass * (reach[link.name] + float(np.linalg.norm(link.inertia.com)))
        mass += link.inertia.mass
    g, record = float(np.linalg.norm(seen.bodies.gravity)), seen.record
    stores = (
        np.abs(record["energy_kinetic"]),
        np.abs(record["energy_potential"] - record["energy_potential"][0]),
        np.abs(record["energy_magnetic"]),
    )
    floor = seen.scenario.integrator.rtol * max(lever * g, *(float(store.max(initial=0.0)) for store in stores))
    # Landings are located to some 1e-10 m (docs/physics.md); ten of them.
    return max(floor, mass * g * 1e-3 * RESIDUAL) if seen.real and floor == 0.0 else floor


def turnover_and_residual(seen: Observed) -> tuple[float, float]:
    """Energy that changed hands, and the largest imbalance of the signals [J]."""
    record = seen.record
    sources = record["energy_electrical"] + record["work_constraint"]
    size = np.abs(record["energy_electrical"]) + np.abs(record["work_constraint"])
    if "work_loads" in record:
        sources = sources + record["work_loads"].sum(axis=1)
        size = size + np.abs(record["work_loads"]).sum(axis=1)
    sinks = ("heat_joule", "loss_gear", "loss_joint", "heat_friction", "loss_impact", "loss_stop", "loss_damper")
    for name in (*sinks, "energy_elastic", "loss_scheme"):
        if name in record:
            sources, size = sources - record[name], size + np.abs(record[name])
    for name in ("energy_kinetic", "energy_potential", "energy_magnetic"):
        change = record[name] - record[name][0]
        sources, size = sources - change, size + np.abs(change)
    return float(0.5 * size.max(initial=0.0)), float(np.abs(sources).max(initial=0.0))
