"""Requirements on plans of braces: closed forms of sag, ratings and mass errors, sag in simulated runs, refusals."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from studies.planner_scenes import scene
from support.messages import mentions, raises

import dynsim
from dynsim.cli.plan import _ended
from dynsim.errors import ModelError, ScenarioError
from dynsim.planner import answer, planned_scenario, vary
from dynsim.planner.answer import BracePlan, Searched, answered, plan_with, searched, silent
from dynsim.planner.dense import Dense
from dynsim.planner.problem import BraceSchedule, Options, Task, task
from dynsim.planner.requirements import displaced
from dynsim.planner.search import Planned
from dynsim.planner.vary import vary_plans
from dynsim.planner.verify import Tolerances, Verification
from dynsim.scenario import build, read_scenario, to_yaml
from dynsim.scenario.reading import scenario_from_resolved
from dynsim.studies.sweep_plan import Axis, Plan

G, LENGTH, MASS, PAYLOAD = 9.81, 0.8, 2.0, 0.5
MOTOR = {
    "type": "dc",
    "torque_constant_N_m_per_A": 0.2,
    "resistance_ohm": 1.0,
    "inductance_H": 1e-3,
    "rotor_inertia_kg_m2": 1e-4,
    "gear_ratio": 10,
    "nominal_torque_N_m": 20.0,
}
# Stiffness K_m k_p/R of a joint with k_p = 500 V/rad [N m/rad].
STIFFNESS = 0.2 * 10 * 500.0


def horizontal(links: int = 1, **sections: Any) -> dict[str, Any]:
    """Horizontal links with a payload at the hand, which stays where it is, over a floor."""
    hand = [links * LENGTH, 0.0, 0.0]
    joints = [f"joint_{k + 1}" for k in range(links)]
    chain = [{"axis": "y", "length_m": LENGTH, "mass_kg": MASS, "radius_m": 0.01, "motor": MOTOR} for _ in joints]
    return {
        "name": "horizontal",
        "duration_s": 2.0,
        "plant": {"type": "serial_arm", "chain": chain, "initial_deg": [90.0] + [0.0] * (links - 1)},
        "controller": {
            "type": "joint_pd",
            "hand": {
                "joints": joints,
                "path": {"type": "waypoints", "times_s": [0.0, 2.0], "points_m": [hand, hand]},
            },
        },
        "loads": {"tool": {"type": "payload", "body": joints[-1].replace("joint", "link"), "point_m": [0, 0, LENGTH],
                           "mass_kg": PAYLOAD}},
        "surfaces": {"floor": {"type": "plane", "point_m": [0.0, 0.0, -1.0]}},
        "contacts": {"law": "unilateral"},
        **sections,
    }  # fmt: skip


def unbraced(**requirements: Any) -> BracePlan:
    """Verified plan of one horizontal link without braces."""
    scenario = scenario_from_resolved(horizontal(requirements=requirements))
    return dynsim.plan_braces(scenario, count=(0, 0), starts=1, budget_s=0.0)


def held(problem: Task, force: float) -> Dense:
    """References that stay in the initial posture, with braces that press with a force."""
    times, braces = np.linspace(0.0, 2.0, 3), len(problem.candidates)
    q = np.tile(problem.arm.model.robot.initial, (3, 1))
    return Dense(
        times,
        q,
        True,
        times,
        np.zeros_like(q),
        np.full((3, braces), force),
        1.0,
        0.0,
        None,
        BraceSchedule.of(problem.candidates),
    )


def test_sag_of_one_link_and_its_gear_is_a_closed_form() -> None:
    """F L²/K for the gains, and in series for the gear; a horizontal link adds no stiffness. Rounding: 1e-9."""
    force, gear = -30.0, 4000.0
    for stiffness, keys in (
        (STIFFNESS, {}),
        (1.0 / (1.0 / STIFFNESS + 1.0 / gear), {"gear_stiffness_N_m_per_rad": gear}),
    ):
        plan = unbraced(hand_sag_m=0.1, hand_force_N=[0.0, 0.0, force], **keys)
        (sag,) = plan.size(0).requirements
        assert sag.value == pytest.approx(-force * LENGTH**2 / stiffness, rel=1e-9)
        assert sag.margin == pytest.approx(1.0 - sag.value / 0.1, abs=1e-12)
        assert plan.table[0]["hand_sag_m"] == sag.value


@pytest.mark.parametrize("force", [-30.0, 5.0, 60.0])
def test_a_brace_carries_the_hand_until_it_lifts_off(force: float) -> None:
    """The elbow of two horizontal links is braced with f: it stays, or lifts off if F 2 L > f L, by a closed form."""
    f = 40.0
    data = horizontal(2, surfaces={"floor": {"type": "plane"}})
    problem = task(scenario_from_resolved(data), Options(("link_2",), count=(1, 1)))
    dense = held(problem, f)
    (x, _, z) = displaced(problem, problem.candidates, dense, np.full(2, STIFFNESS), np.array([0.0, 0.0, force]))[1]
    stays = force * LENGTH**2 / STIFFNESS
    lifted = (force * 5.0 * LENGTH**2 - f * 2.0 * LENGTH**2) / STIFFNESS
    assert z == pytest.approx(stays if 2.0 * force <= f else lifted, rel=1e-9)
    assert x == pytest.approx(0.0, abs=1e-12)


def pushed(plan: BracePlan, count: int, k_p: float, force: np.ndarray) -> np.ndarray:
    """Displacement of the hand in a simulated plan by an unplanned force, (T, 3) at the waypoints [m]."""
    problem, size = plan.task, plan.size(count)
    body, point = problem.arm.model.robot.hand
    push = {"type": "constant", "body": body, "point_m": point.tolist(), "force_N": force.tolist(), "frame": "world"}
    loads = problem.scenario.resolved.get("loads", {})
    hands = []
    for more in (loads, {**loads, "push": push}):
        sections = {"loads": more, "integrator": {"method": planned_scenario.method(problem)}}
        record = dynsim.simulate(planned_scenario.scenario(problem, size.braces, size.dense, k_p, more=sections))
        times = record.time
        hands.append(np.array([np.interp(size.dense.times, times, column) for column in record["hand_position"].T]).T)
    return np.asarray(hands[1] - hands[0])


def compared(plan: BracePlan, count: int, k_p: float, force: list[float]) -> tuple[float, float]:
    """Largest difference of the displacements in run and formula after the first second, and largest displacement."""
    size, pull = plan.size(count), np.array(force)
    joints = planned_scenario.stiffness(plan.task, size.braces, size.dense, k_p)
    expected = displaced(plan.task, size.braces, size.dense, joints, pull)
    late = size.dense.times > 1.0
    difference = np.linalg.norm(pushed(plan, count, k_p, pull) - expected, axis=1)[late].max()
    return float(difference), float(np.linalg.norm(expected[late], axis=1).max())


def plan_of(data: dict[str, Any], count: int) -> BracePlan:
    return dynsim.plan_braces(scenario_from_resolved(data), count=(count, count), starts=2, budget_s=0.0, verify=False)


def without_friction(seed: int) -> dict[str, Any]:
    data = scene(seed)
    data["contacts"]["friction"] = 0.0
    return data


def test_sag_agrees_with_a_run_with_the_force() -> None:
    """To second order in the displacement over the shortest link of 0.2 m, and to the lag of the damping.

    The lag is (k_d/k_p) ω = 0.04 s · 2π/10 s = 2.5 % of the change of the displacement along the path, which is at most
    a tenth of the displacement.
    """
    plan = plan_of(without_friction(0), 1)
    for force in ([0.0, 0.0, -0.3], [0.0, 0.3, 0.0]):
        difference, displacement = compared(plan, 1, 500.0, force)
        assert difference < (displacement / 0.2 + 0.0025) * displacement


@pytest.mark.long
def test_sag_agrees_with_a_run_in_which_a_brace_lifts_off() -> None:
    """3 N up unload a brace; the displacement is 3 mm, so to second order 2 % (link of 0.2 m), and the lag as above."""
    plan = plan_of(without_friction(1), 2)
    assert plan.size(2).dense.forces.min() < 5.0
    difference, displacement = compared(plan, 2, 500.0, [0.0, 0.0, 3.0])
    assert difference < (2.0 * displacement / 0.2 + 0.0025) * displacement


def oriented() -> dict[str, Any]:
    data = without_friction(3)
    plan = plan_of(data, 1)
    R, _ = plan.task.arm.model.body_pose(
        *plan.task.arm.model.robot.hand[:1], plan.task.arm.coordinates(plan.size(1).dense.q[:1])[0]
    )
    from dynsim.record.urdf_text import roll_pitch_yaw

    data["controller"]["hand"]["orientation"] = {"rpy_deg": np.rad2deg(roll_pitch_yaw(R)).tolist()}
    return data


def urdf() -> dict[str, Any]:
    data = dynsim.load_scenario("six_axis_arm").resolved
    start, end = [0.768, 0.0, 0.548], [0.75, 0.1, 0.55]
    data |= {
        "duration_s": 6.0,
        "surfaces": {"bench": {"type": "box", "center_m": [0.3, 0.0, 0.2], "edges_m": [0.3, 1.0, 0.2]}},
        "contacts": {"law": "unilateral", "friction": 0.0},
    }
    path = {"type": "waypoints", "times_s": [0.0, 3.0, 6.0], "points_m": [start, end, start]}
    data["controller"]["hand"] = {"joints": ["base_yaw", "shoulder_pitch", "elbow_pitch"], "path": path}
    return data


def with_object() -> dict[str, Any]:
    data = without_friction(0)
    data["objects"] = {"crate": {"mass_kg": 1.0, "size_m": [0.1, 0.1, 0.1], "position_m": [2.0, 2.0, 2.0]}}
    return data


def mobile() -> dict[str, Any]:
    data = dynsim.load_scenario("mobile_elbow_comparison", "no_elbow").resolved
    data["contacts"] = {"law": "unilateral", "friction": 0.0}
    data["controller"]["hand"]["joints"] = [f"joint_{k}" for k in range(1, 11)]
    return data


@pytest.mark.long
@pytest.mark.parametrize("data", [oriented, urdf, with_object, mobile])
@pytest.mark.filterwarnings("ignore:plan. (objects|candidates)")
def test_sag_agrees_with_a_run_for_every_kind_of_arm(data) -> None:  # type: ignore[no-untyped-def]
    """The force moves the hand by about 0.5 mm; 3 % cover second order, lag, and the wheels of a base."""
    made = data()
    candidates = {"mobile": ["link_6", "link_8"], "urdf": ["forearm", "wrist_housing"]}.get(data.__name__, ())
    plan = dynsim.plan_braces(
        scenario_from_resolved(made),
        candidates=candidates,
        radius_m=0.05,
        count=(0, 1),
        starts=2,
        budget_s=0.0,
        verify=False,
    )
    count = max(size.count for size in plan.answered)
    difference, displacement = compared(plan, count, 500.0, [0.0, 0.0, -0.3])
    assert difference < 0.03 * displacement


def test_rating_is_compared_with_the_static_torque() -> None:
    """The hand is at rest: rms of the weight's moment over the rating; the run adds its rounding and method, 1e-6."""
    plan = unbraced(rating_share=1.0)
    (share,) = plan.size(0).requirements
    moment = (0.5 * MASS + PAYLOAD) * G * LENGTH
    assert share.value == pytest.approx(moment / 20.0, rel=1e-6)
    assert plan.size(0).survives
    (refused,) = unbraced(rating_share=0.5).sizes
    assert not refused.survives
    assert mentions(refused.reason, "joint_1", "0.5")


