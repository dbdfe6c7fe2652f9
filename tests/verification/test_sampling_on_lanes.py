"""Samples of RADAU5 that lanes compute together, also when postponed until lanes are full, against single samples."""

from __future__ import annotations

import numpy as np
from support.random_robots import CompiledSystem, braced

from dynsim.integrators.run import EVALUATIONS, FINISHED, PROJECTIONS, SAMPLE, STATUS, TIME, Run

STEP = 5e-3


def unwaiting(b: CompiledSystem, y: np.ndarray, times: np.ndarray) -> Run:
    """A run whose samples are not postponed: it has a break of references, which lies after its end."""
    return b.advance(b.new_run(y, times, "radau5", step=STEP, fixed=True)._replace(breaks=np.array([1e3])))


def test_samples_together_are_samples_alone():
    """Seven to a step, which are four and three, against one to a step; some are projected, and alone then too."""
    rng = np.random.default_rng(3)
    b, q = braced(rng)
    y = b.state(q, rng.normal(size=len(b.robot.links)))
    middles = STEP * (np.arange(25) + 0.5)
    many = np.sort((middles + STEP * np.linspace(-0.45, 0.45, 7)[:, None]).ravel())
    end = STEP * 25
    together = b.advance(b.new_run(y, np.append(many, end), "radau5", step=STEP, fixed=True))
    alone = unwaiting(b, y, np.append(middles, end))
    assert together.count[SAMPLE] == 176
    assert alone.count[SAMPLE] == 26
    assert together.count[EVALUATIONS] - alone.count[EVALUATIONS] >= 150
    assert together.count[PROJECTIONS] > alone.count[PROJECTIONS]
    np.testing.assert_array_equal(together.y, alone.y)
    for computed, expected in ((together.sample, alone.sample), (together.output, alone.output)):
        scale = np.abs(expected).max(axis=0)
        assert np.all(np.abs(computed[3:175:7] - expected[:25]) <= 1e-9 * np.maximum(scale, scale.max() * 1e-3))


def test_samples_wait_for_each_other_whatever_ends_a_piece():
    """Fewer than one to a step: they wait for lanes that are free, and no piece of the run computes them otherwise."""
    rng = np.random.default_rng(5)
    b, q = braced(rng)
    y = b.state(q, rng.normal(size=len(b.robot.links)))
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
    single = unwaiting(b, y, times[[7, -1]])
    for name in ("vdot", "torque", "contact"):
        computed, expected = whole.outputs(name), single.outputs(name)
        assert np.abs(computed[7] - expected[0]).max() <= 1e-12 * np.abs(computed).max()
