"""Event location: a step ends when a guard function crosses zero; ticks end steps at given times.

The event table contains the guard of each event, its value at the last accepted step and its side of zero there. After
a step that error control has accepted, the guards are evaluated from the workspace of the right-hand side. If a guard
has crossed zero, the step is repeated with shorter lengths until it ends within ``event_tolerance`` beyond the root.
The root thus belongs to the method's own solution, not to the dense output, whose order is lower.

A guard may also cross zero twice within a step. The guards of this file are recorded at two inner stages, where the
derivative is evaluated anyway. The cubic through these values and the values at the ends reveals the crossings, and the
step is cut there.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import point_position
from dynsim.dynamics.tree.support import tip_margin
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as ke
from dynsim.integrators.contacts.events import contact_guard, lowest, note_gaps, too_long
from dynsim.integrators.run import Run
from dynsim.jit.kernel import internal_kernel

# Kinds of guards. To add one, add a number here, a branch in ``guard`` and a name in GUARDS of dynsim.engine.stepped.
# Guards of the unilateral law, from NORMAL_GUARD on, are in dynsim.integrators.contacts.events.
JOINT_POSITION, JOINT_RATE, MOTOR_CURRENT, MOTOR_VOLTAGE, CONTACT_FORCE, CONTACT_GAP = 0, 1, 2, 3, 4, 5
HAND_X, HAND_Y, HAND_Z = 6, 7, 8
TIP_MARGIN = 9

# Maximum number of trial steps for a root; the Illinois method (regula falsi with halving) needs about eight. After
# FALSI_LIMIT trials the bracket is bisected, because some guards jump, such as forces when their split changes; after
# SEARCH_LIMIT trials, one more trial follows.
SEARCH_LIMIT, FALSI_LIMIT = 60, 16
# A step also ends at a turning point that misses zero by at most this fraction of the way back, because the cubic is
# not exact. The next step is more accurate, because one of its ends is next to the turning point.
SHORT_OF_ZERO = 0.1
# A guard that turns back by less than this fraction of its level, or of its unit, is constant up to rounding.
ROUNDING = 1e-12


@internal_kernel
def guard(system: System, t, ws: Workspace, run: Run, e):
    """Return the guard of event e, which is zero at the event; call right after ``derivative`` at time t."""
    kind, k, value = run.event_table[e, ki.EVENT_KIND], run.event_table[e, ki.EVENT_INDEX], 0.0
    if kind == JOINT_POSITION:
        value = ws.joints[k, ka.Q]
    elif kind == JOINT_RATE:
        value = ws.joints[k, ka.QD]
    elif kind == MOTOR_CURRENT:
        value = ws.motors[k, ka.CURRENT]
    elif kind == MOTOR_VOLTAGE:
        value = ws.motors[k, ka.VOLTAGE]
    elif kind == CONTACT_FORCE:
        value = ws.contacts[k, ka.NORMAL_FORCE]
    elif kind == CONTACT_GAP:
        value = ws.contacts[k, ka.GAP]
    elif kind == TIP_MARGIN:
        value = tip_margin(system.model, system.loads, t, ws, run.support)
    elif kind >= ke.NORMAL_GUARD:
        value = contact_guard(system.contacts, system.unilateral, ws, kind, k)
    else:
        point_position(ws, run.hand_link, run.hand_point, run.hand)
        value = run.hand[kind - HAND_X]
    return value - run.event[e, ki.EVENT_LEVEL]


@internal_kernel
def note_inside(system: System, ws: Workspace, run: Run, inner, x):
    """Record the guards at fraction x of the current step for `turns_within`; call right after ``derivative`` there.

    Of the guards of the unilateral law, only the forces of closed contacts are recorded, because :func:`too_long`
    checks gaps and slip. The other guards are NaN.
    """
    run.clock[ki.INNER + inner] = x
    for e in range(run.event.shape[0]):
        value = math.nan
        if run.event_table[e, ki.EVENT_KIND] < ke.NORMAL_GUARD or presses(system.unilateral, ws, run, e):
            t = run.clock[ki.TIME] + x * run.clock[ki.STEP]
            value = guard(system, t, ws, run, e)
        run.event[e, ki.INNER_VALUE + inner] = value


@internal_kernel
def presses(unilateral: UnilateralArrays | None, ws: Workspace, run: Run, e):
    """Return whether event e is the loss of a closed contact's force, and the motion determines this force."""
    if unilateral is None:  # resolved at compile time
        return False
    if run.event_table[e, ki.EVENT_KIND] != ke.NORMAL_GUARD or unilateral.number[ku.SPLIT] == 1.0:
        return False
    return ws.active[run.event_table[e, ki.EVENT_INDEX], ka.MODE] != ka.OPEN


