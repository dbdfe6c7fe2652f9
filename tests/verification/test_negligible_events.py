"""Slips and openings too small to count: pairs of events are omitted from records and from the counts in summaries."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import dynsim
from dynsim.engine.ring import NEGLIGIBLE

BLOCK = """\
name: block
duration_s: 1.2
plant:
  type: serial_arm
  chain:
    - {kind: prismatic, axis: x, length_m: 0.1, mass_kg: 0.1}
    - {kind: prismatic, axis: z, length_m: 0.1, mass_kg: 1, radius_m: 0.02, initial_m: 0}
  base: {position_m: [0, 0, -0.1]}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 0.5, points: {foot: {body: link_2, point_m: [0, 0, 0]}}}
loads:
  pull: {type: samples, body: link_2, times_s: TIMES, force_N: FORCES, interpolation: linear}
record: {rate_hz: 2000}
metrics: {settle_s: 0}
"""


def pulled(folder: Path, forces: list[list[float]], times: list[float]) -> dynsim.Record:
    """Record of a block on the floor that is pulled."""
    file = folder / "block.yaml"
    file.write_text(BLOCK.replace("TIMES", str(times)).replace("FORCES", str(forces)), encoding="utf-8")
    return dynsim.simulate(dynsim.load_scenario(file))


@pytest.mark.parametrize(("excess", "counted"), [(1e-4, False), (0.5, True)])
def test_slips_of_less_than_a_micrometre_do_not_count(excess: float, counted: bool, tmp_path: Path) -> None:
    """A pull exceeds the limit of friction for 0.2 s; the block slides about excess · 0.01 s²/1.1 kg."""
    limit = 0.5 * 1.0 * 9.81
    peak = limit + excess
    record = pulled(tmp_path, [[0, 0, 0], [peak, 0, 0], [0, 0, 0], [0, 0, 0]], [0.0, 0.4, 0.8, 1.2])
    contact, kinds = record.summary["contacts"][0], Counter(event.kind for event in record.events)
    slid = record["contact_slip_distance"][-1, 0]
    assert (slid > NEGLIGIBLE) == counted
    assert slid > 0.0
    assert contact["slip_distance_m"] == slid
    assert contact["slip_starts"] == kinds["slip_start"] == kinds["slip_stop"] == int(counted)


@pytest.mark.parametrize(("excess", "counted"), [(0.05, False), (1.0, True)])
def test_openings_of_less_than_a_micrometre_do_not_count(excess: float, counted: bool, tmp_path: Path) -> None:
    """A pull upwards exceeds the weight of 1 kg."""
    peak = 9.81 + excess
    record = pulled(tmp_path, [[0, 0, 0], [0, 0, peak], [0, 0, 0], [0, 0, 0]], [0.0, 0.4, 0.8, 1.2])
    contact, kinds = record.summary["contacts"][0], Counter(event.kind for event in record.events)
    assert record["contact_gap"].max() > 0.0
    assert (record["contact_gap"].max() > NEGLIGIBLE) == counted
    assert contact["lift_offs"] == contact["landings"] == kinds["lift_off"] == kinds["landing"] == int(counted)


def test_wheels_of_a_pushing_snake_do_not_slip_by_rounding() -> None:
    """Wheels at the limit of friction slipped at 1e-11 m/s for a tick; each slip that counts moves a wheel."""
    record = dynsim.simulate(dynsim.load_scenario("snake_push", variant="i_z", overrides={"duration_s": 4.0}))
    wheels = {name: k for k, name in enumerate(record.labels["contact_gap"])}
    slips = [event for event in record.events if event.kind == "slip_start" and event.name in wheels]
    counts = {contact["name"]: contact["slip_starts"] for contact in record.summary["contacts"]}
    assert Counter(event.name for event in slips) == {name: n for name, n in counts.items() if n}
    distance = record["contact_slip_distance"]
    for slip in slips:
        following = [event for event in record.events if event.name == slip.name and event.time > slip.time][:1]
        begin, end = np.searchsorted(record.time, [slip.time, following[0].time if following else np.inf])
        if end < len(record) and following[0].kind == "slip_stop":
            assert np.ptp(distance[max(begin - 1, 0) : end + 1, wheels[slip.name]]) >= NEGLIGIBLE
