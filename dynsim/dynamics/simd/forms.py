"""Variants for SIMD lanes of kernels that branch on data: with selects, or the kernel itself lane by lane.

The compiler takes them in place of the kernels for arguments with lanes only. All other kernels are compiled for lanes
from their own source.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact import uniqueness as kq
from dynsim.dynamics.contact.delassus import solve_dependent, solve_small
from dynsim.dynamics.contact.quadrics import sign_changed, surface_distance
from dynsim.dynamics.contact.shares import solve_near_shares, solve_nearest
from dynsim.dynamics.contact.splits import admissible_forces, look_at_forces
from dynsim.dynamics.contact.unilateral import slide_direction, sliding_friction
from dynsim.dynamics.contact.uniqueness import clearly_unique
from dynsim.dynamics.drive.law import evaluate_reference, fed_forward
from dynsim.dynamics.drive.limit import clipped
from dynsim.dynamics.drive.servo import servo_circuit
from dynsim.dynamics.simd.tables import lane, lane_count, with_lane
from dynsim.dynamics.tree.loads import add_loads
from dynsim.jit.compiler import form_of
from dynsim.jit.simd import every, lanes_of, select


def any_lanes(*kinds):
    """True if any argument has lanes."""
    return lanes_of(*kinds) > 0


def times(*kinds):
    """True if there are several times: t is the third argument."""
    return lanes_of(kinds[2]) > 0


@form_of(clipped, any_lanes)
def clipped_lanes(x, limit):
    """A lane within its limits; NaN stays NaN."""
    return select(x > limit, limit, select(x < -limit, -limit, x))


@form_of(servo_circuit, any_lanes)
def servo_circuit_lanes(motor, a, mode, command, v):
    """Voltage and current; lanes at the limit of current have another voltage."""
    if mode == ka.OFF:
        return motor[a, ka.K_M] * v, 0.0 * v
    u = clipped(command, motor[a, ka.U_MAX])
    wanted = (u - motor[a, ka.K_M] * v) / motor[a, ka.RESISTANCE]
    i = clipped(wanted, motor[a, ka.I_MAX])
    return select(i != wanted, motor[a, ka.RESISTANCE] * i + motor[a, ka.K_M] * v, u), i


@form_of(surface_distance, any_lanes)
def surface_distance_lanes(value, slope, curvature):
    """Lanes without a root along the normal take the distance of first order."""
    inner = 1.0 - 2.0 * curvature * value / (slope * slope)
    return select(inner <= 0.0, value / slope, 2.0 * value / (slope * (1.0 + math.sqrt(inner))))


@form_of(solve_small, any_lanes)
def solve_small_lanes(small, state, active, p):
    """Use the closed forms if they hold for all lanes, else the kernel for each lane; return the sum of its results."""
    if p == 1 and every(abs(small[0, 0, 0]) > state[0, ka.ROW_FLOOR]):
        state[0, ka.FORCE] = state[0, ka.RHS] / small[0, 0, 0]
        return 0
    if p == 2:
        a, b, c, d = small[0, 0, 0], small[0, 0, 1], small[0, 1, 0], small[0, 1, 1]
        determinant = a * d - b * c
        floors = state[0, ka.ROW_FLOOR] * state[1, ka.ROW_FLOOR]
        if every(abs(determinant) > 1e-3 * (abs(a * d) + abs(b * c)) + floors):
            x, y = state[0, ka.RHS] / determinant, state[1, ka.RHS] / determinant
            state[0, ka.FORCE], state[1, ka.FORCE] = d * x - b * y, a * y - c * x
            return 0
    dependent = 0
    for k in range(lane_count(small)):
        dependent += solve_small(lane(small, k), lane(state, k), active, p)
    return dependent


@form_of(solve_dependent, any_lanes)
def solve_dependent_lanes(small, state, active, p):
    """One by one."""
    dependent = 0
    for k in range(lane_count(small)):
        dependent += solve_dependent(lane(small, k), lane(state, k), active, p)
    return dependent


@form_of(solve_near_shares, any_lanes)
def solve_near_shares_lanes(unilateral, ws, p):
    """One by one."""
    dependent = 0
    for k in range(lane_count(ws)):
        dependent += solve_nearest(unilateral, lane(ws, k), p)
    return dependent


@form_of(clearly_unique, any_lanes)
def all_clearly_unique(ws):
    """True if every lane is clearly unique."""
    small, p = ws.small, ws.counts[ka.ROWS]
    if p == 0 or p > 2:
        return p == 0
    for k in range(p):
        if ws.active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE or not every(small[0, k, k] > 0.0):
            return False
    if p == 1:
        return True
    straight, crossed = small[0, 0, 0] * small[0, 1, 1], small[0, 0, 1] * small[0, 1, 0]
    return every(straight - crossed > kq.CLEAR * (straight + abs(crossed)))


@form_of(slide_direction, any_lanes)
def slide_direction_lanes(unilateral, contacts, k, slip, n):
    """Each lane's own direction; ``unilateral.slide`` keeps the speed of the last state that was evaluated alone."""
    slide, (x, y, z) = unilateral.slide, slip
    a, b, c = slide[k, ku.REFERENCE], slide[k, ku.REFERENCE + 1], slide[k, ku.REFERENCE + 2]
    along = x * a + y * b + z * c
    if slide[k, ku.FROZEN] == 1.0:
        slow, up = unilateral.number[ku.SLOW], a * n[0] + b * n[1] + c * n[2]
        more = select(along < slow, slow - along, 0.0)
        a, b, c = a - up * n[0], b - up * n[1], c - up * n[2]
        u, v, w = x + more * a, y + more * b, z + more * c
        size = math.sqrt(u * u + v * v + w * w)
        moves = size > 0.0
        a, b, c = select(moves, u / size, a), select(moves, v / size, b), select(moves, w / size, c)
        speed = x * a + y * b + z * c
    else:
        size = math.sqrt(x * x + y * y + z * z)
        moves, on = size > 0.0, along >= 0.0
        scale = select(on, 1.0 / size, -1.0 / size)
        a, b, c = select(moves, x * scale, a), select(moves, y * scale, b), select(moves, z * scale, c)
        speed = select(moves, select(on, size, -size), along)
    return a, b, c, sliding_friction(contacts.law, k, speed)