@internal_kernel
def rounding(run: Run, e):
    """Return the largest guard value of event e that may be a rounding error."""
    return ROUNDING * max(1.0, abs(run.event[e, ki.EVENT_LEVEL]))


@internal_kernel
def turns_within(run: Run):
    """Return the fraction of the step just taken at which a guard that crosses zero twice turns back, or 1.

    The function uses the cubic through the guard's values at both ends and at two stages. The direction of the event
    does not matter, because one of the two crossings has this direction.
    """
    fraction, event, a, b = 1.0, run.event, run.clock[ki.INNER], run.clock[ki.INNER + 1]
    for e in range(event.shape[0]):
        if math.isnan(event[e, ki.INNER_VALUE]) or math.isnan(event[e, ki.INNER_VALUE + 1]):
            continue
        side = event[e, ki.SIDE] if event[e, ki.SIDE] != 0.0 else (1.0 if event[e, ki.VALUE] > 0.0 else -1.0)
        g0, g1 = side * event[e, ki.START_VALUE], side * event[e, ki.VALUE]
        ga, gb = side * event[e, ki.INNER_VALUE], side * event[e, ki.INNER_VALUE + 1]
        # Compute Newton's divided differences, then the coefficients of the powers of x.
        first, between = (ga - g0) / a, (gb - ga) / (b - a)
        second = (between - first) / b
        third = ((g1 - gb) / (1.0 - b) - between) / (1.0 - a) - second
        slope, bend = first - a * (second - b * third), second - (a + b) * third
        x = lowest(slope, bend, third)
        nearest, least = min(g0, g1), g0 + x * (slope + x * (bend + x * third))
        back = nearest - least
        # If the end is far beyond zero, the guard has crossed once, in the direction that does not count.
        passes = least < SHORT_OF_ZERO * back and nearest > -SHORT_OF_ZERO * back
        if x < 1.0 and back > rounding(run, e) and passes:
            fraction = min(fraction, x)
    return fraction


@internal_kernel
def arm_events(system: System, ws: Workspace, run: Run):
    """Set the values and sides of all guards at the start of a step; call right after ``derivative`` there.

    An event that has just occurred keeps its new side, regardless of rounding errors of its guard.
    """
    for e in range(run.event.shape[0]):
        value = guard(system, run.clock[ki.TIME], ws, run, e)
        run.event[e, ki.START_VALUE] = value
        if run.event[e, ki.SIDE] == 0.0:
            run.event[e, ki.SIDE] = 1.0 if value > 0.0 else (-1.0 if value < 0.0 else 0.0)
    note_gaps(system.model, system.contacts, system.unilateral, ws, run.gaps)


@internal_kernel
def happened(run: Run, e, value):
    """Return whether a value of the guard of event e means that it has crossed zero in the event's direction."""
    side, direction = run.event[e, ki.SIDE], run.event_table[e, ki.DIRECTION]
    return side != 0.0 and value * side <= 0.0 and (direction == 0 or direction * side < 0.0)


