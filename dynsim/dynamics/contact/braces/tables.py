"""Tables of the cone program for the forces of braces: braces and motors in, forces out, workspace."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.cone.program import ConeProgram, cone_program
from dynsim.jit.kernel import integers, reals

# BraceArrays.table
POINT = 0  # 3: in the body's frame [m]
AXES = 3  # 9: unit normal and two tangents in W, one after the other
SLIP = 12  # 2: unit direction of sliding along the tangents, zero for a brace that is held
FRICTION = 14
LEAST = 15  # min_N
COMMANDED = 16  # [N], NaN for none
# Target of the normal force of a brace [N], and its weight (compliance) [m/N]; zero for braces without a target.
# If any brace has a target, forces minimise Σ compliance (f_n − near)² instead of the heat.
NEAR, COMPLIANCE = 17, 18
BRACE_SIZE = 19
# BraceArrays.motors: a torque source has K_m = 1 and no resistance, a joint without a motor K_m = 1 and no current
HEAT = 0  # w = R / K_m² [W/(N m)²]
LOWER = 1  # torque limits at the present joint rate [N m], infinite for none; both zero without a motor
UPPER = 2
CONSTANT, RESISTANCE, VOLTAGE_LIMIT, CURRENT_LIMIT = 3, 4, 5, 6  # K_m [N m/A], R [Ω], U [V], I [A]
MOTOR_SIZE = 7
# BraceArrays.results: normal and tangential forces, then the ends of the interval of the normal force
FORCES, LOW, HIGH = 0, 3, 4
RESULT_SIZE = 5


class BraceArrays(NamedTuple):
    """Braces, motors, results and workspace."""

    link: np.ndarray  # (c,) int
    table: np.ndarray  # (c, BRACE_SIZE)
    motors: np.ndarray  # (n, MOTOR_SIZE)
    first: np.ndarray  # (c + 1,) int: the first unknown of each brace, and their number
    free: np.ndarray  # (n,) torques without the unknown forces [N m]
    torques: np.ndarray  # (n,) [N m]
    results: np.ndarray  # (c, RESULT_SIZE) [N]
    forces: np.ndarray  # (c, 3) on the arm in W [N]
    certificate: np.ndarray  # (n,) see brace_statics
    B: np.ndarray  # (3 c, n) a row for each unknown
    inside: np.ndarray  # (3 c,) scratch
    position: np.ndarray  # (3,) scratch
    jacobian: np.ndarray  # (3, n) scratch
    program: ConeProgram


def brace_arrays(link: np.ndarray, motors: np.ndarray) -> BraceArrays:
    """Allocate a :class:`BraceArrays` for braces on these links and for these motors."""
    c, n = len(link), len(motors)
    forces = ka.MOST_ROWS * c
    return BraceArrays(
        link=link,
        table=reals(np.zeros((c, BRACE_SIZE))),
        motors=motors,
        first=integers(np.zeros(c + 1)),
        free=reals(np.zeros(n)),
        torques=reals(np.zeros(n)),
        results=reals(np.zeros((c, RESULT_SIZE))),
        forces=reals(np.zeros((c, 3))),
        certificate=reals(np.zeros(n)),
        B=reals(np.zeros((forces, n))),
        inside=reals(np.zeros(forces)),
        position=reals(np.zeros(3)),
        jacobian=reals(np.zeros((3, n))),
        program=cone_program(forces + 1, n, 2 * c + 2 * n + 1, 4 * c + 2 * n + 1),
    )
