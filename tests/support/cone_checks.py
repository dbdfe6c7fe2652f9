"""Check of solutions of contact problems, by code independent of the solver."""

from __future__ import annotations

import numpy as np

from dynsim.dynamics.contact.cone.steps import BOTH_WAYS, BOX, CONE


def violation(W, b, kind, mu, f):
    """Return the largest violation of the conditions of the contact problem, in units of u, without a natural map."""
    u, worst, k = W @ f + b, 0.0, 0
    while k < len(b):
        w = np.trace(W[k : k + 3, k : k + 3]) / 3 if kind[k] == CONE else W[k, k]
        if kind[k] == BOTH_WAYS:
            worst = max(worst, abs(u[k]))
            k += 1
            continue
        if kind[k] == BOX:
            # Within the bounds it does not move; at a bound it moves against the force.
            worst = max(worst, w * (abs(f[k]) - mu[k]), min(abs(u[k]), abs(w * (f[k] + np.sign(u[k]) * mu[k]))))
            k += 1
            continue
        # One of the two vanishes, and neither is negative.
        worst = max(worst, min(abs(u[k]), abs(w * f[k])), -u[k], -w * f[k])
        if kind[k] == CONE:
            f_t, u_t = f[k + 1 : k + 3], u[k + 1 : k + 3]
            size, margin = np.linalg.norm(u_t), mu[k] * f[k] - np.linalg.norm(f_t)
            worst = max(worst, -w * margin)
            # Either it sticks, or it is on the cone and the force opposes the slip.
            opposed = np.linalg.norm(f_t * size + u_t * np.linalg.norm(f_t)) / max(size, np.linalg.norm(f_t), 1e-300)
            if mu[k] * f[k] > 0:
                worst = max(worst, min(size, max(abs(w * margin), min(opposed * w, opposed))))
            k += 2
        k += 1
    return worst
