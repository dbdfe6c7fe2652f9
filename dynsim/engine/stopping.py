"""Execution of compiled code with signals and time limits; messages and last states of runs that stopped early."""

from __future__ import annotations

import logging
import math
import threading
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.mobility import moving_nothing
from dynsim.compile.tables import START_TOLERANCE
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.derivative import derivative
from dynsim.dynamics.state import block
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.force_indeterminacy import contact_point, paradox
from dynsim.engine.prepare import EVERY_STEP, Prepared, right_hand_side
from dynsim.engine.soundness import unstable_stop
from dynsim.errors import SimulationStopped
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.integrators.methods import by_number
from dynsim.integrators.stepping import tables as kt
from dynsim.scenario import Scenario
from dynsim.system import interruption

# Compiled code is loaded and run in a thread; the calling thread handles signals and the wall-clock limit.


log = logging.getLogger(__name__)

# Interval of the checks, and time to wait for compiled code that was asked to return [s].
LOOK_S, PATIENCE_S = 0.1, 0.5
# Processor time without progress of the simulated time after which a run is stopped [s]; see LEAST_PROGRESS.
STALLED_S = 50.0
# Maximum number of time-stepping steps in the caller's thread; it is limited because contacts may close during these
# steps.
MOST_SHORT = 50
# Time of one contact-solver iteration divided by the cube of the number of rows [s].
ROUND = 2e-9


def run_in_thread(
    work: Callable[[], None], ask: Callable[[], None], look: Callable[[], None]
) -> tuple[bool, BaseException | None]:
    """Run ``work`` in a separate thread; meanwhile handle signals and call ``look``.

    Parameters
    ----------
    work : callable
        Function to run; it must release the interpreter lock.
    ask : callable
        Asks the work to end soon.
    look : callable
        Called every LOOK_S seconds; an exception from it or from a signal asks the work to end.

    Returns
    -------
    ended : bool
        False if the work was abandoned: it may continue for a while and write to its arrays.
    raised : BaseException or None
        Exception raised by ``look`` or by a signal.

    Raises
    ------
    Exception
        If the work raises it.
    """
    done, failure = threading.Event(), list[BaseException]()

    def run() -> None:
        try:
            work()
        except BaseException as raised:
            failure.append(raised)
        done.set()

    ended, request = False, None
    try:
        try:
            threading.Thread(target=run, name="compiled code", daemon=True).start()
            while not (ended := done.wait(LOOK_S)):
                look()
        except BaseException as raised:
            request = raised
            ask()
            ended = done.wait(PATIENCE_S)
    finally:
        # This is also necessary after a second signal.
        if not ended:
            interruption.leave()
    if ended and failure:
        raise failure[0]
    return ended, request