@internal_kernel
def event_tolerance(t):
    """Return the bracket width at which a root counts as located [s]: a few rounding errors of the time."""
    return 1e-13 + 1e-15 * abs(t)


@internal_kernel
def cut_step(system: System, ws: Workspace, run: Run):
    """Return whether the step just taken must be repeated because an event lies within it; STEP is then the next trial.

    If False, FIRED is 1 if the step ends at an event.
    """
    clock, count, event = run.clock, run.count, run.event
    h, hit = clock[ki.STEP], False
    for e in range(event.shape[0]):
        event[e, ki.VALUE] = guard(system, clock[ki.TIME] + h, ws, run, e)
        hit = happened(run, e, event[e, ki.VALUE]) or hit
    if count[ki.SEARCHING] == 0:
        if not hit:
            return passes_over(system, ws, run)
        clock[ki.LOW], clock[ki.HIGH], count[ki.TURNED_BACK] = 0.0, h, 0
        for e in range(event.shape[0]):
            event[e, ki.AT_LOW], event[e, ki.AT_HIGH] = event[e, ki.START_VALUE], event[e, ki.VALUE]
    else:
        side = 1 if hit else -1
        repeated = count[ki.TURNED_BACK] == side
        count[ki.TURNED_BACK] = side
        if hit:
            clock[ki.HIGH] = h
        else:
            clock[ki.LOW] = h
        for e in range(event.shape[0]):
            if hit:
                event[e, ki.AT_HIGH] = event[e, ki.VALUE]
                event[e, ki.AT_LOW] *= 0.5 if repeated else 1.0
            else:
                event[e, ki.AT_LOW] = event[e, ki.VALUE]
                event[e, ki.AT_HIGH] *= 0.5 if repeated else 1.0
    count[ki.SEARCHING] += 1
    low, high = clock[ki.LOW], clock[ki.HIGH]
    if high - low <= event_tolerance(clock[ki.TIME]) or count[ki.SEARCHING] > SEARCH_LIMIT:
        # A repeated step of RADAU5 is not bit-identical, because its Newton method depends on the contraction of the
        # previous step. At HIGH, it may therefore miss a guard that had crossed zero there, sometimes or every time.
        if h == high and (hit or count[ki.SEARCHING] > SEARCH_LIMIT):
            if not hit:
                keep_passed(run)
            count[ki.SEARCHING] = 0
            # Contacts and turning points that the step passed over before the event must be handled first.
            if passes_over(system, ws, run):
                return True
            count[ki.FIRED] = 1
            return False
        clock[ki.STEP] = high
        return True
    trial = high
    for e in range(event.shape[0]):
        a, b = event[e, ki.AT_LOW], event[e, ki.AT_HIGH]
        if happened(run, e, b) and not happened(run, e, a):
            # A secant from the root just located leads back to this root, where the sign of the guard is rounding.
            known = low == 0.0 and run.event_table[e, ki.EVENT_KIND] < ke.NORMAL_GUARD and abs(a) <= rounding(run, e)
            trial = min(trial, low + (high - low) * (0.5 if known else a / (a - b)))
    if not low < trial < high or count[ki.SEARCHING] > FALSI_LIMIT:
        trial = 0.5 * (low + high)
    clock[ki.STEP] = trial
    return True


@internal_kernel
def keep_passed(run: Run):
    """Save the values at HIGH of events that had crossed zero there, for the functions that act on events."""
    for e in range(run.event.shape[0]):
        if happened(run, e, run.event[e, ki.AT_HIGH]):
            run.event[e, ki.VALUE] = run.event[e, ki.AT_HIGH]


