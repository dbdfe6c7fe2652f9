"""Events: a step is cut where a guard passes zero, and the next one starts there. Ticks: steps end at given times.

The event table has a guard for each event, its value at the last accepted step and the side of zero it was on. After a
step that error control has accepted the guards are evaluated from what the right-hand side has left in the workspace;
where one has passed zero the step is repeated, shorter, until it ends within ``event_tolerance`` beyond the root. The
root is that of the method's own solution, of its full order; that of the dense output, of lower order, would have to be
followed by such a step anyway.
"""

from __future__ import annotations

from dynsim.kernels.arrays import CURRENT, GAP, NORMAL_FORCE, QD, VOLTAGE, Q, Workspace
from dynsim.kernels.integrate.contact_events import NORMAL_GUARD, contact_guard, note_gaps, too_long
from dynsim.kernels.integrate.run import (
    AT_HIGH,
    AT_LOW,
    DIRECTION,
    EVENT_INDEX,
    EVENT_KIND,
    EVENT_LEVEL,
    FIRED,
    GRAZING,
    HIGH,
    LOGGED,
    LOW,
    NEXT_BREAK,
    ON_EVENT,
    RETURN,
    SEARCHING,
    SIDE,
    START_VALUE,
    STARTED,
    STATUS,
    STEP,
    STOP,
    STOPPED,
    TICK_COUNT,
    TICK_KIND,
    TICK_NEXT,
    TICK_PERIOD,
    TICK_PHASE,
    TIME,
    TURNED_BACK,
    VALUE,
    Run,
)
from dynsim.kernels.jit import internal_kernel
from dynsim.kernels.system import System
from dynsim.kernels.tree.points import point_position
from dynsim.kernels.tree.support import tip_margin

# Kinds of guards. A new one is a number here, a branch in ``guard`` and a name in GUARDS of dynsim.engine.stepped.
# Those of the unilateral law, from NORMAL_GUARD on, are in dynsim.kernels.integrate.contact_events.
JOINT_POSITION, JOINT_RATE, MOTOR_CURRENT, MOTOR_VOLTAGE, CONTACT_FORCE, CONTACT_GAP = 0, 1, 2, 3, 4, 5
HAND_X, HAND_Y, HAND_Z = 6, 7, 8
TIP_MARGIN = 9

# Steps that a root may take; regula falsi with halving (Illinois) needs about eight. Guards that jump, as forces do
# where another split of them begins, are bisected in the end. Once there were too many the next one is the last.
SEARCH_LIMIT, FALSI_LIMIT = 60, 16


@internal_kernel
def guard(system: System, t, ws: Workspace, run: Run, e):
    """Value of event e, zero where it happens, right after ``derivative`` at time t."""
    kind, k, value = run.event_table[e, EVENT_KIND], run.event_table[e, EVENT_INDEX], 0.0
    if kind == JOINT_POSITION:
        value = ws.joints[k, Q]
    elif kind == JOINT_RATE:
        value = ws.joints[k, QD]
    elif kind == MOTOR_CURRENT:
        value = ws.motors[k, CURRENT]
    elif kind == MOTOR_VOLTAGE:
        value = ws.motors[k, VOLTAGE]
    elif kind == CONTACT_FORCE:
        value = ws.contacts[k, NORMAL_FORCE]
    elif kind == CONTACT_GAP:
        value = ws.contacts[k, GAP]
    elif kind == TIP_MARGIN:
        value = tip_margin(system.model, system.loads, t, ws, run.support)
    elif kind >= NORMAL_GUARD:
        value = contact_guard(system.unilateral, ws, kind, k)
    else:
        point_position(ws, run.hand_link, run.hand_point, run.hand)
        value = run.hand[kind - HAND_X]
    return value - run.event[e, EVENT_LEVEL]


@internal_kernel
def arm_events(system: System, ws: Workspace, run: Run):
    """Values and sides of all guards at the start of a step, right after ``derivative`` there.

    An event that has just happened keeps the side it has gone to, whatever rounding says of its guard.
    """
    for e in range(run.event.shape[0]):
        value = guard(system, run.clock[TIME], ws, run, e)
        run.event[e, START_VALUE] = value
        if run.event[e, SIDE] == 0.0:
            run.event[e, SIDE] = 1.0 if value > 0.0 else (-1.0 if value < 0.0 else 0.0)
    note_gaps(ws, run.gaps)


@internal_kernel
def happened(run: Run, e, value):
    """True when the guard of event e has passed zero in its direction once it has this value."""
    side, direction = run.event[e, SIDE], run.event_table[e, DIRECTION]
    return side != 0.0 and value * side <= 0.0 and (direction == 0 or direction * side < 0.0)


@internal_kernel
def event_tolerance(t):
    """Bracket of a root that is narrow enough [s]: some roundings of the time."""
    return 1e-13 + 1e-15 * abs(t)