@pytest.mark.parametrize(("key", "factor"), [("payload_error", "payload_factor"), ("mass_error", "robot_factor")])
def test_errors_of_masses_are_corner_cases(key: str, factor: str) -> None:
    """The heat is quadratic in the moment that the run carries; the sag of the arm changes it by its cosine, 1e-3."""
    size = unbraced(**{key: 0.2, "heat_ratio": 2.0, "hand_error_m": 0.05}).size(0)
    masses = {"payload_factor": (0.5 * MASS, PAYLOAD), "robot_factor": (PAYLOAD, 0.5 * MASS)}[factor]
    expected = ((masses[0] + 1.2 * masses[1]) / sum(masses)) ** 2
    corners = [corner for corner in size.verdict.corners if getattr(corner, factor) != 1.0]  # type: ignore[union-attr]
    assert [getattr(corner, factor) for corner in corners] == pytest.approx([1.2, 0.8])
    values = {requirement.key: requirement.value for requirement in size.requirements}
    assert values[key] == values["heat_ratio"] == pytest.approx(expected, rel=1e-2)
    # The unknown mass lowers the hand by its moment over the stiffness, times the length.
    sag = 0.2 * masses[1] * G * LENGTH**2 / STIFFNESS
    assert values["hand_error_m"] == pytest.approx(sag, rel=2e-2)


