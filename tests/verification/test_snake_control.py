"""Task-space controller of the snake: [T] eqs 12-14 against dense algebra, ranks, singularity, limits, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.messages import raises

from dynsim.compile.protocols import BuildContext
from dynsim.errors import ModelError
from dynsim.jit.kernel import reals
from dynsim.library.controllers import task_space
from dynsim.library.plants import snake
from dynsim.snake import ticks as ss
from dynsim.snake.controller import control_input, new_work, sigma_min
from dynsim.snake.description import conditioning
from dynsim.snake.kinematics import constraint_matrices, new_chain, pose_of_point, walk_chain
from dynsim.snake.ticks import AT_LIMIT, is_too_fast

seeds = st.integers(0, 2**32 - 1)
forms = st.sampled_from(["safe", "paper"])
mode_rows = st.integers(0, 5)


def case(random, **options):
    """Robot of random geometry, controller of random weights, and a random posture well away from the limits."""
    plant = snake.build(
        snake.Config(
            link_length_m=random.uniform(0.05, 0.15),
            wheel_radius_m=random.uniform(0.03, 0.08),
            wheel_gap_m=random.uniform(0.08, 0.2, 7).tolist(),
            driven_side=random.choice(["left", "right"], 7).tolist(),
            controlled_point=str(random.choice(["head", "gripper"])),
        ),
        BuildContext(1.0),
    )
    config = {"limit_policy": "none", "damping_sigma": 0.0} | options
    controller = task_space.build(task_space.Config(**config), BuildContext(1.0, plant))
    phi = plant.initial_joints + random.uniform(-0.3, 0.3, 12)
    return plant.arrays(), controller, phi


def evaluate(model, law, phi, base, deviation, velocity, row, null_gain):
    w, work = np.zeros(6), new_work(model)
    pose_of_point(model, reals(base), reals(phi), work.frame, w)
    control_input(model, law, work, w, reals(phi), reals(w - deviation), reals(velocity), row, null_gain)
    return w, work


def dense(model, law, phi, w, row):
    """A~, B~ and the weighted pseudo inverse, by numpy."""
    chain = new_chain(model)
    walk_chain(model, w, reals(phi), np.zeros((3, 3)), chain)
    A, B = np.zeros((10 + model.wheels, 6)), np.zeros((10 + model.wheels, 12 + model.wheels))
    constraint_matrices(model, chain, w, A, B)
    down = law.grounded[row].astype(bool)
    keep = np.concatenate([down, [True] * 3, down])
    m = len(law.shape_joints)
    S = np.zeros((m, B.shape[1]))
    S[np.arange(m), law.shape_joints] = 1
    A = np.block([[A[keep], np.zeros((keep.sum(), m))], [np.zeros((m, 6)), np.eye(m)]])
    B = np.vstack([B[keep], S])
    W_inverse = np.diag(law.root_weight_inverse**2)
    return A, B, W_inverse @ B.T @ np.linalg.inv(B @ W_inverse @ B.T), W_inverse


@given(seeds, mode_rows, forms)
@settings(max_examples=40, deadline=None)
def test_input_is_equations_12_to_14(seed, row, form):
    random = np.random.default_rng(seed)
    weights = {"weight_joint": random.uniform(0.2, 5, 12).tolist(), "weight_wheel": random.uniform(0.01, 1)}
    model, controller, phi = case(random, null_form=form, **weights)
    law, deviation, velocity = controller.law, random.normal(size=6) * 0.1, random.normal(size=6) * 0.1
    w, work = evaluate(model, law, phi, random.normal(size=3), deviation, velocity, row, 0.1)
    A, B, inverse, W_inverse = dense(model, law, phi, w, row)
    rate = np.append(velocity - law.gain[:6] * deviation, -law.gain[6] * (phi[5] - law.shape_target[0]))
    eta = np.append(2 * law.cost.diagonal * phi, np.zeros(model.wheels))
    null = (np.eye(B.shape[1]) - inverse @ B) @ (eta if form == "paper" else W_inverse @ eta)
    # both sides lose digits by the condition of B~, squared in the normal equations of the reference
    scale = 1e-15 * np.linalg.cond(B @ np.sqrt(W_inverse)) ** 2 * 100
    np.testing.assert_allclose(work.u, inverse @ A @ rate - 0.1 * null, atol=max(scale, 1e-10), rtol=max(scale, 1e-9))
    # eq 15: the closed loop does what was commanded
    np.testing.assert_allclose(B @ work.u, A @ rate, atol=1e-10)


@given(seeds, mode_rows)
@settings(max_examples=40, deadline=None)
def test_safe_null_space_term_never_raises_the_cost(seed, row):
    """eta . u_ker <= 0 and B~ u_ker = 0 for every W; eq 14 as printed guarantees it for equal joint weights only."""
    random = np.random.default_rng(seed)
    model, controller, phi = case(random, weight_joint=random.uniform(0.05, 20, 12).tolist())
    phi[5] = controller.law.shape_target[0]
    w, work = evaluate(model, controller.law, phi, np.zeros(3), np.zeros(6), np.zeros(6), row, 1.0)
    _, B, _, _ = dense(model, controller.law, phi, w, row)
    assert work.gradient @ work.u < -1e-6  # it falls: no motion at all would not raise it either
    np.testing.assert_allclose(B @ work.u, 0.0, atol=1e-11)


def test_printed_null_space_term_can_raise_the_cost():
    """Unequal joint weights: a posture where eq 14 climbs (the fact behind ``null_form: safe``)."""
    random, climbs = np.random.default_rng(3), []
    for _ in range(200):
        weights = (10 ** random.uniform(-1.5, 1.5, 12)).tolist()
        model, controller, phi = case(random, null_form="paper", weight_joint=weights)
        phi[5] = controller.law.shape_target[0]
        _, work = evaluate(model, controller.law, phi, np.zeros(3), np.zeros(6), np.zeros(6), 0, 1.0)
        climbs.append(work.gradient @ work.u)
    assert max(climbs) > 0.0


@given(seeds, mode_rows)
@settings(max_examples=20, deadline=None)
def test_joint_rates_do_not_depend_on_wheel_side_or_track_as_wheel_weights_vanish(seed, row):
    random = np.random.default_rng(seed)
    phi = np.array([0, -0.8, 0, -1.1, 0, 1.9] + [0] * 6) + random.uniform(-0.3, 0.3, 12)
    velocity = random.normal(size=6) * 0.1
    sides = [random.choice(["left", "right"], 7).tolist() for _ in range(2)]
    gaps = [random.uniform(0.08, 0.2, 7).tolist() for _ in range(2)]
    difference = []
    for weight in (1e-2, 1e-6, 1e-8):
        rates: list[np.ndarray] = []
        for side, gap in zip(sides, gaps, strict=True):
            plant = snake.build(snake.Config(driven_side=side, wheel_gap_m=gap), BuildContext(1.0))
            config = task_space.Config(weight_wheel=weight, limit_policy="none", damping_sigma=0.0)
            law = task_space.build(config, BuildContext(1.0, plant)).law
            rates.append(evaluate(plant.arrays(), law, phi, np.zeros(3), np.zeros(6), velocity, row, 0.1)[1].u[:12])
        assert np.abs(rates[0]).max() > 0.01  # it moves
        difference.append(np.abs(rates[0] - rates[1]).max())
    # the influence is proportional to the weight: 1e-2 -> 1e-6 divides it by 1e4 (or it is rounding already)
    assert difference[1] <= 2e-3 * difference[0] + 1e-9
    assert difference[2] <= 1e-6


@given(seeds, mode_rows)
@settings(max_examples=30, deadline=None)
def test_ranks_at_random_postures(seed, row):
    """A~ has full column rank and B~ full row rank at random postures; the smallest singular value is reported."""
    random = np.random.default_rng(seed)
    model, controller, phi = case(random)
    law = controller.law
    indices = conditioning(model, law, row, np.zeros(3), phi)
    assert (indices.rank_A, indices.rank_B, indices.redundancy) == (7, indices.rows, 19 - indices.rows)
    _, work = evaluate(model, law, phi, np.zeros(3), np.zeros(6), np.zeros(6), row, 0.0)
    # inverse iteration stops at a relative change of 1e-6; clustered values leave a mixture, not an error
    assert sigma_min(model, law, work, law.grounded[row]) == pytest.approx(indices.sigma_min_B, rel=1e-3)


def test_smallest_singular_value_of_every_sample(simulated):
    """Along a motion the smallest singular vector turns and is orthogonal to any fixed one somewhere: no sample may
    show the second smallest value instead. Singular values by numpy."""
    record = simulated("snake_operator", None)
    plant = snake.build(snake.Config(controlled_point="gripper"), BuildContext(1.0))
    controller = task_space.build(task_space.Config(), BuildContext(1.0, plant))
    model, numbers = plant.arrays(), controller.modes.numbers
    dense = [
        conditioning(model, controller.law, numbers.index(mode), base, phi).sigma_min_B
        for mode, base, phi in zip(record["mode"], record["base_pose"], record["phi"], strict=True)
    ]
    # The iteration ends at a relative change of 1e-6; where the two smallest are within 3 %, it is then 1e-3 off.
    np.testing.assert_allclose(record["sigma_min"], dense, rtol=5e-3)


def test_singularity_is_of_B_where_psi2_and_psi3_make_a_right_angle():
    """[T] does not consider singularities "because the robot in the paper has many active wheels": true of A only."""
    plant = snake.build(snake.Config(), BuildContext(1.0))
    law, model = task_space.build(task_space.Config(), BuildContext(1.0, plant)).law, plant.arrays()
    phi = plant.initial_joints.copy()
    phi[3] = np.pi / 2 - phi[5]
    indices = conditioning(model, law, 0, np.zeros(3), phi)
    assert indices.sigma_min_B < 1e-12
    assert indices.rank_B == indices.rows - 1
    assert indices.sigma_min_A > 0.4  # 0.67 at the initial posture
    assert indices.rank_A == 7


def test_damping_keeps_rates_finite_at_the_singularity_and_leaves_the_null_space_alone():
    plant = snake.build(snake.Config(), BuildContext(1.0))
    law, model = task_space.build(task_space.Config(limit_policy="none"), BuildContext(1.0, plant)).law, plant.arrays()
    phi = plant.initial_joints.copy()
    phi[3] = np.pi / 2 - phi[5]
    phi[5] = law.shape_target[0]
    up = np.array([0, 0, 0.05, 0, 0, 0])
    for offset in (0.0, 1e-9, 1e-6, 1e-3):
        phi[3] = np.pi / 2 - phi[5] + offset
        w, work = evaluate(model, law, phi, np.zeros(3), np.zeros(6), up, 0, 0.0)
        # the weakest direction asks for |A w'| / sigma undamped; damped at most |A w'| / (2 lambda)
        assert np.abs(work.u[:12]).max() < 0.1 / (2 * law.damping_factor)
    _, B, _, _ = dense(model, law, phi, w, 0)
    _, work = evaluate(model, law, phi, np.zeros(3), np.zeros(6), np.zeros(6), 0, 1.0)
    np.testing.assert_allclose(B @ work.u, 0.0, atol=1e-9)


@given(seeds, mode_rows)
@settings(max_examples=40, deadline=None)
def test_allocation_keeps_joints_within_limits_without_head_error(seed, row):
    """A joint at its limit is one more S row: its rate is bounded and B~ u = A~ w~' still holds exactly."""
    random = np.random.default_rng(seed)
    model, controller, phi = case(random, limit_policy="allocate")
    for j in random.choice(np.arange(6, 12), 2, replace=False):
        phi[j] = model.upper[j] * random.choice([-1, 1])
    velocity = random.normal(size=6) * 0.05
    w, work = evaluate(model, controller.law, phi, np.zeros(3), np.zeros(6), velocity, row, 0.1)
    free = work.at_limit != 2
    assert free.sum() >= 6
    bound = controller.law.limit_rate * np.stack([model.lower - phi, model.upper - phi])
    assert np.all(work.u[:12][free] >= bound[0][free] - 1e-9)
    assert np.all(work.u[:12][free] <= bound[1][free] + 1e-9)
    A, B, _, _ = dense(model, controller.law, phi, w, row)
    rate = np.append(velocity, -2.0 * (phi[5] - controller.law.shape_target[0]))
    np.testing.assert_allclose(B @ work.u, A @ rate, atol=1e-9)


