"""Every shipped scenario is valid in all variants, and runs (shortened)."""

import functools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import dynsim
from dynsim.compile.tables import SETTLE_SPEED
from dynsim.dynamics.tables import SLIDING, STICKING
from dynsim.engine import check
from dynsim.engine.warnings import PENETRATION_LIMIT_M
from dynsim.scenario import shipped_scenarios, variant_names

CASES = [(path.stem, variant) for path in shipped_scenarios() for variant in (variant_names(path) or [None])]


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_is_valid(name, variant):
    check(dynsim.load_scenario(name, variant))


def floats(value: Any) -> Iterator[float]:
    """Every float of a summary, however deep."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, (dict, list)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from floats(item)


@pytest.mark.parametrize("name", sorted({name for name, _ in CASES}))
def test_runs_shortened(name):
    record = dynsim.simulate(dynsim.load_scenario(name, overrides={"duration_s": 0.5, "metrics.settle_s": 0.1}))
    assert record.complete
    assert record.time[-1] == pytest.approx(0.5)
    numbers = list(floats(record.summary))
    assert len(numbers) > 10
    assert all(map(math.isfinite, numbers))


# Snakes stand on compliant tyres and step in time: test_snake_dynamic has what holds of them.
ARMS = {case: dynsim.load_scenario(*case).config for case in CASES if not case[0].startswith("snake_")}
STEPPED = [case for case, config in ARMS.items() if config.integrator.method == "time_stepping"]
REAL = [case for case, config in ARMS.items() if config.contacts.law == "unilateral" and case not in STEPPED]
REAL_FLOOR = "elbow_comparison_floor"
ON_FLOOR: dict[str, set[int]] = {"elbow_7": {7}, "elbow_4": {4}, "no_elbow": set()}


@pytest.fixture(scope="module")
def run():
    """Whole runs of shipped scenarios, each simulated once."""
    return functools.cache(lambda name, variant=None: dynsim.simulate(dynsim.load_scenario(name, variant)))


@pytest.mark.parametrize(("name", "variant"), REAL)
def test_real_contact_keeps_its_laws(run, name, variant):
    """In every sample 0 ≤ f_n ⟂ gap ≥ 0 and friction within its cone; the ledger closes over all events."""
    record = run(name, variant)
    scenario = dynsim.load_scenario(name, variant)
    assert record.complete
    # Samples of the block that is pulled lie between steps of 0.1 s.
    assert record.summary["energy_residual_relative"] <= (1e-7 if record["current"].size else 1e-6)
    contacts = scenario.config.contacts
    force, gap, mode = (record[f"contact_{column}"] for column in ("normal_force", "gap", "mode"))
    assert force.min(initial=0.0) >= -1e-9
    assert gap.min(initial=0.0) >= -1e-9
    # The natural map: a closed contact has no gap, an open one no force.
    assert np.abs(np.minimum(force, gap)).max(initial=0.0) <= 1e-9
    assert not force[mode == 0.0].any()
    assert all(contact["penetration_max_m"] <= 1e-9 for contact in record.summary["contacts"])
    # Shares of the time, by steps, are those of the samples.
    for k, contact in enumerate(record.summary["contacts"]):
        shares = [np.mean(mode[:, k] == kind) for kind in (SLIDING, STICKING)]
        assert [contact["sliding_fraction"], contact["sticking_fraction"]] == pytest.approx(shares, abs=0.02)
    total = np.linalg.norm(record["contact_force"], axis=2)
    friction = np.sqrt(np.maximum(total**2 - force**2, 0.0))
    slope = contacts.friction if contacts.static_friction is None else contacts.static_friction
    if all(point.static_friction is None and point.friction is None for point in contacts.points.values()):
        # The difference of two squares is good to the root of rounding.
        assert (friction - slope * force).max(initial=0.0) <= 1e-7 * max(1.0, total.max(initial=0.0))


@pytest.mark.parametrize(("name", "variant"), STEPPED)
def test_real_contact_in_fixed_steps_keeps_its_laws(run, name, variant):
    """Forces push, within the friction cone; rigid contacts do not sink in; the ledger closes to rounding."""
    record = run(name, variant)
    summary, contacts = record.summary, ARMS[name, variant].contacts
    assert record.complete
    assert summary["energy_residual_relative"] <= 1e-13
    assert summary["time_stepping"]["dropped_solves"] == summary["time_stepping"]["capped_solves"] == 0
    force, gap = record["contact_normal_force"], record["contact_gap"]
    assert force.min(initial=0.0) >= 0.0
    if contacts.stiffness_N_per_m is None:
        # A landing within a step of 1 ms is known to h² a, with accelerations of some m/s². Bodies that fall on others
        # sink in by the way of half a step.
        assert gap.min(initial=0.0) >= (-PENETRATION_LIMIT_M if contacts.between else -1e-6)
    else:
        # The force is the mean of a step.
        assert -gap.min(initial=0.0) <= 1.05 * force.max(initial=0.0) / contacts.stiffness_N_per_m
    friction = np.sqrt(np.maximum(np.linalg.norm(record["contact_force"], axis=2) ** 2 - force**2, 0.0))
    sections = (None, *contacts.points.values(), *contacts.between)
    worst = max(value for section in sections for value in contacts.coefficients(section))
    factor = 1.0 if ARMS[name, variant].surface_error is None else ARMS[name, variant].surface_error.friction_factor
    speed = np.linalg.norm(record["contact_slip_velocity"], axis=2).max(initial=0.0)
    slope = factor * (worst + contacts.viscous_friction_s_per_m * speed)
    # The difference of two squares is good to the root of rounding.
    assert (friction - slope * force).max(initial=0.0) <= 1e-6 * max(1.0, force.max(initial=0.0))


# All other arms, but for the one that tips over. No other default test compiles the dense solver.
GLUED = [
    pytest.param(*case, marks=[pytest.mark.long] if case == ("sampled_arm", "dense") else [])
    for case in ARMS
    if case not in REAL and case not in STEPPED and case[0] != "mobile_reach"
]


@pytest.mark.parametrize(("name", "variant"), GLUED)
def test_the_ledger_closes_at_default_settings(run, name, variant):
    """Also where references bend: the steps of the implicit method end at the knots there."""
    assert run(name, variant).summary["energy_residual_relative"] <= 1e-7


# Kinds of events in the order of time, or of how many there are at least; and why.
TOLD: dict[tuple[str, str | None], tuple[list[tuple[str, str]], str]] = {
    ("block_on_slope", "rests"): ([], "tan α = 0.4 < μ"),
    ("block_on_slope", "slides"): ([], "it slides from the start on"),
    ("block_on_slope", "pulled"): ([("slip_start", "foot")], "the pull grows until both reach the cone"),
    ("bouncing_link", "dead"): ([("landing", "tip")], "restitution 0"),
    ("elbow_comparison_floor", "two_elbows"): (
        [
            ("slip_start", "elbow_7"),
            ("lift_off", "elbow_7"),
            ("landing", "elbow_7"),
            ("lift_off", "elbow_4"),
            *[("slip_stop", "elbow_7"), ("slip_start", "elbow_7")] * 2,
        ],
        "elbow 4 leaves where the glued one was pulled; elbow 7 turns back twice in a circle, and sticks there",
    ),
    ("elbow_comparison_floor", "elbow_4"): (
        [("slip_stop", "elbow_4"), ("slip_start", "elbow_4")] * 2,
        "it carries all of the weight, and never leaves",
    ),
    ("elbow_comparison_floor", "no_elbow"): ([], "nothing can touch"),
    ("elbow_comparison_links", "no_elbow"): (
        [("landing", "joint_9"), ("lift_off", "joint_9")],
        "the front falls, brushes the floor and is held above it by its motors",
    ),
    ("floor_below", "deep"): (
        [("landing", "joint_7"), ("lift_off", "joint_7")],
        "joint 7 sags by 140 mm at most and by 93 mm in the end",
    ),
    ("floor_below", "none"): ([], "there is no floor"),
    ("wall_push", "weak_hold"): (
        [("landing", "elbow"), ("slip_stop", "elbow"), ("slip_start", "elbow"), ("slip_stop", "elbow")],
        "it slips once, while it is dragged",
    ),
    ("wall_push", "strong_hold"): ([("landing", "elbow"), ("slip_stop", "elbow")], "it wedges"),
    ("wall_push", "no_friction"): ([("landing", "elbow")], "nothing holds it along the wall"),
    ("brace_on_cylinder", "real"): (
        [("slip_start", "elbow"), ("slip_stop", "elbow")] * 2,
        "a slip as the weight comes on, and one while the hand moves",
    ),
}


@pytest.mark.parametrize(("name", "variant"), TOLD)
def test_events_of_real_contact(run, name, variant):
    expected, reason = TOLD[name, variant]
    assert [(event.kind, event.name) for event in run(name, variant).events] == expected, reason


def test_a_block_on_a_slope_in_closed_form(run):
    """tan α = 0.4: rest for μ = 0.5; ½ g (sin α − μ cos α) t² for μ = 0.3; slip at √(T² + G²) = μ_s N when pulled."""
    sine, cosine, weight = 2 / math.sqrt(29), 5 / math.sqrt(29), 3 * 9.81
    assert np.abs(run("block_on_slope", "rests")["q"]).max() <= 1e-12
    slides = run("block_on_slope", "slides")
    distance = 0.5 * 9.81 * (sine - 0.3 * cosine) * slides.time**2
    np.testing.assert_allclose(slides["q"], np.outer(distance, [cosine, 0.0, -sine]), rtol=0, atol=1e-6)
    (onset,) = run("block_on_slope", "pulled").events
    pull = weight * math.sqrt((0.5 * cosine) ** 2 - sine**2)
    # The pull grows by 8 N/s.
    assert onset.time == pytest.approx(pull / 8.0, abs=1e-9)


def test_a_link_bounces_away_its_energy(run):
    """From rest at 30°, m g (l/2) sin 30° in all; hinge and floor are level, so each bounce scales the rate by e."""
    for variant, e in (("half", 0.5), ("dead", 0.0), ("lively", 0.8)):
        record = run("bouncing_link", variant)
        assert record.summary["impact_loss_J"] == pytest.approx(0.4 * 9.81 * 0.25 * 0.5, rel=1e-7)
        assert record.events[-1].kind == "landing"
        bounces = [event for event in record.events if event.kind == "bounce"]
        assert len(bounces) == len(record.events) - 1
        # Slower than that it stays: v_0 e^k ≤ SETTLE_SPEED, v_0 of a rod of moment m l²/3.
        speed = math.sqrt(3.0 * 9.81 * 0.5 * 0.5)
        assert len(bounces) == (math.floor(math.log(SETTLE_SPEED / speed) / math.log(e)) if e else 0)


def test_a_limp_arm_rocks_and_comes_to_rest(run):
    record = run("falling_arm")
    assert (record["contact_mode"][-1] == 2.0).all()
    assert np.abs(record["v"][-1]).max() <= 1e-9
    assert len([event for event in record.events if event.kind == "landing"]) > len(record["q"][0])
    # It lies flat: each joint carries two half links, the hand one.
    weight = 0.2 * 9.81
    np.testing.assert_allclose(record["contact_normal_force"][-1], [weight] * 4 + [0.5 * weight], rtol=1e-6)
    fallen = -record["energy_potential"][-1] + record["energy_potential"][0]
    lost = sum(record[name][-1] for name in ("loss_impact", "heat_friction", "loss_joint"))
    assert lost == pytest.approx(fallen, rel=1e-6)


def test_the_real_floor_differs_from_the_glued_one_as_told():
    """The two files say the same but for the law; with both elbows the real arm is that with elbow 7 alone."""
    glued, real = (dynsim.load_scenario(name, "two_elbows").resolved for name in ("elbow_comparison", REAL_FLOOR))
    for key in ("duration_s", "plant", "controller", "surfaces", "integrator", "record", "metrics"):
        assert glued[key] == real[key], key
    assert variant_names("elbow_comparison") == variant_names(REAL_FLOOR)
    assert glued["contacts"]["friction"] == real["contacts"]["friction"]
    assert glued["contacts"]["points"] == {
        name: {key: value for key, value in point.items() if key in glued["contacts"]["points"][name]}
        for name, point in real["contacts"]["points"].items()
    }


def test_two_elbows_on_a_real_floor_are_one(run):
    """Energy and error as with elbow 7 alone; more than glued, where the floor pulls for nothing."""
    both, single = (run(REAL_FLOOR, variant).summary for variant in ("two_elbows", "elbow_7"))
    glued = run("elbow_comparison", "two_elbows").summary
    assert both["electrical_energy_J"] == pytest.approx(single["electrical_energy_J"], rel=1e-3)
    assert both["hand_error_rms_m"] == pytest.approx(single["hand_error_rms_m"], rel=1e-4)
    assert both["electrical_energy_J"] > 1.02 * glued["electrical_energy_J"]
    # Events and modes cost the implicit method Jacobians: 1.4 times the evaluations; an explicit one a tenth more.
    assert both["rhs_evaluations"] < 1.5 * glued["rhs_evaluations"]


def test_postures_of_the_arm_whose_links_touch():
    """The hand is where it was in all of them, and the elbows that their names say are on the floor."""
    scenarios = {name: dynsim.load_scenario("elbow_comparison_links", name) for name in ("two_elbows", *ON_FLOOR)}
    starts = {name: check(scenario).hand for name, scenario in scenarios.items()}
    for name, elbows in ON_FLOOR.items():
        np.testing.assert_allclose(starts[name], starts["two_elbows"], rtol=0, atol=1e-12)
        model = dynsim.build_model(scenarios[name])
        q = model.robot.initial
        low = {k for k in range(3, 11) if model.point_position(f"link_{k}", [0, 0, 0], q)[2] < 1e-9}
        assert low == elbows


def test_elbows_press_as_commanded(run):
    """From 2 s on within 2 %; the optimum is the cheapest, and gravity alone unloads the braces and costs most."""
    settled = {name: run("pressing", name).time >= 2.0 for name in variant_names("pressing")}
    force = {name: run("pressing", name)["contact_normal_force"][late] for name, late in settled.items()}
    np.testing.assert_allclose(force["commanded"], np.tile([3.0, 8.0], (len(force["commanded"]), 1)), rtol=0.02)
    assert force["optimal"].min() >= 0.98 * 0.5
    assert not force["plain"][:, 0].any()
    energy = {name: run("pressing", name).summary["electrical_energy_J"] for name in settled}
    assert sorted(energy, key=energy.__getitem__) == ["optimal", "plain", "commanded", "gravity"]
    error = {name: run("pressing", name).summary["hand_error_rms_m"] for name in settled}
    assert max(error["optimal"], error["commanded"]) < 0.1 * error["plain"]