@pytest.mark.parametrize(
    ("requirements", "name"),
    [
        ({"hand_sag_m": 0.001, "hand_force_N": [0, 0, -30]}, "sags"),
        ({"rating_share": 0.3}, "rating"),
        ({"hand_error_m": 1e-5, "payload_error": 0.2}, "hand error"),
        ({"heat_ratio": 1.1, "mass_error": 0.2}, "heat"),
    ],
)
def test_an_unmet_requirement_rejects_the_plan(requirements: dict[str, Any], name: str) -> None:
    (size,) = unbraced(**requirements).sizes
    assert size.survives is False
    assert mentions(size.reason, name)
    assert not all(requirement.met for requirement in size.requirements)
    # Each violation is stated once: by its run, or by the requirement.
    stated = [reason.partition(": ")[2] or reason for reason in size.verdict.reasons]  # type: ignore[union-attr]
    assert len(stated) == len(set(stated))
    runs = [corner for corner in size.verdict.corners if corner.reason]  # type: ignore[union-attr]
    assert len(stated) == len(runs) + sum(bool(requirement.reason) for requirement in size.requirements)
    assert bool(runs) != any(requirement.reason for requirement in size.requirements)


def test_requirements_without_runs_are_checked_without_verification() -> None:
    for limit, survives in ((0.5, None), (0.001, False)):
        data = horizontal(requirements={"hand_sag_m": limit, "hand_force_N": [0, 0, -30], "payload_error": 0.2})
        plan = dynsim.plan_braces(scenario_from_resolved(data), count=(0, 0), starts=1, budget_s=0.0, verify=False)
        assert plan.sizes[0].survives is survives
        assert [requirement.key for requirement in plan.sizes[0].requirements] == ["hand_sag_m"]


