"""Head paths, command scripts and the mode switcher of the snake, without a simulation."""

import re

import numpy as np
import pytest
from pydantic import ValidationError
from support.messages import raises

from dynsim.engine.snake_control import ModeSwitcher
from dynsim.errors import ModelError
from dynsim.library.controllers.snake_commands import Circle, DoorArc, Ramp, Script, ScriptedSource, SnakeCommand
from dynsim.library.controllers.task_space import TABLE_II
from dynsim.snake.description import FIXING, NO_REQUEST, SWITCHING, ModeTable

MODES = ModeTable.from_lifted(TABLE_II, 7)
PATHS = [
    Ramp(type="ramp", start_s=0.33, duration_s=1.0, displacement=(0.2, -0.1, 0, 0, 0.3, 0)),
    Ramp(type="ramp", start_s=0.33, duration_s=1.0, displacement=(0.2, -0.1, 0, 0, 0.3, 0), profile="smooth"),
    Circle(type="circle", duration_s=2.0, radius_m=0.3, turns=0.7),
    Circle(type="circle", duration_s=2.0, radius_m=0.3, turns=-0.7, backward=True),
    Circle(type="circle", duration_s=2.0, radius_m=0.3, turns=1.0, plane="yz"),
    DoorArc(type="door_arc", duration_s=2.0, radius_m=0.4, angle_deg=40, hinge="right", opening="push"),
]


def source(*commands, paths=()):
    return ScriptedSource([SnakeCommand(**c) for c in commands], list(paths))


@pytest.mark.parametrize("path", PATHS)
def test_velocities_integrate_to_the_path_exactly(path):
    """The mean rate of every period times the period: no drift of a sampled derivative."""
    block = source(paths=[path]).read(0, 500, 0.005)
    end = path.offset(np.ones(1))[0]
    np.testing.assert_allclose(0.005 * block.velocity.sum(axis=0), end, atol=1e-12)


@pytest.mark.parametrize(("turns", "backward"), [(1, False), (-1, False), (1, True), (-1, True)])
def test_circle_keeps_the_head_tangent(turns, backward):
    s = np.linspace(0, 1, 2001)
    offset = Circle(type="circle", duration_s=1, radius_m=0.5, turns=turns, backward=backward).offset(s)
    rate = np.gradient(offset, s, axis=0)
    along = np.stack([np.cos(offset[:, 5]), np.sin(offset[:, 5])], axis=1) * (-1 if backward else 1)
    speed = np.linalg.norm(rate[:, :2], axis=1)
    np.testing.assert_allclose(np.einsum("ti,ti->t", rate[5:-5, :2], along[5:-5]), speed[5:-5], rtol=1e-5)
    centre = np.array([0, 0.5 * turns])
    np.testing.assert_allclose(np.linalg.norm(offset[:, :2] - centre, axis=1), 0.5, atol=1e-12)


@pytest.mark.parametrize(("hinge", "opening"), [(h, o) for h in ("left", "right") for o in ("pull", "push")])
def test_door_arc_is_a_rigid_turn_about_the_hinge(hinge, opening):
    offset = DoorArc(type="door_arc", duration_s=1, radius_m=0.4, hinge=hinge, opening=opening).offset(
        np.linspace(0, 1, 9)
    )
    pivot = np.array([0.0, 0.4 if hinge == "left" else -0.4])
    for x, y, *_, yaw in offset:
        R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        np.testing.assert_allclose([x, y], pivot + R @ -pivot, atol=1e-12)
    assert (offset[-1, 0] > 0) == (opening == "push")


def test_command_list():
    block = source(
        {"at_s": 0.1, "velocity": (0.1, 0, 0, 0, 0, 0)},
        {"at_s": 0.2, "gripper": "closed"},
        {"at_s": 0.3, "velocity": (0, 0, 0, 0, 0, 0), "mode": "switching"},
        {"at_s": 0.4, "mode": 3},
        {"at_s": 0.5, "mode": "fixing"},
    ).read(0, 100, 0.01)
    np.testing.assert_array_equal(np.flatnonzero(block.velocity[:, 0]), np.arange(10, 30))
    np.testing.assert_array_equal(np.flatnonzero(block.gripper), np.arange(20, 100))
    assert block.request[30] == SWITCHING
    assert block.request[40] == 3
    assert block.request[50] == FIXING
    assert np.count_nonzero(block.request) == 3


def test_reading_piece_by_piece_is_reading_at_once():
    """The answer does not depend on how far it is asked for."""
    commands = (
        {"at_s": 0.1, "velocity": (0.1, 0, 0, 0, 0, 0)},
        {"at_s": 0.31, "mode": "switching", "gripper": "closed"},
    )
    whole = source(*commands, paths=PATHS).read(0, 60, 0.01)
    pieces = [source(*commands, paths=PATHS).read(k, 1, 0.01) for k in range(60)]
    for i in range(3):
        np.testing.assert_allclose(np.concatenate([piece[i] for piece in pieces]), whole[i], atol=1e-15)


