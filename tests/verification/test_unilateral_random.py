"""Random robots that land, slide, stick, rock and bounce fulfil the contact law."""

from __future__ import annotations

import numpy as np
from support.unilateral_checks import random_touch, violations

from dynsim.integrators import run as ki

# Reasons that may stop a run before its end: few runs, with wedged points or a paradox.
NAMED = (ki.FORCES_REVERSED, ki.SEVERAL_FORCES, ki.NO_CONTACT_FORCES, ki.CHATTER, ki.STEP_TOO_SMALL)
LIMITS = {
    "pull": 1e-9,
    "depth": 1e-9,
    "product": 1e-9,
    "cone": 1e-9,
    "against slip": 1e-9,
    "slip of what sticks": 5e-8,
    "ledger": 2e-7,
}


def test_every_sample_of_random_robots_keeps_to_the_law():
    finished = 0
    for seed in range(80):
        b, y = random_touch(seed)
        run = b.advance(b.new_run(y, np.linspace(0.0, 0.5, 51), "dopri5", rtol=1e-8), 20_000)
        assert run.count[ki.STATUS] == ki.FINISHED or run.count[ki.STATUS] in NAMED, seed
        finished += int(run.count[ki.STATUS] == ki.FINISHED)
        if run.count[ki.SAMPLE] > 0:
            for rule, size in violations(b, run).items():
                assert size <= LIMITS[rule], (seed, rule, size)
    assert finished >= 68