@pytest.mark.parametrize("law", ["bilateral", "unilateral"])
def test_a_controller_without_feed_forward_cannot_know_an_error_of_masses(law: str) -> None:
    """The run equals, bit for bit, the run of a scenario with the other masses; with feed-forward it does not."""
    data = horizontal(2, contacts={"law": law})
    error = {"mass_error": {"robot_factor": 1.25, "payload_factor": 2.0}}
    heavy = horizontal(2, contacts={"law": law})
    heavy["loads"]["tool"]["mass_kg"] *= 2.0
    for link in heavy["plant"]["chain"]:
        link["mass_kg"] *= 1.25
    runs = [dynsim.simulate(scenario_from_resolved(each)) for each in (data | error, heavy)]
    assert np.array_equal(runs[0]["q"], runs[1]["q"])
    for each in (data, heavy):
        each["controller"]["feed_forward"] = "gravity"
    runs = [dynsim.simulate(scenario_from_resolved(each)) for each in (data | error, heavy)]
    assert abs(runs[0]["q"][-1] - runs[1]["q"][-1]).max() > 1e-3


@pytest.mark.parametrize("name", ["six_axis_arm", "mobile_elbow_comparison", "free_flyer", "push_box"])
def test_mass_error_scales_robot_and_payloads_only(name: str) -> None:
    """URDF, mobile base, floating base, and an object, which keeps its mass; rounding: 1e-12."""
    loads = {"tool": {"type": "payload", "body": "", "mass_kg": 0.5}}
    scenario = dynsim.load_scenario(name)
    body = next(iter(build.robot(scenario).bodies))
    loads["tool"]["body"] = body
    error = {"robot_factor": 1.5, "payload_factor": 3.0}
    changes: list[dict[str, Any]] = [{"loads": loads}, {"loads": loads, "mass_error": error}, {"loads": {}}]
    plain, heavy, bare = (build.robot(dynsim.load_scenario(name, overrides=each)) for each in changes)
    for before, after, alone in zip(plain.links, heavy.links, bare.links, strict=True):
        factor = 1.0 if before.name.partition(".")[0] in scenario.config.objects else 1.5
        payload = 3.0 * 0.5 if before.name == body else 0.0
        assert after.inertia.mass == pytest.approx(factor * alone.inertia.mass + payload, rel=1e-12)
        if before.name != body:
            assert after.inertia.tensor == pytest.approx(factor * before.inertia.tensor, rel=1e-12, abs=0.0)
    assert [m.mass for m in heavy.motors] == pytest.approx([1.5 * m.mass for m in plain.motors], rel=1e-12)