@internal_kernel
def cut_step(system: System, ws: Workspace, run: Run):
    """True when the step just taken must be repeated because an event lies within it: STEP is then the next trial.

    False leaves FIRED at 1 when the step ends at an event.
    """
    clock, count, event = run.clock, run.count, run.event
    h, hit = clock[STEP], False
    for e in range(event.shape[0]):
        event[e, VALUE] = guard(system, clock[TIME] + h, ws, run, e)
        hit = happened(run, e, event[e, VALUE]) or hit
    if count[SEARCHING] == 0:
        if not hit:
            return passes_over(system, ws, run)
        clock[LOW], clock[HIGH], count[TURNED_BACK] = 0.0, h, 0
        for e in range(event.shape[0]):
            event[e, AT_LOW], event[e, AT_HIGH] = event[e, START_VALUE], event[e, VALUE]
    else:
        side = 1 if hit else -1
        repeated = count[TURNED_BACK] == side
        count[TURNED_BACK] = side
        if hit:
            clock[HIGH] = h
        else:
            clock[LOW] = h
        for e in range(event.shape[0]):
            if hit:
                event[e, AT_HIGH] = event[e, VALUE]
                event[e, AT_LOW] *= 0.5 if repeated else 1.0
            else:
                event[e, AT_LOW] = event[e, VALUE]
                event[e, AT_HIGH] *= 0.5 if repeated else 1.0
    count[SEARCHING] += 1
    low, high = clock[LOW], clock[HIGH]
    if high - low <= event_tolerance(clock[TIME]) or count[SEARCHING] > SEARCH_LIMIT:
        # A step of RADAU5 taken again is not the same to the bit, since its Newton method goes by how the last one has
        # contracted: at HIGH it may miss what had passed zero there, some times or for ever.
        if h == high and (hit or count[SEARCHING] > SEARCH_LIMIT):
            if not hit:
                keep_passed(run)
            count[SEARCHING], count[FIRED] = 0, 1
            return False
        clock[STEP] = high
        return True
    trial = high
    for e in range(event.shape[0]):
        a, b = event[e, AT_LOW], event[e, AT_HIGH]
        if happened(run, e, b) and not happened(run, e, a):
            trial = min(trial, low + (high - low) * a / (a - b))
    if not low < trial < high or count[SEARCHING] > FALSI_LIMIT:
        trial = 0.5 * (low + high)
    clock[STEP] = trial
    return True


@internal_kernel
def keep_passed(run: Run):
    """Events that had passed zero at HIGH keep the value that they had there: whoever does as they say looks at it."""
    for e in range(run.event.shape[0]):
        if happened(run, e, run.event[e, AT_HIGH]):
            run.event[e, VALUE] = run.event[e, AT_HIGH]


@internal_kernel
def passes_over(system: System, ws: Workspace, run: Run):
    """True when a contact has been passed over within the step: STEP is then the one to take instead."""
    part = too_long(system.unilateral, ws, run.clock[STEP], run.gaps)
    # What is none, after all, does not shorten steps for ever, nor to nothing.
    shorter = part * run.clock[STEP] > event_tolerance(run.clock[TIME])
    if part < 1.0 and shorter and run.count[GRAZING] < SEARCH_LIMIT:
        run.count[GRAZING] += 1
        run.clock[STEP] *= part
        return True
    run.count[GRAZING] = 0
    return False


@internal_kernel
def fire_events(run: Run):
    """Log the events that the accepted step ends at, and do as they say; True when the caller is to look."""
    count, event, look = run.count, run.event, False
    for e in range(event.shape[0]):
        if count[FIRED] == 1 and happened(run, e, event[e, VALUE]):
            action = run.event_table[e, ON_EVENT]
            if count[LOGGED] < run.log_time.shape[0]:
                run.log_time[count[LOGGED]] = run.clock[TIME]
                run.log_event[count[LOGGED]] = e
                count[LOGGED] += 1
            event[e, SIDE] = -event[e, SIDE]
            if action == STOP:
                count[STATUS] = STOPPED
            look = look or action == RETURN
        elif event[e, VALUE] != 0.0:
            event[e, SIDE] = 1.0 if event[e, VALUE] > 0.0 else -1.0
        event[e, START_VALUE] = event[e, VALUE]
    count[FIRED] = 0
    return look or count[LOGGED] == run.log_time.shape[0]


@internal_kernel
def next_tick(run: Run, until):
    """The earliest tick or break, or ``until`` when that comes first [s].

    A step to a break ends some roundings before it, so that its last stage lies on the near side of a jump.
    """
    for k in range(run.tick.shape[0]):
        until = min(until, run.tick[k, TICK_NEXT])
    k = run.count[NEXT_BREAK]
    if k < run.breaks.shape[0]:
        until = min(until, run.breaks[k] - 1e-14 * max(1.0, abs(run.breaks[k])))
    return until


@internal_kernel
def take_ticks(run: Run):
    """Kinds of the ticks that are due, as a sum of their bits; moves them on and TIME exactly to where they are.

    At a break the next step starts anew.
    """
    due, clock, tick, k = 0, run.clock, run.tick, run.count[NEXT_BREAK]
    while k < run.breaks.shape[0] and run.breaks[k] - clock[TIME] <= 1e-12 * max(1.0, abs(clock[TIME])):
        clock[TIME] = max(clock[TIME], run.breaks[k])
        run.count[STARTED] = 0
        k += 1
    run.count[NEXT_BREAK] = k
    for k in range(tick.shape[0]):
        if tick[k, TICK_NEXT] - clock[TIME] <= 1e-12 * max(1.0, abs(clock[TIME])):
            clock[TIME] = tick[k, TICK_NEXT]
            run.tick_table[k, TICK_COUNT] += 1
            # Not a sum of periods, whose roundings would add up.
            tick[k, TICK_NEXT] = tick[k, TICK_PHASE] + run.tick_table[k, TICK_COUNT] * tick[k, TICK_PERIOD]
            due |= run.tick_table[k, TICK_KIND]
    return due
