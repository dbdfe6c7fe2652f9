"""Samples of RADAU5 that are computed together are those that are computed alone."""

from __future__ import annotations

import numpy as np
from random_robots import bench, random_contacts, random_positions, random_robot

from dynsim.kernels.integrate.run import EVALUATIONS, FINISHED, PROJECTIONS, SAMPLE, STATUS, TIME

STEP = 5e-3


def test_samples_together_are_samples_alone():
    """Seven to a step, which are four and three, against one to a step; some are projected, and alone then too."""
    rng = np.random.default_rng(3)
    robot = random_robot(rng, 7)
    q = random_positions(rng, robot)
    b = bench(robot, random_contacts(rng, robot, q, 2), k_p=0.3, k_d=0.01)
    y = b.state(q, rng.normal(size=len(robot.links)))
    middles = STEP * (np.arange(25) + 0.5)
    many = np.sort((middles + STEP * np.linspace(-0.45, 0.45, 7)[:, None]).ravel())
    end = STEP * 25
    together = b.advance(b.new_run(y, np.append(many, end), "radau5", step=STEP, fixed=True))
    alone = b.advance(b.new_run(y, np.append(middles, end), "radau5", step=STEP, fixed=True))
    assert together.count[SAMPLE] == 176
    assert alone.count[SAMPLE] == 26
    assert together.count[EVALUATIONS] - alone.count[EVALUATIONS] >= 150
    assert together.count[PROJECTIONS] > alone.count[PROJECTIONS]
    np.testing.assert_array_equal(together.y, alone.y)
    for found, expected in ((together.sample, alone.sample), (together.output, alone.output)):
        scale = np.abs(expected).max(axis=0)
        assert np.all(np.abs(found[3:175:7] - expected[:25]) <= 1e-9 * np.maximum(scale, scale.max() * 1e-3))


def test_samples_wait_for_each_other_whatever_ends_a_piece():
    """Fewer than one to a step: they wait for lanes that are free, and no piece of the run computes them otherwise."""
    rng = np.random.default_rng(5)
    robot = random_robot(rng, 7)
    q = random_positions(rng, robot)
    b = bench(robot, random_contacts(rng, robot, q, 2), k_p=0.3, k_d=0.01)
    y = b.state(q, rng.normal(size=len(robot.links)))
    times = np.linspace(0.0, 25 * STEP, 19)
    whole = b.advance(b.new_run(y, times, "radau5", step=STEP, fixed=True))
    pieces = b.new_run(y, times, "radau5", step=STEP, fixed=True)
    late = []
    while pieces.count[STATUS] != FINISHED:
        b.advance(pieces, 1)
        late.append(np.count_nonzero(times <= pieces.clock[TIME]) - pieces.count[SAMPLE])
    assert 0 < max(late) <= 3
    assert late[-1] == 0
    assert whole.count[SAMPLE] == len(times)
    np.testing.assert_array_equal(pieces.output, whole.output)
    np.testing.assert_array_equal(pieces.sample, whole.sample)
    one = b.advance(b.new_run(y, times[[7, -1]], "radau5", step=STEP, fixed=True))
    for name in ("vdot", "torque", "contact"):
        found, expected = whole.outputs(name), one.outputs(name)
        assert np.abs(found[7] - expected[0]).max() <= 1e-12 * np.abs(found).max()
