"""What to warn of where a mobile base does what a real one could not do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynsim.model.mobile_base import MobileBase
from dynsim.record import Record
from dynsim.record.measures import TIP_OVER, least_loads, overturns_settled


def tipped(record: Record, base: MobileBase, support: NDArray[np.float64], settle: float) -> list[str]:
    """What a mobile base does that a real one could not do."""
    found = []
    load, traction = record["wheel_load"], record["traction_demand"]
    lowest = least_loads(record, support)
    late = record["tip_margin"][record.time >= settle]
    first = min((event.time for event in record.events if event.kind == TIP_OVER), default=np.inf)
    if np.isfinite(first) and not base.stop_on_overturn:
        pulled = ", ".join(
            f"{name} {low:.3g}" for name, low in zip(record.labels["wheel_load"], lowest, strict=True) if low < 0.0
        )
        least = f" (least loads [N]: {pulled})" if pulled else ""
        beyond = f"{100 * (record['tip_margin'] < 0.0).mean():.1f} % of the samples"
        if late.size and overturns_settled(record, settle) is None:
            found.append(
                f"a jolt of the start takes the tip margin below zero at t = {first:.4f} s, in {beyond}, none from "
                f"{settle:g} s on (margin at least {late.min():.3g}){least}: start with initial.equilibrium, or with a "
                "motion that begins at rest"
            )
        else:
            found.append(
                f"the base tips over at t = {first:.4f} s, with a tip margin below zero in {beyond}; the run goes on "
                f"as if it were held down{least}: plant.base.on_overturn: stop ends it there"
            )
    lifted = load.sum(axis=1) <= 0.0
    if lifted.any():
        found.append(
            f"the base is lifted: no load on its wheels and caster in {100 * lifted.mean():.1f} % of the samples, "
            f"first at t = {record.time[lifted.argmax()]:.4g} s (counts as a tip margin of -1)"
        )
    # Once it has tipped, the loads mean nothing.
    standing = record.time < first
    for name, demand in zip(record.labels["traction_demand"], traction[standing].T, strict=True):
        slips = demand > 1.0
        if slips.any():
            found.append(
                f"the {name} wheel would slip: it needs up to {np.nanmax(demand):.3g} times the traction that "
                f"plant.base.wheel_friction = {base.wheel_friction:g} gives, first at "
                f"t = {record.time[standing][slips.argmax()]:.4g} s; rolling is enforced all the same"
            )
    return found
