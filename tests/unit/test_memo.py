"""Memoised results of sweeps equal freshly computed ones."""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import dynsim
from dynsim.scenario import read_scenario
from dynsim.studies.batch import BatchWork
from dynsim.studies.sweep import numbers
from dynsim.studies.sweep_plan import Axis, Plan
from dynsim.system.memo import KEPT, Memo, recall, remembering

ELBOWS = read_scenario("elbow_comparison")


def test_results_are_known_by_the_bits_of_their_inputs():
    memo, made = Memo(), itertools.count()

    def of(*inputs: Any) -> int:
        return memo.recall("count", lambda: next(made), *inputs)

    array = np.array([1.0, 0.0])
    first = of(array, [1.0, {"a": (2, None)}])
    assert of(array.copy(), [1.0, {"a": (2, None)}]) == first
    others = [
        (-array, [1.0, {"a": (2, None)}]),
        (array * -0.0, []),
        (array * 0.0, []),
        (array.astype(np.float32), []),
        (array[None], []),
        (1,),
        (1.0,),
        (True,),
        ("1",),
    ]
    assert len({of(*inputs) for inputs in others}) == len(others)
    # Of what cannot be told from its bits only the same object is the same.
    thing, other = object(), object()
    assert of(thing) == of(thing) != of(other)


def test_only_the_last_results_are_kept_and_no_errors():
    memo, made = Memo(), []
    for k in [*range(KEPT + 1), 0, KEPT]:
        memo.recall("k", lambda k=k: made.append(k), k)
    assert made == [*range(KEPT + 1), 0]
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            memo.recall("broken", lambda: 1 / 0)


def test_a_memo_lasts_as_long_as_its_context_and_the_outer_one_is_shared():
    made = itertools.count()

    def of(key: str) -> int:
        return recall("count", lambda: next(made), key)

    assert of("a") != of("a")
    with remembering():
        first = of("a")
        with remembering():
            assert of("a") == first
        with remembering(Memo()):
            assert of("a") != first
        assert of("a") == first
    assert of("a") != first


def outcome(run: Callable[[], Any]) -> tuple[str, Any]:
    """What is said of it, "" if it ends well, and what it gives."""
    try:
        return "", run()
    except dynsim.DynsimError as error:
        return str(error), None


GRIDS = [
    ("two_elbows", {}, ["contacts.friction=0,0.3,0.05"]),
    ("elbow_4", {"duration_s": 3}, ["contacts.points.elbow_4.friction=0.1,0.2", "metrics.settle_s=0.1,0.05"]),
    ("no_elbow", {"duration_s": 2.5}, ["plant.link.motor.voltage_limit_V=2,4"]),
    ("two_elbows", {}, ["plant.link.mass_kg=0.1,0.2", "controller.hand.path.radius_m=0.1,0.2"]),
    (
        "two_elbows",
        {},
        ["plant.initial_deg.2=90,91", "contacts.friction=0.1,-1", "surfaces.floor.point_m=[0,0,0],[0,0,1]"],
    ),
    (
        "two_elbows",
        {"controller.brace": {"elbow_4": 2.0, "elbow_7": 2.0}},
        ["contacts.friction=0,0.4", "controller.min_N=0.1,0.2"],
    ),
]


@pytest.mark.parametrize(("variant", "overrides", "grid"), GRIDS)
def test_runs_that_share_are_those_that_do_not(variant: str, overrides: dict[str, Any], grid: list[str]):
    fixed = {"integrator.method": "radau5", "duration_s": 0.3, "metrics.settle_s": 0.1} | overrides
    plan = Plan(ELBOWS, (variant,), fixed, tuple(map(Axis.parse, grid)))
    points = list(plan.points())
    work = BatchWork(plan.scenario, "none")
    # Twice, the second time from the end: whatever was before.
    for point in points + points[::-1]:
        result = work(point, None)
        scenario_of = partial(ELBOWS.load, variant, fixed | dict(point.values))
        reason, summary = outcome(lambda of=scenario_of: dynsim.simulate(of()).summary)
        assert result.reason == " ".join(reason.split())
        if summary is not None:
            assert numbers(result.summary) == numbers(summary)
            assert result.summary["warnings"] == summary["warnings"]


def test_configurations_are_known_by_their_values_and_by_what_was_set():
    memo, made = Memo(), itertools.count()

    def of(section: str, **overrides: Any) -> int:
        config = getattr(ELBOWS.load("two_elbows", overrides).config, section)
        return memo.recall("count", lambda: next(made), config)

    first = of("plant")
    assert of("plant", **{"integrator.rtol": 1e-7}) == first
    assert of("plant", **{"plant.chain.0.mass_kg": 0.2}) != first
    # A key that is set to its default may be an error where one that is not set is none.
    default = type(ELBOWS.load().config.record).model_fields["rate_hz"].default
    assert of("record", **{"record.rate_hz": default}) != of("record")