def test_bad_scripts_are_refused():
    with raises(ValidationError, re.compile(r"Value error, .*\bat_s\b.* \[type")):
        Script(commands=[{"at_s": 2.0}, {"at_s": 1.0}])
    with raises(ModelError, "controller.modes", "1", "8", "7"):
        ModeTable.from_lifted({1: [8]}, 7)
    with raises(ModelError, "controller.modes", "{1: [3, 6]}"):
        ModeTable.from_lifted({}, 7)


def switcher(policy, margins=None, costs=None, order=(1, 2, 3)):
    margins, costs = margins or {}, costs or {}
    return ModeSwitcher(
        policy=policy,
        modes=MODES,
        fixing_row=0,
        order=order,
        period_ticks=10,
        least_margin=0.0,
        predict=lambda row: (costs.get(row, 5.0), margins.get(row, 1.0)),
    )


def drive(modes, ticks, requests):
    return [modes.at_tick(tick, requests.get(tick, NO_REQUEST)) for tick in range(ticks)]


def test_cyclic_order_and_return_to_the_fixing_state():
    modes = switcher("cyclic")
    rows = drive(modes, 60, {5: SWITCHING, 47: FIXING})
    assert rows == [0] * 5 + [1] * 10 + [2] * 10 + [3] * 10 + [1] * 10 + [2] * 2 + [0] * 13
    assert modes.switches == 6


def refused(modes):
    return [(r.tick, r.row, r.margin) for r in modes.refusals if not r.taken]


def test_a_mode_that_would_tip_is_passed_over():
    modes = switcher("cyclic", margins={2: -0.01})
    assert drive(modes, 30, {0: SWITCHING}) == [1] * 10 + [3] * 10 + [1] * 10
    assert refused(modes) == [(10, 2, -0.01)]


@pytest.mark.parametrize("policy", ["cyclic", "predictive"])
def test_the_present_mode_stays_when_every_candidate_tips(policy):
    modes = switcher(policy, margins={1: -3.0, 2: -1.0, 3: -2.0})
    assert drive(modes, 12, {0: SWITCHING}) == [0] * 12
    assert refused(modes) == [(t, row, m) for t in (0, 10) for row, m in ((1, -3.0), (2, -1.0), (3, -2.0))]
    assert modes.switches == 0


@pytest.mark.parametrize("policy", ["cyclic", "predictive"])
def test_when_the_present_mode_tips_too_the_least_tipping_one_is_taken(policy):
    modes = switcher(policy, margins={0: -2.0, 1: -3.0, 2: -1.0, 3: -2.5})
    assert drive(modes, 3, {0: SWITCHING}) == [2] * 3
    assert [r.row for r in modes.refusals if r.taken] == [2]
    assert [row for _, row, _ in refused(modes)] == [1, 3]


@pytest.mark.parametrize("policy", ["cyclic", "predictive"])
def test_the_fixing_mode_is_the_way_out_when_present_and_order_tip(policy):
    modes = switcher(policy, margins={1: -0.1}, order=(1,))
    modes.row = 1
    assert drive(modes, 3, {0: SWITCHING}) == [0] * 3
    assert refused(modes) == [(0, 1, -0.1)]


def test_prediction_takes_the_lowest_cost_that_stands():
    assert drive(switcher("predictive", costs={1: 4.0, 2: 1.0, 3: 3.0}), 3, {0: SWITCHING}) == [2] * 3
    tipping = switcher("predictive", costs={1: 4.0, 2: 1.0, 3: 3.0}, margins={2: 0.0})
    assert drive(tipping, 3, {0: SWITCHING}) == [3] * 3
    assert refused(tipping) == [(0, 2, 0.0)]


def test_a_mode_asked_for_by_number_is_refused_when_it_would_tip():
    modes = switcher("fixed", margins={2: -0.02})
    assert drive(modes, 8, {2: 2, 4: 3, 6: 4}) == [0, 0, 1, 1, 1, 1, 3, 3]  # request = row + 1
    assert refused(modes) == [(4, 2, -0.02)]


def test_the_return_to_the_fixing_mode_is_refused_when_it_would_tip():
    """The switching state ends all the same: the operator wants no more changes."""
    modes = switcher("cyclic", margins={0: -0.02})
    assert drive(modes, 30, {0: SWITCHING, 12: FIXING}) == [1] * 10 + [2] * 20
    assert refused(modes) == [(12, 0, -0.02)]
    assert modes.next_event() is None


def test_a_request_is_carried_out_when_the_present_mode_tips_more():
    modes = switcher("fixed", margins={0: -0.05, 1: -0.02, 2: -0.03})
    assert drive(modes, 6, {1: 2, 3: 3}) == [0, 1, 1, 1, 1, 1]
    assert [(r.tick, r.row, r.taken) for r in modes.refusals] == [(1, 1, True), (3, 2, False)]


def test_asking_for_the_present_mode_is_no_change():
    modes = switcher("fixed", margins={0: -0.05})
    assert drive(modes, 3, {1: 1, 2: FIXING}) == [0] * 3
    assert modes.refusals == []


def test_fixed_policy_ignores_requests_to_switch_but_obeys_a_mode_number():
    assert drive(switcher("fixed"), 4, {1: SWITCHING, 2: 3}) == [0, 0, 2, 2]
