"""Arrays of one integration: state, recorded rows, clock, counters, events, ticks; its methods and statuses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.dynamics import state as kst
from dynsim.dynamics.contact import uniqueness as kq
from dynsim.dynamics.simd.system import stage_lanes
from dynsim.dynamics.state import OutputLayout, StateLayout, block
from dynsim.dynamics.tables import row_limit, workspace
from dynsim.dynamics.tree.support import SupportArrays, no_support
from dynsim.integrators.radau5.tables import NewtonArrays, newton_arrays
from dynsim.integrators.stepping.tables import SteppingArrays
from dynsim.jit.kernel import integers, reals

DOPRI5, RADAU5, TIME_STEPPING = 0, 1, 2
METHODS = {"dopri5": DOPRI5, "radau5": RADAU5, "time_stepping": TIME_STEPPING}

RUNNING, FINISHED, NOT_FINITE, STEP_TOO_SMALL, NOT_PROJECTED, NO_FORCES = 0, 1, 2, 3, 4, 5
FORCES_REVERSED, SEVERAL_FORCES, STOPPED = 6, 7, 8
# Under the unilateral law: no forces agree with Coulomb's law; modes change without end.
NO_CONTACT_FORCES, CHATTER = 9, 10
# MOST_TRIALS steps made hardly any progress. Set by the caller: the wall time limit is over; a step does not end.
NO_PROGRESS, OUT_OF_TIME, STUCK = 11, 12, 13

# Run.clock
TIME, STEP, LAST_ERROR, END, RTOL, ATOL, STEP_MAX = 0, 1, 2, 3, 4, 5, 6
NOT_UNIQUE = 7  # end of the step at which the contact forces were not unique, which was not accepted [s]
# A step that would end beyond HOLD is left pending, not accepted; the step size proposed before a cut; error norm of
# the step taken; the bracket of the root that is searched, from TIME on [s].
HOLD, PROPOSED, ERROR, LOW, HIGH = 8, 9, 10, 11, 12
# Time at which trials were last counted from zero, and the least that MOST_TRIALS of them have to come on by [s].
COUNTED_SINCE, LEAST_PROGRESS = 13, 14
INNER = 15  # 2: the parts of the step at which guards are noted within it
CLOCK_SIZE = 17
# Run.count, int
STEPS, REJECTED, EVALUATIONS, PROJECTIONS, SAMPLE, STATUS, STARTED = 0, 1, 2, 3, 4, 5, 6
# A step waits to be accepted; trials of a root; which end of the bracket moved last; the step ends at an event; it ends
# at a tick; events in the log; bits of the ticks that the caller is to look at.
PENDING, SEARCHING, TURNED_BACK, FIRED, TRIMMED, LOGGED, TICKED = 7, 8, 9, 10, 11, 12, 13
NEXT_BREAK = 14  # index of the first of Run.breaks that is not past
MODES_DUE = 15  # contact modes are to be chosen at the next start, which is that of the run, or follows a jump of rates
GRAZING = 16  # how often the step was shortened because it passed over something
TRIALS = 17  # steps tried, accepted or not, since COUNTED_SINCE
ASKED = 18  # written by another thread: the piece is to end at the next step
COUNT_SIZE = 19
# Steps that are looked at together, and the part of a run's duration that they have to come on by.
MOST_TRIALS, PROGRESS = 10_000, 1e-6
AT_START, AFTER_JUMP = 1, 2
# Run.event, and Run.event_table, int
EVENT_LEVEL, SIDE, START_VALUE, VALUE, AT_LOW, AT_HIGH = 0, 1, 2, 3, 4, 5
INNER_VALUE = 6  # 2: at INNER
EVENT_SIZE = 8
EVENT_KIND, EVENT_INDEX, DIRECTION, ON_EVENT = 0, 1, 2, 3
EVENT_TABLE_SIZE = 4
# What an event does besides being logged: nothing, the caller looks, the run ends.
LOG, RETURN, STOP = 0, 1, 2
# Run.tick, and Run.tick_table, int. Kinds are bits.
TICK_PERIOD, TICK_NEXT, TICK_PHASE = 0, 1, 2
TICK_SIZE = 3
TICK_KIND, TICK_COUNT = 0, 1
TICK_TABLE_SIZE = 2
TAKE_COMMANDS, CALLER = 1, 2
LOG_LENGTH = 1024
GAPS_SIZE = 10
# Entries of Run.log_event from these numbers on are of contacts, of joint stops, and of joints with dry friction, see
# contact_events.
CONTACT_LOG, STOP_LOG, DRY_LOG = 1 << 20, 1 << 40, 1 << 50
# Run.extremes, per contact
FORCE_MIN, FORCE_MAX, DRIFT_MAX = 0, 1, 2
PULLING, LAST_FORCE = 3, 4  # time with a negative normal force [s]; normal force at the last accepted step [N]
LOCAL_SINCE = 5  # first time at which the contact's entry on the diagonal of J M⁻¹ F was negative [s], else inf
EXTREMES_SIZE = 6


class Run(NamedTuple):
    """The moving part of one simulation; m is the length of the state."""

    method: int
    layout: StateLayout
    y: np.ndarray  # (m,) state at TIME
    y_new: np.ndarray  # (m,)
    stage: np.ndarray  # (8, m) stage derivatives; stage[0] belongs to y
    dense: np.ndarray  # (4, m) y(θ) = y + θ (d0 + (1−θ)(d1 + θ (d2 + (1−θ) d3)))
    clock: np.ndarray  # (CLOCK_SIZE,)
    count: np.ndarray  # (COUNT_SIZE,) int
    extremes: np.ndarray  # (c, EXTREMES_SIZE)
    room: np.ndarray  # (ROOM, p, p) scratch for the most rows p, see dynsim.dynamics.contact.uniqueness
    hand_link: int
    hand_point: np.ndarray  # (3,) in the body's frame
    sample_time: np.ndarray  # (T,)
    sample: np.ndarray  # (T, m) states
    event: np.ndarray  # (e, EVENT_SIZE)
    event_table: np.ndarray  # (e, EVENT_TABLE_SIZE) int
    tick: np.ndarray  # (k, TICK_SIZE)
    tick_table: np.ndarray  # (k, TICK_TABLE_SIZE) int
    breaks: np.ndarray  # (b,) increasing times at which derivatives jump or bend: steps end there [s]
    log_time: np.ndarray  # (LOG_LENGTH,) of events [s]
    log_event: np.ndarray  # (LOG_LENGTH,) int: which
    hand: np.ndarray  # (3,) room
    gaps: np.ndarray  # (c, GAPS_SIZE) gaps, their rates, normals, positions and slip at the start of the step
    support: SupportArrays
    columns: OutputLayout
    output: np.ndarray  # (T, columns.size)
    stepping: SteppingArrays | None  # of time stepping alone
    newton: NewtonArrays | None  # of radau5 alone

    def states(self, name: str) -> np.ndarray:
        """A block of the sampled states by its name, see :func:`dynsim.dynamics.state.block`."""
        return self.sample[: self.count[SAMPLE], block(self.layout, name)]

    def outputs(self, name: str) -> np.ndarray:
        """Columns of the samples' outputs by their name; those of contacts are (T, c, OUTPUTS_PER_CONTACT)."""
        columns = self.output[: self.count[SAMPLE], block(self.columns, name)]
        if name == "contact":
            return columns.reshape(len(columns), columns.shape[1] // kst.OUTPUTS_PER_CONTACT, kst.OUTPUTS_PER_CONTACT)
        return columns


def new_run(
    method: int,
    y: np.ndarray,
    layout: StateLayout,
    columns: OutputLayout,
    *,
    n: int,
    na: int,
    c: int,
    couplings: int = 0,
    sample_time: np.ndarray,
    hand: tuple[int, np.ndarray],
    end: float,
    step: float,
    step_max: float,
    rtol: float,
    atol: float,
    events: tuple[np.ndarray, np.ndarray] | None = None,
    ticks: tuple[np.ndarray, np.ndarray] | None = None,
    breaks: np.ndarray | None = None,
    least_progress: float | None = None,
    support: SupportArrays | None = None,
    stepping: SteppingArrays | None = None,
    lanes: bool = False,
) -> Run:
    """Allocate a :class:`Run` from t = 0 at state y, (layout.size,).

    ``least_progress``: of MOST_TRIALS steps [s]; default: PROGRESS of the run until ``end``.
    ``lanes``: RADAU5 evaluates right-hand sides together, see dynsim.dynamics.simd.system.has_forms.

    Raises
    ------
    ValueError
        For time stepping without the block ``scheme`` of the state.
    """
    m, p = len(y), row_limit(c, couplings)
    if method == TIME_STEPPING and layout.size == layout.scheme:
        raise ValueError("the state has no room for the scheme's energy, see dynsim.dynamics.state")
    clock = np.zeros(CLOCK_SIZE)
    clock[[STEP, LAST_ERROR, END, RTOL, ATOL, STEP_MAX]] = step, 1e-4, end, rtol, atol, step_max
    clock[HOLD] = np.inf
    clock[LEAST_PROGRESS] = PROGRESS * end if least_progress is None else least_progress
    event, event_table = events or (np.zeros((0, EVENT_SIZE)), np.zeros((0, EVENT_TABLE_SIZE)))
    tick, tick_table = ticks or (np.zeros((0, TICK_SIZE)), np.zeros((0, TICK_TABLE_SIZE)))
    extremes = np.zeros((c, EXTREMES_SIZE))
    extremes[:, FORCE_MIN], extremes[:, FORCE_MAX], extremes[:, LOCAL_SINCE] = np.inf, -np.inf, np.inf
    count = np.zeros(COUNT_SIZE, dtype=np.int64)
    count[MODES_DUE] = AT_START
    newton = newton_arrays(n, na, layout.circuits, layout.tracked, m) if method == RADAU5 else None
    if newton is not None and lanes:
        newton = newton._replace(lanes=stage_lanes(workspace(n, na, c, couplings), m, columns.size))
    return Run(
        method=method,
        layout=layout,
        y=reals(y),
        y_new=np.zeros(m),
        stage=np.zeros((8, m)),
        dense=np.zeros((4, m)),
        clock=clock,
        count=count,
        extremes=extremes,
        room=np.zeros((kq.ROOM, p, p)),
        hand_link=hand[0],
        hand_point=reals(hand[1]),
        sample_time=reals(sample_time),
        sample=np.zeros((len(sample_time), m)),
        event=reals(event),
        event_table=integers(event_table),
        tick=reals(tick),
        tick_table=integers(tick_table),
        breaks=reals(np.zeros(0) if breaks is None else breaks),
        log_time=np.zeros(LOG_LENGTH),
        log_event=np.zeros(LOG_LENGTH, dtype=np.int64),
        hand=np.zeros(3),
        gaps=np.zeros((c, GAPS_SIZE)),
        support=no_support() if support is None else support,
        columns=columns,
        output=np.zeros((len(sample_time), columns.size)),
        stepping=stepping,
        newton=newton,
    )
