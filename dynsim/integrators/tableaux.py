"""Coefficients of the methods."""

from __future__ import annotations

import math

import numpy as np

# DOPRI5: stage rows a_ij, with the solution as the last row, whose derivative is the next step's first stage.
A_DOPRI5 = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
        [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
NODE_DOPRI5 = np.array([0.0, 0.2, 0.3, 0.8, 8 / 9, 1.0, 1.0])
ERROR_DOPRI5 = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])

# Radau IIA of order 5, coefficients of Hairer and Wanner (Solving Ordinary Differential Equations II, IV.8): T⁻¹ A⁻¹ T
# has γ, and [[α, −β], [β, α]], on its diagonal. ERROR_RADAU: weights of the stages in h times the right side of the
# error estimate.
_ROOT = math.sqrt(6.0)
A_RADAU = np.array(
    [
        [(88 - 7 * _ROOT) / 360, (296 - 169 * _ROOT) / 1800, (-2 + 3 * _ROOT) / 225],
        [(296 + 169 * _ROOT) / 1800, (88 + 7 * _ROOT) / 360, (-2 - 3 * _ROOT) / 225],
        [(16 - _ROOT) / 36, (16 + _ROOT) / 36, 1 / 9],
    ]
)
NODE_RADAU = np.array([(4 - _ROOT) / 10, (4 + _ROOT) / 10, 1.0])
GAMMA_RADAU, ALPHA_RADAU, BETA_RADAU = 3.6378342527444957, 2.6810828736277523, 3.0504301992474105
T_RADAU = np.array(
    [
        [9.1232394870892942792e-02, -0.14125529502095420843, -3.0029194105147424492e-02],
        [0.24171793270710701896, 0.20412935229379993199, 0.38294211275726193779],
        [0.96604818261509293619, 1.0, 0.0],
    ]
)
T_INVERSE_RADAU = np.array(
    [
        [4.3255798900631553510, 0.33919925181580986954, 0.54177053993587487119],
        [-4.1787185915519047273, -0.32768282076106238708, 0.47662355450055045196],
        [-0.50287263494578687595, 2.5719269498556054292, -0.59603920482822492497],
    ]
)
ERROR_RADAU = np.array([-(13 + 7 * _ROOT) / 3, (-13 + 7 * _ROOT) / 3, -1 / 3])