@internal_kernel
def passes_over(system: System, ws: Workspace, run: Run):
    """Return whether the step has passed over a contact, a slip reversal or a level; STEP is then the step to take."""
    part = too_long(system.model, system.contacts, system.unilateral, ws, run.clock[ki.STEP], run.gaps)
    part = min(part, turns_within(run))
    # A false alarm must not shorten steps indefinitely, or to zero.
    shorter = part * run.clock[ki.STEP] > event_tolerance(run.clock[ki.TIME])
    if part < 1.0 and shorter and run.count[ki.GRAZING] < SEARCH_LIMIT:
        run.count[ki.GRAZING] += 1
        run.clock[ki.STEP] *= part
        return True
    run.count[ki.GRAZING] = 0
    return False


@internal_kernel
def fire_events(run: Run):
    """Log and handle the events at the end of the accepted step; return whether control must return to the caller."""
    count, event, look = run.count, run.event, False
    for e in range(event.shape[0]):
        if count[ki.FIRED] == 1 and happened(run, e, event[e, ki.VALUE]):
            action = run.event_table[e, ki.ON_EVENT]
            ke.log(run, e)
            event[e, ki.SIDE] = -event[e, ki.SIDE]
            if action == ki.STOP:
                count[ki.STATUS] = ki.STOPPED
            look = look or action == ki.RETURN
        elif event[e, ki.VALUE] != 0.0:
            event[e, ki.SIDE] = 1.0 if event[e, ki.VALUE] > 0.0 else -1.0
        event[e, ki.START_VALUE] = event[e, ki.VALUE]
    count[ki.FIRED] = 0
    return look or count[ki.LOGGED] == run.log_time.shape[0]


@internal_kernel
def next_tick(run: Run, until):
    """Return the earliest tick or break, or ``until`` if that is earlier [s].

    A step to a break ends a few rounding errors before it, so that its last stage is on the near side of a jump.
    """
    for k in range(run.tick.shape[0]):
        until = min(until, run.tick[k, ki.TICK_NEXT])
    k = run.count[ki.NEXT_BREAK]
    if k < run.breaks.shape[0]:
        until = min(until, run.breaks[k] - 1e-14 * max(1.0, abs(run.breaks[k])))
    return until


@internal_kernel
def take_ticks(run: Run, line):
    """Return the kinds of the due ticks, as a sum of their bits; advance them, and set TIME exactly to them.

    A tick with queued references writes them to ``line``, the table of the drives, and does not count as due. The
    method restarts there and at a break.
    """
    due, clock, tick, k = 0, run.clock, run.tick, run.count[ki.NEXT_BREAK]
    while k < run.breaks.shape[0] and run.breaks[k] - clock[ki.TIME] <= 1e-12 * max(1.0, abs(clock[ki.TIME])):
        clock[ki.TIME] = max(clock[ki.TIME], run.breaks[k])
        run.count[ki.STARTED] = 0
        k += 1
    run.count[ki.NEXT_BREAK] = k
    for k in range(tick.shape[0]):
        if tick[k, ki.TICK_NEXT] - clock[ki.TIME] <= 1e-12 * max(1.0, abs(clock[ki.TIME])):
            clock[ki.TIME] = tick[k, ki.TICK_NEXT]
            run.tick_table[k, ki.TICK_COUNT] += 1
            # Do not sum periods, because rounding errors would accumulate.
            tick[k, ki.TICK_NEXT] = tick[k, ki.TICK_PHASE] + run.tick_table[k, ki.TICK_COUNT] * tick[k, ki.TICK_PERIOD]
            queued = run.tick_table[k, ki.TICK_QUEUED]
            if queued == 0:
                due |= run.tick_table[k, ki.TICK_KIND]
                continue
            for a in range(line.shape[0]):
                line[a, ka.LINE_START] = run.queue[ki.QUEUE_LENGTH - queued, a, 0]
                line[a, ka.LINE_RATE] = run.queue[ki.QUEUE_LENGTH - queued, a, 1]
                line[a, ka.LINE_SINCE] = clock[ki.TIME]
            run.tick_table[k, ki.TICK_QUEUED], run.count[ki.STARTED] = queued - 1, 0
    return due