def test_a_plan_ignores_an_error_of_masses() -> None:
    arms = horizontal(), horizontal(mass_error={"payload_factor": 2.0})
    plans = [dynsim.plan_braces(scenario_from_resolved(arm), count=(0, 0), starts=1, budget_s=0.0) for arm in arms]
    assert plans[0].size(0).heat == plans[1].size(0).heat
    assert plans[0].size(0).expected == plans[1].size(0).expected


def test_invalid_requirements_are_refused_with_their_line(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "arm.yaml"
    for requirements, names in (
        ({"hand_sag_m": 0.001}, ("requirements.hand_sag_m", "hand_force_N")),
        ({"hand_force_N": [0, 0, -30]}, ("requirements.hand_force_N", "hand_sag_m")),
        ({"heat_ratio": 0.5}, ("requirements.heat_ratio", "0.5")),
    ):
        path.write_text(to_yaml(horizontal(requirements=requirements)), encoding="utf-8")
        with raises(ScenarioError, "arm.yaml:", *names):
            dynsim.load_scenario(path)
    data = horizontal(requirements={"payload_error": 0.1})
    del data["loads"]
    path.write_text(to_yaml(data), encoding="utf-8")
    with raises(ScenarioError, "arm.yaml:", "requirements.payload_error", "payload"):
        dynsim.load_scenario(path)
    data = horizontal(requirements={"rating_share": 1.0})
    for link in data["plant"]["chain"]:
        link["motor"] = {key: value for key, value in MOTOR.items() if key != "nominal_torque_N_m"}
    path.write_text(to_yaml(data), encoding="utf-8")
    with raises(ModelError, "arm.yaml:", "requirements.rating_share", "nominal_torque_N_m"):
        dynsim.plan_braces(dynsim.load_scenario(path), count=(0, 0))


def varied(tmp_path, *axes: Axis) -> Plan:  # type: ignore[no-untyped-def]
    path = tmp_path / "scene.yaml"
    path.write_text(to_yaml(scene(11)), encoding="utf-8")
    return Plan(read_scenario(path), (None,), {}, axes)


UNVERIFIED = Verification(verify=False)
# A single search for each value.
OPTIONS = Options(("link_6",), count=(0, 1), starts=2, budget_s=0.0)


def test_each_value_has_a_plan_at_most_as_costly_as_alone(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """The heat changes little between values that differ little, since neighbours continue each other's postures."""
    runs = varied(tmp_path, Axis("surfaces.floor.point_m.2", (-0.02, -0.01, 0.0), "--vary"))
    variation = vary_plans(runs, OPTIONS, UNVERIFIED)
    heats = []
    for point, plan in zip(variation.points, variation.plans, strict=True):
        alone = plan_with(runs.scenario(point), OPTIONS, UNVERIFIED)
        assert isinstance(plan, BracePlan)
        assert plan.size(1).heat <= alone.size(1).heat
        heats.append(plan.size(1).heat)
    assert all(abs(b - a) < 0.2 * a for a, b in pairwise(heats))
    assert variation.chosen[1].size(1).heat == min(heats)
    assert [row["surfaces.floor.point_m.2"] for row in variation.table] == [-0.02, -0.01, 0.0]


def test_a_plan_is_continued_from_a_neighbour(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """A search that found nothing continues the plan for a floor 5 mm lower, with at most 10 % more heat."""
    runs = varied(tmp_path, Axis("surfaces.floor.point_m.2", (-0.005, 0.0)))
    first, second = (searched(runs.scenario(point), OPTIONS, silent) for point in runs.points())
    own = second.ranked[1][0].heat
    second.ranked[1].clear()
    second.add(first)
    (plan,) = second.ranked[1]
    assert isinstance(plan, Planned)
    assert plan.heat < 1.1 * own
    size = answered(second, UNVERIFIED, silent).size(1)
    assert size.planned is plan


def test_a_value_without_a_plan_has_a_reason(tmp_path) -> None:  # type: ignore[no-untyped-def]
    runs = varied(tmp_path, Axis("plant.base.position_m.2", (9.0, scene(11)["plant"]["base"]["position_m"][2])))
    variation = vary_plans(runs, OPTIONS, UNVERIFIED)
    assert mentions(variation.table[0]["reason"], "path")
    assert variation.json["best"] == dict(variation.points[1].values)


def friction(tmp_path) -> Plan:  # type: ignore[no-untyped-def]
    return varied(tmp_path, Axis("contacts.friction", (0.1, 0.2, 0.3)))


@pytest.mark.parametrize("complete", [True, False])
def test_values_before_an_interrupt_are_kept(tmp_path, monkeypatch, complete: bool) -> None:  # type: ignore[no-untyped-def]
    """The second search is interrupted, after its first paths or before. No plan is verified then."""
    known: list[Searched] = []

    def interrupted(*arguments: Any) -> Searched:
        if known and not complete:
            raise KeyboardInterrupt
        known.append(searched(*arguments))
        if len(known) == 2:
            known[1].search.tally.ended = "interrupted"
        return known[-1]

    monkeypatch.setattr(vary, "searched", interrupted)
    variation = vary_plans(friction(tmp_path), OPTIONS, Verification())
    assert variation.interrupted
    assert variation.json["interrupted"]
    assert isinstance(variation.plans[0], BracePlan)
    assert variation.plans[0].size(1).survives is None
    assert isinstance(variation.plans[1], BracePlan) == complete
    assert all(mentions(row["reason"], "interrupted") for row in variation.table[1 + complete :])
    assert mentions(_ended(variation.plans[0], variation), "interrupted", "0 of 3")


def test_values_verified_before_an_interrupt_stay_verified(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    verified = answer.Verifier.verify

    def verify(self: answer.Verifier, *arguments: Any) -> Any:
        if self.task.friction == 0.2:
            raise KeyboardInterrupt
        return verified(self, *arguments)

    monkeypatch.setattr(answer.Verifier, "verify", verify)
    variation = vary_plans(friction(tmp_path), OPTIONS, Verification(Tolerances(friction=(1.0,), shift_m=(0.0,))))
    best = [plan.best for plan in variation.plans if isinstance(plan, BracePlan)]
    assert [size.survives for size in best if size is not None] == [True, None, None]
    assert mentions(_ended(variation.chosen[1], variation), "interrupted", "1 of 3")


def test_budget_that_ends_at_some_values_is_reported_whichever_is_the_best(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """Each value may use an equal part of the time that is left."""
    budgets: list[float] = []

    def ended(scenario: Any, options: Options, tell: Any) -> Searched:
        budgets.append(options.budget_s)
        known = searched(scenario, replace(options, budget_s=0.0), tell)
        known.search.tally.ended = "budget" if len(budgets) == 2 else "agreed"
        return known

    monkeypatch.setattr(vary, "searched", ended)
    variation = vary_plans(friction(tmp_path), replace(OPTIONS, budget_s=900.0), UNVERIFIED)
    first, second, third = budgets
    # A search takes far less than its part of 300 s, which remains for the following values.
    assert 290.0 < first < 300.0 < second < third
    for plan in variation.plans:
        assert isinstance(plan, BracePlan)
        assert mentions(_ended(plan, variation), "budget", "1 of 3")
    assert [point["ended"] for point in variation.json["points"]] == ["agreed", "budget", "agreed"]


def test_invalid_variations_are_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    axes = [Axis(f"surfaces.floor.point_m.{k}", (0.0, 0.1), "--vary") for k in range(3)]
    for runs, names in (
        (varied(tmp_path, *axes), ("--vary", "3 keys")),
        (varied(tmp_path, Axis("contacts.law", ("unilateral", "bilateral"), "--vary")), ("--vary contacts.law",)),
        (varied(tmp_path, Axis("contacts.friction", (-1.0, 0.1), "--vary")), ("contacts.friction", "-1.0")),
    ):
        with raises(ScenarioError, *names):
            vary_plans(runs, OPTIONS, UNVERIFIED)
    with raises(ScenarioError, "--vary contacts.friction=0:1:x", "0:1:5"):
        Axis.parse("contacts.friction=0:1:x", "--vary", 5)
    assert Axis.parse("contacts.friction=0:1", "--vary", 5).values == (0.0, 0.25, 0.5, 0.75, 1.0)