class OutOfTime(Exception):
    """Raised when the watch ends a run; ``status`` is the new status of the run."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class WallWatch:
    """Watches the wall-clock limit of a run, and detects a run that makes no progress.

    Parameters
    ----------
    limit : float or None
        Maximum wall-clock time of the integration [s]; None for no limit.
    """

    def __init__(self, limit: float | None) -> None:
        self._limit, self._spent = limit, 0.0
        # Simulated time of the last progress, and processor time since [s].
        self._reached, self._idle = -math.inf, 0.0
        self.begin()

    @property
    def over(self) -> bool:
        """True if the limit is exceeded."""
        return self._limit is not None and self._spent > self._limit

    @property
    def stalled(self) -> bool:
        """True if the simulated time has not advanced within STALLED_S of processor time."""
        return self._idle > STALLED_S

    def begin(self) -> None:
        """Start a piece of work; time between pieces does not count."""
        self._looked, self._worked = clock.monotonic(), clock.process_time()

    def spend(self, run: ki.Run) -> None:
        """Add the time since the last check."""
        spent, worked = self._looked, self._worked
        self.begin()
        self._spent += self._looked - spent
        self._idle += self._worked - worked
        if run.clock[ki.TIME] - self._reached > run.clock[ki.LEAST_PROGRESS]:
            self._reached, self._idle = run.clock[ki.TIME], 0.0

    def look(self, run: ki.Run) -> None:
        """Raise :class:`OutOfTime` if the limit is exceeded, or the run makes no progress."""
        self.spend(run)
        if self.over:
            raise OutOfTime(ki.OUT_OF_TIME)
        if self.stalled:
            raise OutOfTime(ki.NO_PROGRESS)


def load(prepared: Prepared) -> None:
    """Load or compile the kernels of a run, and log it.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C; the compiler continues in its thread.
    """
    with kernels_logged(log, prepared.kind):
        compiled = partial(driver.advance, prepared.system, prepared.workspace, prepared.run, -1)
        _, raised = run_in_thread(compiled, lambda: None, interruption.check)
    if raised is not None:
        raise raised


def _short_steps(prepared: Prepared) -> int:
    """Return a number of steps that are certain to end before the first check is due.

    They run in the caller's thread, because handing a short run to another thread costs a few percent of its time.
    Under the unilateral law the number is zero, as one step may take a minute. The exception is time stepping, which
    abandons a contact problem after a fixed number of iterations. Its steps, each with as many rows as the last step,
    must not take longer than PATIENCE_S in total. This number of iterations is hardly ever reached, and a thread for
    each controller tick would double the time of a snake.
    """
    if prepared.system.unilateral is not None:
        rows = max(int(prepared.workspace.counts[ka.ROWS]), 1)
        few = min(int(PATIENCE_S / (kt.MOST_ROUNDS * ROUND * rows**3)), MOST_SHORT)
        return few if prepared.run.stepping is not None else 0
    n, p = len(prepared.workspace.joints), prepared.workspace.small.shape[1]
    seconds = right_hand_side(n, p, dense=prepared.system.dense is not None)
    # Time of a step; for RADAU5 including a Jacobian and its factorization.
    step = (2 * n + 60) * seconds + 3e-9 * n**3 if prepared.run.newton is not None else 6.0 * seconds
    return int(LOOK_S / step)


def advance(
    prepared: Prepared, watch: WallWatch, look: Callable[[], None], kernel: Callable[..., None]
) -> tuple[Prepared, BaseException | None]:
    """Run one piece, see :func:`dynsim.integrators.driver.advance`.

    In addition to the status values of the kernels, STATUS may be OUT_OF_TIME or STUCK.

    Parameters
    ----------
    prepared : Prepared
        Prepared run.
    watch : WallWatch
        Watch on the wall-clock time of the run.
    look : callable
        Called regularly; may raise.
    kernel : callable
        Stepping function of :func:`dynsim.integrators.driver.direct`.

    Returns
    -------
    prepared : Prepared
        The same run, or a copy if the piece was abandoned; the copy cannot continue.
    raised : BaseException or None
        Exception raised by ``look`` or by a signal.
    """
    run, few = prepared.run, _short_steps(prepared)
    ended, raised = True, None

    def ask() -> None:
        run.count[ki.ASKED] = 1

    def both() -> None:
        look()
        watch.look(run)

    watch.begin()
    due = few == 0
    if not due:
        kernel(prepared.system, prepared.workspace, run, few)
        # Do not continue if the caller has to act first. (A step that is pending at the start is accepted.)
        count = run.count
        due = count[ki.STATUS] == ki.RUNNING and count[ki.PENDING] == count[ki.TICKED] == count[ki.LOGGED] == 0
    if due:
        remainder = partial(kernel, prepared.system, prepared.workspace, run, EVERY_STEP)
        ended, raised = run_in_thread(remainder, ask, both)
    watch.spend(run)
    if not ended:
        prepared = copied(prepared)
    count = prepared.run.count
    count[ki.ASKED] = 0
    if not ended or count[ki.STATUS] == ki.RUNNING:
        if not ended and not (isinstance(raised, OutOfTime) and raised.status == ki.OUT_OF_TIME):
            count[ki.STATUS] = ki.STUCK
        elif isinstance(raised, OutOfTime):
            count[ki.STATUS] = raised.status
        elif watch.over:
            count[ki.STATUS] = ki.OUT_OF_TIME
        elif watch.stalled:
            count[ki.STATUS] = ki.NO_PROGRESS
    return prepared, None if isinstance(raised, OutOfTime) else raised


def copied(value: Any) -> Any:
    """Return separate copies of tables and arrays that nothing else modifies."""
    if isinstance(value, Prepared):
        return replace(value, run=copied(value.run), workspace=copied(value.workspace), system=copied(value.system))
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, tuple):
        parts = map(copied, value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


# Friction that changes fast with slip, which forces explicit methods to take short steps.


Array = NDArray[np.float64]

# Range of explicit steps at the stability limit, in time constants. The limit is 3.3 for DOPRI5 [Hairer and Wanner];
# steps are shorter after a rejected step and longer before one.
LEAST, MOST = 1.0, 5.0


def short_step_reason(prepared: Prepared) -> str:
    """Return a clause about the contact whose fast friction changes force short explicit steps, or ""."""
    run = prepared.run
    step = float(run.clock[ki.STEP])
    if not by_number(run.method).explicit or not prepared.contacts or not np.isfinite(run.y).all():
        return ""
    changing = fastest(prepared)
    if changing is None:
        return ""
    contact, speed, within = changing
    if not LEAST < step / within < MOST:
        return ""
    return (
        f"steps are as short as {step:.1e} s because {contact} slips at {speed:.3g} m/s and its "
        f"friction changes within {within:.3g} s; integrator.method: radau5 allows longer steps"
    )


def fastest(prepared: Prepared) -> tuple[str, float, float] | None:
    """Return the contact whose friction alone changes fastest, its slip [m/s], and the joint time constant τ of all
    contacts [s], at the state of the run; None if no friction changes.
    """
    system, run, ws, model = prepared.system, prepared.run, prepared.workspace, prepared.model
    unilateral = system.unilateral
    q = run.y[block(run.layout, "q")]
    derivative(system, float(run.clock[ki.TIME]), run.y, ws, np.zeros_like(run.y))
    rows, forces = [model.coupling_rows], [model.coupling_rows]
    if unilateral is not None:
        identity = np.eye(model.n)
        still = [identity[table[ku.STOP_JOINT]][None] for table in unilateral.stop_table if table[ku.STOP_CLOSED] == 1]
        still += [identity[table[ku.DRY_JOINT]][None] for table in unilateral.dry_table if table[ku.DRY_HOLDS] == 1]
        rows, forces = [*rows, *still], [*forces, *still]
    slides: list[tuple[int, Array, Array]] = []
    for k, contact in enumerate(prepared.contacts):
        mode = int(ws.active[k, ka.MODE])
        if unilateral is not None and mode == ka.OPEN:
            continue
        normal, point = contact_point(model, contact, q)
        if unilateral is not None and mode == ka.STICKING:
            rows.append(point)
            forces.append(point)
            continue
        along, tangents, damping = _friction(prepared, k, normal)
        rows.append((normal @ point)[None])
        forces.append(((normal - along) @ point)[None])
        slides.append((k, tangents @ point, damping))
    if not slides:
        return None
    R, F = np.vstack(rows), np.vstack(forces)
    inverse = np.linalg.inv(model.mass_matrix(q) + np.diag(model.armature))
    left = inverse - inverse @ F.T @ np.linalg.pinv(R @ inverse @ F.T, rcond=1e-9) @ R @ inverse
    E, DE = np.vstack([row for _, row, _ in slides]), np.vstack([damping @ row for _, row, damping in slides])
    A = E @ left @ DE.T
    if not np.isfinite(A).all() or not A.any():
        return None
    own = [float(np.trace(row @ left @ row.T @ damping)) for _, row, damping in slides]
    k = slides[int(np.argmax(own))][0]
    speed = float(np.linalg.norm(_slip(prepared, k)))
    return prepared.contacts[k].name, speed, 1.0 / float(np.abs(np.linalg.eigvals(A)).max())


def _slip(prepared: Prepared, k: int) -> Array:
    return np.asarray(prepared.workspace.contacts[k, ka.SLIP_VELOCITY : ka.SLIP_VELOCITY + 3])


def _friction(prepared: Prepared, k: int, normal: Array) -> tuple[Array, Array, Array]:
    """Return the friction of sliding contact k.

    The result is the negative friction force per unit of normal force, (3,), the tangential directions whose rows form
    E, and D.
    """
    ws, unilateral, contact = prepared.workspace, prepared.system.unilateral, prepared.contacts[k]
    slip = _slip(prepared, k)
    pressed = float(ws.contacts[k, ka.NORMAL_FORCE])
    if unilateral is not None:
        along = ws.contacts[k, ka.TANGENT : ka.TANGENT + 3]
        mu = float(ws.rows[ws.active[k, ka.FIRST_ROW], ka.ROW_MU])
        speed = max(float(np.linalg.norm(slip)), float(unilateral.number[ku.SLOW]))
        return mu * along, np.cross(normal, along)[None], np.array([[mu * pressed / speed]])
    smooth = float(np.hypot(np.linalg.norm(slip), contact.slip_smoothing))
    size = contact.friction * (pressed if contact.pulling_friction == "signed" else abs(pressed))
    tangents = np.linalg.svd(normal[None])[2][1:]
    across = tangents @ slip / smooth
    damping = size / smooth * (np.eye(2) - np.outer(across, across))
    return contact.friction * np.sign(size * pressed) * slip / smooth, tangents, damping


# Names of the STATUS values.
KINDS = {
    ki.NOT_FINITE: "not_finite",
    ki.STEP_TOO_SMALL: "step_too_small",
    ki.NOT_PROJECTED: "not_projected",
    ki.NO_FORCES: "no_forces",
    ki.FORCES_REVERSED: "forces_reversed",
    ki.SEVERAL_FORCES: "several_forces",
    ki.STOPPED: "overturned",
    ki.NO_CONTACT_FORCES: "no_contact_forces",
    ki.CHATTER: "chatter",
    ki.NO_PROGRESS: "no_progress",
    ki.OUT_OF_TIME: "out_of_time",
    ki.STUCK: "stuck",
}
STEP_OVER = "integrator.method: time_stepping, which continues through such events"
_MODES = {ka.SLIDING: "slides", ka.STICKING: "sticks"}


def stopped(scenario: Scenario, prepared: Prepared) -> SimulationStopped:
    """Return the exception for a run whose STATUS shows that it stopped before its end."""
    run, unstable = prepared.run, ""
    status, time, y = int(run.count[ki.STATUS]), float(run.clock[ki.TIME]), run.y
    if status != ki.STOPPED:  # the reason why a base tips over is not examined
        q, v = (y[block(run.layout, name)] for name in ("q", "v"))
        elapsed = float((run.tick_table[:, ki.TICK_COUNT] * run.tick[:, ki.TICK_PERIOD]).max(initial=0.0))
        unstable = unstable_stop(scenario, prepared, q, v, elapsed)
    if unstable:
        words = _reason(scenario, prepared) if status == ki.OUT_OF_TIME else f"stopped at t = {time:.6g} s"
        words = f"{words}: {unstable}"
    elif finding := paradox(prepared.system, prepared.workspace, run, prepared.contacts):
        time, y, words = finding
        words = f"stopped at t = {time:.6g} s: {words}"
    else:
        words = _reason(scenario, prepared)
    return SimulationStopped(words, time=time, state=last_state(prepared, y), kind=KINDS[status])


def last_state(prepared: Prepared, y: np.ndarray) -> dict[str, Sequence[float]]:
    """Return positions, rates and currents for a message, keyed by their names."""
    return {name: y[block(prepared.system.layout, name)].tolist() for name in ("q", "v", "current")}


def _listed(prepared: Prepared, *choices: NDArray[np.bool_]) -> str:
    """Return " at" and the contact names of the first non-empty choice, (c,) or more; "" if all are empty."""
    for chosen in choices:
        if chosen[: len(prepared.contacts)].any():
            return " at " + ", ".join(c.name for c, here in zip(prepared.contacts, chosen, strict=False) if here)
    return ""


def _modes_text(prepared: Prepared) -> str:
    """Return the modes of the unilateral contacts as text for the end of a sentence."""
    if prepared.system.unilateral is None or not prepared.contacts:
        return ""
    modes = prepared.workspace.active[: len(prepared.contacts), ka.MODE]
    if prepared.run.stepping is not None:
        modes = prepared.run.stepping.motion
    doing = [
        f"{contact.name} {_MODES[int(mode)]}"
        for contact, mode in zip(prepared.contacts, modes, strict=True)
        if mode != ka.OPEN
    ]
    return "; " + (", ".join(doing) if doing else "no contact is closed")


def _can_step_over(prepared: Prepared) -> bool:
    """Return whether time stepping could continue this run.

    Time stepping supports unilateral contacts without a mobile base (dynsim.engine.prepare).
    """
    events = prepared.system.unilateral is not None and prepared.run.stepping is None
    return events and bool(prepared.contacts) and prepared.model.robot.base is None


def _reason(scenario: Scenario, prepared: Prepared) -> str:
    run, status = prepared.run, int(prepared.run.count[ki.STATUS])
    t, method = float(run.clock[ki.TIME]), prepared.choice.method
    where = f"stopped at t = {t:.6g} s"
    diverged = status in (ki.NOT_FINITE, ki.STEP_TOO_SMALL, ki.NO_PROGRESS)
    if diverged and (nothing := moving_nothing(prepared.model, run.y[block(run.layout, "q")])):
        return f"{where}: {nothing}"
    if status == ki.NOT_FINITE:
        return f"{where}: the state is no longer finite (divergence); check the last state for a joint that diverges"
    if status == ki.NO_FORCES:
        names = ", ".join(contact.name for contact in prepared.contacts)
        return (
            f"{where}: no signs of the normal forces at {names} are consistent with dissipative friction (Painlevé's "
            "paradox); lower contacts.friction, or use contacts.pulling_friction: signed"
        )
    if status == ki.STEP_TOO_SMALL:
        stiff = "check the last state for a joint that diverges"
        if method != "radau5":
            stiff = f"try integrator.method radau5, or {stiff}"
        if _can_step_over(prepared):
            stiff = f"try {STEP_OVER}{_modes_text(prepared)}"
        return f"{where}: the step size fell to {run.clock[ki.STEP]:.1e} s; {stiff}"
    if status == ki.STOPPED:
        return (
            f"{where}: the base tips over (tip margin zero) and plant.base.on_overturn is stop; brace it, move its "
            "caster or make it heavier, or use on_overturn: warn to continue as if the base were held down"
        )
    if status == ki.NO_CONTACT_FORCES:
        names = _listed(prepared, prepared.workspace.active[:, ka.MODE] != ka.OPEN)
        return (
            f"{where}: no forces{names} are consistent with Coulomb's law (Painlevé's paradox, or contradictory "
            "rows); lower contacts.friction or change the posture"
        )
    if status == ki.NO_PROGRESS:
        other = STEP_OVER if _can_step_over(prepared) else "another integrator.method"
        because = short_step_reason(prepared) or f"use {other}, or a longer step if the step is fixed"
        return (
            f"{where}: no progress, the last {ki.MOST_TRIALS} steps, or the last minute, advanced by less than "
            f"{run.clock[ki.LEAST_PROGRESS]:.1e} s, last step {run.clock[ki.STEP]:.1e} s"
            f"{_modes_text(prepared)}; {because}"
        )
    if status == ki.OUT_OF_TIME:
        because = short_step_reason(prepared)
        return (
            f"{where}: the wall-clock limit, integrator.wall_limit_s = {scenario.integrator.wall_limit_s:g} s, is "
            f"exceeded; last step: {run.clock[ki.STEP]:.1e} s{_modes_text(prepared)}{'; ' if because else ''}{because}"
        )
    if status == ki.STUCK:
        return (
            f"{where}: one step of {run.clock[ki.STEP]:.1e} s does not end{_modes_text(prepared)}; "
            "use another integrator.method, or fewer contacts"
        )
    if status == ki.CHATTER and (law := prepared.system.unilateral) is not None:
        at = _listed(
            prepared,
            law.tally[:, ku.CHATTERED] > 0.0,
            law.mode[:, ku.BEFORE] != law.mode[:, ku.WANTED],
            np.abs(prepared.workspace.contacts[:, ka.GAP]) < START_TOLERANCE,
        )
        joints = dict.fromkeys(
            stop.joint for stop, row in zip(prepared.stops, law.stop, strict=True) if row[ku.STOP_CHATTERED]
        )
        if joints and not law.tally[:, ku.CHATTERED].any():
            return (
                f"{where}: {', '.join(joints)} hits and leaves its stop endlessly; "
                f"use {STEP_OVER if _can_step_over(prepared) else 'a larger integrator.atol'}"
            )
        return (
            f"{where}: {'the' if at else 'a'} contact{at} opens and closes, or slips and sticks, endlessly; "
            f"use {f'{STEP_OVER}, or ' if _can_step_over(prepared) else ''}a larger integrator.atol"
        )
    ws = prepared.workspace
    gaps, rates = ws.rows[: ws.counts[ka.ROWS], [ka.ROW_GAP, ka.ROW_RATE]].T
    worst = int(np.argmax(np.maximum(np.abs(gaps) / ki.GAP_TOLERANCE, np.abs(rates) / ki.RATE_TOLERANCE)))
    owner = int(ws.active[worst, ka.OWNER])
    off, couplings = f"(off by {gaps[worst]:+.2e})", prepared.model.robot.couplings
    # Rows of joints: first couplings, then stops, then dry friction.
    stop, dry = owner - len(couplings), owner - len(couplings) - len(prepared.stops)
    if ws.active[worst, ka.ROW_KIND] != ka.JOINT_ROW:
        failure = f"contact {prepared.contacts[owner].name} cannot be kept on its surface (gap {gaps[worst]:+.2e} m, "
        failure += f"rate {rates[worst]:+.2e} m/s)"
    elif dry >= 0:
        return f"{where}: dry friction cannot keep joint {prepared.dry[dry].joint} in place {off}"
    elif stop >= 0:
        return f"{where}: joint {prepared.stops[stop].joint} cannot be kept at its stop {off}"
    else:
        failure = f"joint {couplings[owner].joint} cannot follow its leader {couplings[owner].leader} {off}"
    return f"{where}: {failure}; the contacts contradict each other, or the posture is singular"