@pytest.mark.parametrize("joint", range(12))
def test_a_slower_target_helps_but_against_a_joint_that_is_at_its_limit(joint):
    """Every joint is looked at: the last one too may be the one that no speed of the target moves on."""
    model, controller, phi = case(np.random.default_rng(0), limit_policy="allocate")
    law, work, side = controller.law, new_work(model), 1.0 if joint % 2 else -1.0
    limit = model.upper[joint] if side > 0.0 else model.lower[joint]
    work.at_limit[joint], work.u[joint] = 2, 0.5 * side * law.rate_limit
    phi[joint] = limit - 2.0 * AT_LIMIT * side
    assert is_too_fast(model, law, work, ss.JOINT_LIMIT, phi)
    assert not is_too_fast(model, law, work, ss.SINGULAR, phi)
    phi[joint] = limit - 0.5 * AT_LIMIT * side
    assert not is_too_fast(model, law, work, ss.JOINT_LIMIT, phi)


@pytest.mark.parametrize(
    ("plant", "controller", "names"),
    [
        # physics: with a shape controllable point n_h = 4 leaves three free head joints for four rows
        ({"head_joints": 4, "yaw_joints": 8}, {}, ["psi2", "3", "n_h = 4", "head_joints"]),
        ({}, {"shape_points_rad": {"psi1": -0.8, "psi2": -1.1, "psi3": 1.9}}, ["psi1, psi2, psi3", "3", "n_h = 6"]),
        ({"driven_side": "none"}, {"modes": {1: [1, 2, 3, 4, 5]}, "switching": {"order": [1]}},
         ["6 - 5 + 0 - 0 < 2", "[T] eq 16"]),
        ({}, {"modes": {1: []}, "switching": {"order": [1]},
              "shape_points_rad": {"psi3": 1.9, "theta3": 0, "theta4": 0}},
         ["1", "-1"]),
        # psi2 and psi3 both fixed: one pitch joint for height and pitch of a head without roll
        ({}, {"shape_points_rad": {"psi2": -1.1, "psi3": 1.9}}, ["plant.initial_joints_rad", "8", "14", "15"]),
        ({}, {"shape_points_rad": {"psi9": 0.0}}, ["controller.shape_points_rad", "'psi9'", "theta1"]),
        ({}, {"shape_points_rad": {"psi3": 2.0}}, ["controller.shape_points_rad", "psi3 = 2.0000", "1.9722 rad"]),
        ({}, {"modes": {1: [8]}}, ["controller.modes", "8", "7"]),
        ({}, {"fixing_mode": 7}, ["controller.fixing_mode", "7", "1, 2, 3, 4, 5, 6"]),
        ({}, {"gain": [2.0, 2.0]}, ["controller.gain", "2", "7"]),
        ({}, {"cost_matrix": [1.0]}, ["controller.cost_matrix", "1", "12"]),
    ],
)  # fmt: skip
def test_what_cannot_be_controlled_is_refused_with_the_reason(plant, controller, names):
    with raises(ModelError, *names):
        task_space.build(
            task_space.Config(**controller), BuildContext(1.0, snake.build(snake.Config(**plant), BuildContext(1.0)))
        )


def test_four_head_joints_are_enough_without_shape_points():
    """[T] eq 1 itself: n_h = 4 is controllable as long as no shape controllable point is used."""
    plant = snake.build(snake.Config(head_joints=4, yaw_joints=8), BuildContext(1.0))
    assert task_space.build(task_space.Config(shape_points_rad={}), BuildContext(1.0, plant)).law.shape_joints.size == 0
