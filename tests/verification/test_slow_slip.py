"""Slip that is about to stop, and slip that nothing holds: steps of their own length, and the right end."""

import numpy as np
import pytest

from dynsim import simulate
from dynsim.record import Record
from dynsim.scenario import load_scenario


def run(name: str = "brace_on_cylinder", **changes: object) -> Record:
    return simulate(load_scenario(name, None, {key.replace("__", "."): value for key, value in changes.items()}))


def slips(record: Record) -> list[tuple[str, float]]:
    return [(event.kind, event.time) for event in record.events if event.kind.startswith("slip")]


def test_fixed_steps_stop_where_controlled_ones_do() -> None:
    """In steps of 1 ms friction turned slow slip from side to side, which then never stopped."""
    fixed, controlled = run(integrator__method="rk4"), run(integrator__method="rk43")
    found, wanted = slips(fixed), slips(controlled)
    assert [kind for kind, _ in found] == [kind for kind, _ in wanted] == ["slip_start", "slip_stop"] * 2
    # Both are first in what the other does to its circuits in the first milliseconds: 4e-5 s apart at most.
    assert [time for _, time in found] == pytest.approx([time for _, time in wanted], abs=2e-4)
    fractions = [record.summary["contacts"][0]["sticking_fraction"] for record in (fixed, controlled)]
    assert fractions[0] == pytest.approx(fractions[1], abs=1e-4)


def test_what_was_passed_over_shortens_no_later_steps() -> None:
    """4 s in steps of 1 ms: some hundred more where it slips slowly. It was 758 000, as no step became long again."""
    record = run(integrator__method="rk4")
    assert 4000 <= record.summary["steps"] <= 6000


@pytest.mark.parametrize("method", ["rk43", "radau5", "rk4"])
def test_without_kinetic_friction_slip_begins_along_its_acceleration(method: str) -> None:
    """Static friction gives way to none at all. It was a division by the friction force."""
    none = run(integrator__method=method, contacts__friction=0.0)
    little = run(integrator__method=method, contacts__friction=1e-9)
    assert np.isfinite(none["q"]).all()
    assert none.time[-1] == little.time[-1] == 4.0
    # A force of 1e-9 of 8 N, upon joints that motors hold by 300 V/rad; times of events add their own.
    assert none["q"] == pytest.approx(little["q"], abs=2e-7)
    assert none.summary["contacts"][0]["slip_starts"] == little.summary["contacts"][0]["slip_starts"] > 0