@form_of(admissible_forces, any_lanes)
def admissible_forces_lanes(model, contacts, unilateral, ws):
    """One by one, where there is something to look at."""
    if unilateral is None:  # known to the compiler
        return
    if unilateral.number[ku.REDUNDANT] == 1.0 or unilateral.stop.shape[0] + unilateral.dry.shape[0] > 0:
        for k in range(lane_count(ws)):
            look_at_forces(model, contacts, unilateral, lane(ws, k))


@form_of(sign_changed, any_lanes)
def sign_changed_lanes(ws, passes):
    """True if any lane's signs have changed. The other lanes keep theirs: once they agree, they remain in agreement."""
    one_way = False
    for k in range(ws.counts[ka.ROWS]):
        if ws.active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
            one_way = True
    changed = False
    if one_way:
        for k in range(lane_count(ws)):
            if sign_changed(lane(ws, k), passes):
                changed = True
    return changed


@form_of(evaluate_reference, times)
def evaluate_reference_lanes(drives, reference, t, ws):
    """At several times, which may lie in different segments."""
    for k in range(lane_count(t)):
        evaluate_reference(drives, reference, lane(t, k), lane(ws, k))


@form_of(fed_forward, times)
def fed_forward_lanes(voltage, grid, t, a, asked):
    """The same of planned voltages."""
    if voltage.shape[0] == 0:
        return asked
    for k in range(lane_count(t)):
        asked = with_lane(asked, k, fed_forward(voltage, grid, lane(t, k), a, lane(asked, k)))
    return asked


@form_of(add_loads, times)
def add_loads_lanes(model, loads, t, ws, power, start):
    """The same of external wrenches."""
    for k in range(lane_count(t)):
        add_loads(model, loads, lane(t, k), lane(ws, k), lane(power, k), start)
