"""Planner with solids: gradients of distances, self-contact that steers the search, collision shapes, objects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import yaml
from support.messages import raises

import dynsim
from dynsim.compile.touching import touch
from dynsim.errors import ModelError
from dynsim.planner.problem import LINK_CLEARANCE, Options, Task, task
from dynsim.planner.search import Search
from dynsim.planner.verify import Tolerances
from dynsim.scenario import build

SELF = {"contacts.between": [{"bodies": "self"}]}
# Many short links that coil up without limits.
LONG = {
    "plant.link.radius_m": 0.05,
    "plant.link.length_m": 0.2,
    "plant.chain": [{"axis": "z", "length_m": 0.0}, {"axis": "y", "count": 14}],
    "plant.initial_deg": [0, 45, 90, -90, 45, 45, -90, 45, -45, 45, 0, 0, 0, 0, 0],
}
BOX = {"mass_kg": 1, "size_m": [0.3, 0.3, 0.1], "position_m": [0.75, 0.8, 0.05]}


def arm(**changes: Any) -> dynsim.Scenario:
    return dynsim.load_scenario("pressing", "plain", {key.replace("__", "."): value for key, value in changes.items()})


def search(scenario: dynsim.Scenario, **options: Any) -> tuple[Search, dict[int, list]]:
    searched = Search(task(scenario, Options(**{"count": (0, 1), "starts": 1, "budget_s": 0.0} | options)))
    return searched, searched.run()


def least(planned: Task, q: np.ndarray) -> float:
    return float(planned.pair_gaps(q).min())


def test_distances_of_solids_and_their_rates(tmp_path):
    """By the public model, and by differences: capsules of links against each other and against a box."""
    chain = [{"axis": "z", "length_m": 0.0}, *({"axis": axis} for axis in "yyxyyxyyy")]
    between = [{"bodies": "self"}, {"bodies": ["links", "box"]}]
    keys = {"contacts.between": between, "objects.box": BOX, "plant.chain": chain, "plant.link.radius_m": 0.05}
    scenario = arm(**keys)
    planned, described = task(scenario, Options(count=(0, 1))), build.robot(scenario)
    stepped = arm(**keys, **{"integrator.method": "time_stepping"})
    model, contacts = dynsim.Model(described), [c for c in build.contacts(stepped) if c.solid is not None]
    names = [frozenset((c.body, c.surface.carrier)) for c in contacts]
    rng, problem, checked = np.random.default_rng(3), planned.problem((), 1), 0
    none, first = np.zeros((1, 0)), len(planned.clear)
    for _ in range(10):
        q = rng.normal(size=planned.arm.n)
        problem.evaluate(q[None], none)
        gap, rate = problem.work.gap[0].copy(), problem.work.gap_rate[0].copy()
        whole = described.initial.copy()
        whole[list(planned.arm.columns)] = q
        for m, pair in enumerate(planned.arm.pairs):
            if np.isinf(gap[first + m]):
                continue
            own = min(
                touch(model, c, whole).gap for c, name in zip(contacts, names, strict=True) if name == frozenset(pair)
            )
            assert gap[first + m] == pytest.approx(own, abs=1e-12)
            if own == pytest.approx(-2.0 * described.links[1].radius, abs=1e-9):
                continue  # axes that cross are pushed apart along one of them
            for j in range(planned.arm.n):
                ends = []
                for step in (1e-6, -1e-6):
                    moved = q.copy()
                    moved[j] += step
                    ends.append(planned.pair_gaps(moved[None])[0, m])
                assert rate[first + m, j] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-5)
            checked += 1
    assert checked >= 40


def test_self_contact_steers_the_search():
    """Links with a radius keep clear of each other, as with `between`; links that overlap at the start do not."""
    searched, planned = search(arm(**LONG), count=(0, 0))
    assert least(searched.task, planned[0][0].dense.q) > LINK_CLEARANCE - 1e-6
    entire = task(arm(**LONG, **SELF), Options(count=(0, 0)))
    assert set(searched.task.arm.pairs) <= set(entire.arm.pairs)
    assert len(searched.task.arm.pairs) > 50


@pytest.mark.long
def test_collision_shapes_keep_links_apart(tmp_path):
    """The same arm as a file: its shapes count without `between`, against each other and against the floor."""
    data = dict(arm(**LONG).resolved)
    (tmp_path / "arm.urdf").write_text(dynsim.build_model(arm(**LONG)).to_urdf())
    data["plant"] = {"type": "urdf_arm", "file": "arm.urdf", "motor": {"type": "wang_minami"}}
    data["contacts"] = {"law": "unilateral", "friction": 0.1}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(data | {"variants": {}}))
    searched, planned = search(dynsim.load_scenario(tmp_path / "arm.yaml"), radius_m=0.05)
    assert searched.task.arm.pairs
    model, arm_of = searched.task.arm.model, searched.task.arm
    for count in (0, 1):
        q = planned[count][0].dense.q
        assert least(searched.task, q) > LINK_CLEARANCE - 1e-6
        for link in model.robot.links[2:]:
            for point in (np.zeros(3), np.array([0.0, 0.0, 0.2])):
                heights = [model.point_position(link.name, point, row)[2] for row in arm_of.coordinates(q)]
                assert min(heights) > 0.05 - 1e-6


def test_shapes_that_overlap_at_the_start_do_not_count():
    scenario = dynsim.load_scenario("six_axis_arm", None, {"plant.initial_deg.elbow_pitch": 149})
    joints = ["base_yaw", "shoulder_pitch", "elbow_pitch", "forearm_roll", "wrist_pitch", "tool_roll"]
    keys = {"controller.hand.joints": joints, "contacts.law": "unilateral"}
    all_pairs = task(dynsim.load_scenario("six_axis_arm", None, keys), Options(count=(0, 0)))
    coiled = task(
        dynsim.load_scenario("six_axis_arm", None, keys | {"plant.initial_deg.elbow_pitch": 149,
                             "plant.initial_deg.wrist_pitch": 119}), Options(count=(0, 0)))  # fmt: skip
    assert scenario.name
    assert set(coiled.arm.pairs) < set(all_pairs.arm.pairs)
    # Ten pairs of links, and the links except the first against the pedestal.
    assert len(set(all_pairs.arm.pairs)) == 15
    assert {pair[0] for pair in all_pairs.arm.pairs if pair[1] == "base"} == set(all_pairs.arm.model.robot.bodies[1:])


def test_objects_are_obstacles():
    """An arm that rests on the floor where a box is now; the plan keeps clear, and its runs confirm it."""
    _, without = search(arm(), count=(1, 1))
    scenario = arm(**{"objects.box": BOX})
    made = task(scenario, Options(count=(1, 1)))
    assert least(made, without[1][0].dense.q) < 0.0
    with pytest.warns(UserWarning, match="objects.box"):
        plan = dynsim.plan_braces(
            scenario,
            count=(1, 1),
            starts=1,
            budget_s=0.0,
            tolerances=Tolerances(friction=(1.0,), shift_m=(0.0,)),
            jobs=1,
        )
    (size,) = plan.sizes
    assert size.planned is not None
    assert least(made, size.planned.dense.q) > made.options.clearance_m - 1e-6
    assert size.verdict is not None
    assert size.verdict.survives, size.reason
    record = plan.record(1)
    assert least(made, record["q"]) > 0.0
    assert "objects" not in plan.scenario(1).resolved


def test_plans_omit_all_parts_of_objects_and_report_no_pair_as_a_brace():
    tie = {"type": "linear", "axis": [0, 0, 1], "stiffness_N_per_m": 10.0, "other": "box"}
    push = {"type": "samples", "body": "box", "times_s": [0, 1], "force_N": [[1, 0, 0], [1, 0, 0]]}
    keys = {
        "objects.box": BOX,
        "surfaces.lid": {"type": "plane", "on": "box", "point_m": [0, 0, 0.05]},
        "loads.push": push | {"interpolation": "linear"},
        "ties": {"tie": tie | {"body": "link_3"}},
        "integrator": {"method": "time_stepping"},
        **SELF,
    }
    exact = Tolerances(friction=(1.0,), shift_m=(0.0,))
    with pytest.warns(UserWarning, match=r"objects\.box: not in plan\.yaml") as caught:
        plan = dynsim.plan_braces(arm(**keys), count=(0, 0), starts=1, budget_s=0.0, tolerances=exact, jobs=1)
    assert not any("loads" in str(warning.message) for warning in caught)
    resolved = plan.scenario(0).resolved
    assert "box" not in str(resolved)
    assert "floor" in resolved["surfaces"]
    (size,) = plan.sizes
    assert size.nominal is not None
    # The record has pairs of links, which are not braces.
    assert len(plan.record(0).summary["contacts"]) > 10
    assert size.nominal.closed_fraction == {}


def test_pairs_without_a_solid_are_refused_with_their_key():
    with raises(ModelError, "contacts.between", "link_30"):
        task(arm(**{"contacts.between": [{"bodies": ["link_2", "link_30"]}]}), Options())
