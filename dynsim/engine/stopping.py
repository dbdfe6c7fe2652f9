"""Messages and last state of an integration that stopped before its end."""

from __future__ import annotations

import logging
import threading
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
from dynsim.engine.prepare import Prepared, right_hand_side
from dynsim.engine.soundness import unstable_stop
from dynsim.errors import SimulationStopped
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.integrators import run as kp
from dynsim.integrators.methods import by_number
from dynsim.integrators.stepping import tables as kt
from dynsim.scenario import Scenario
from dynsim.system import interruption

# Loading and running of compiled code in a thread; the calling thread handles signals and the wall-time limit.


log = logging.getLogger(__name__)

# Interval of the checks, and how long to wait for compiled code that was asked to return [s].
LOOK_S, PATIENCE_S = 0.1, 0.5
# A run whose present step takes longer than this is stuck [s]. The longest step observed took 80 s: of 24 contacts
# whose forces no method of the solver finds.
STUCK_S = 600.0
# Most steps of time stepping in the caller's own thread: contacts may close within them.
MOST_SHORT = 50
# Time of one iteration of the contact solver, divided by the cube of the number of rows [s].
ROUND = 2e-9


def attend(
    work: Callable[[], None], ask: Callable[[], None], look: Callable[[], None]
) -> tuple[bool, BaseException | None]:
    """Do ``work`` in a thread of its own; meanwhile handle signals and call ``look``.

    Parameters
    ----------
    work : that releases the interpreter's lock
    ask : asks the work to end soon
    look : called every LOOK_S; what it raises, as what signals raise here, asks the work to end

    Returns
    -------
    ended : False when the work was left alone: it may go on for a while, and write to its arrays
    raised : by ``look``, or by a signal

    Raises
    ------
    Exception
        That of the work.
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
        # Also after a second signal.
        if not ended:
            interruption.leave()
    if ended and failure:
        raise failure[0]
    return ended, request


class OutOfTime(Exception):
    """Whoever listens has seen a run for too long; ``status`` is what it has come to."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class WallWatch:
    """Looks at the clock: for the wall limit of a run, and for one step that does not end.

    Parameters
    ----------
    limit : wall time that the integration may take [s]; None: any
    """

    def __init__(self, limit: float | None) -> None:
        self._limit, self._spent = limit, 0.0
        self._looked = clock.monotonic()
        self._seen, self._still = -1, 0.0

    @property
    def over(self) -> bool:
        """The limit is."""
        return self._limit is not None and self._spent > self._limit

    def begin(self) -> None:
        """A piece begins; what was between pieces counts as nothing."""
        self._looked, self._seen, self._still = clock.monotonic(), -1, 0.0

    def spend(self) -> float:
        """Count the time since the last look, and return it [s]."""
        now = clock.monotonic()
        passed, self._looked = now - self._looked, now
        self._spent += passed
        return passed

    def look(self, run: ki.Run) -> None:
        """Raise :class:`OutOfTime` where there is a reason."""
        passed = self.spend()
        if self.over:
            raise OutOfTime(ki.OUT_OF_TIME)
        seen = int(run.count.sum()) + (0 if run.newton is None else int(run.newton.count.sum()))
        # A process that was stopped for a while has not looked either.
        self._still = self._still + min(passed, 10.0 * LOOK_S) if seen == self._seen else 0.0
        self._seen = seen
        if self._still > STUCK_S:
            raise OutOfTime(ki.STUCK)


def load(prepared: Prepared) -> None:
    """Load the kernels of a run, or compile them, and log that.

    Raises
    ------
    KeyboardInterrupt
        The compiler goes on alone.
    """
    with kernels_logged(log, prepared.kind):
        compiled = partial(driver.advance, prepared.system, prepared.workspace, prepared.run, -1)
        _, raised = attend(compiled, lambda: None, interruption.check)
    if raised is not None:
        raise raised


def _short_steps(prepared: Prepared) -> int:
    """How many steps are over before anybody would have looked, whatever happens within them.

    They are taken in the caller's own thread: to hand a short run to another one costs some hundredths of its time.
    None under the unilateral law, where one step may take a minute; but steps of one length, whose contact problems
    are given up after so many rounds: as many as take no longer than code that was asked to return, with the rows of
    the last step. So many rounds are hardly ever needed, and a thread for each tick of a controller would double the
    time of a snake.
    """
    if prepared.system.unilateral is not None:
        rows = max(int(prepared.workspace.counts[ka.ROWS]), 1)
        few = min(int(PATIENCE_S / (kt.MOST_ROUNDS * ROUND * rows**3)), MOST_SHORT)
        return few if prepared.run.stepping is not None else 0
    n, p = len(prepared.workspace.joints), prepared.workspace.small.shape[1]
    seconds = right_hand_side(n, p, dense=prepared.system.dense is not None)
    # Of RADAU5 with a Jacobian and its factors.
    step = (2 * n + 60) * seconds + 3e-9 * n**3 if prepared.run.newton is not None else 6.0 * seconds
    return int(LOOK_S / step)


def advance(
    prepared: Prepared,
    limit: int,
    watch: WallWatch,
    look: Callable[[], None],
    kernel: Callable[..., None] | None = None,
) -> tuple[Prepared, BaseException | None]:
    """One piece of up to ``limit`` steps, see :func:`dynsim.integrators.driver.advance`.

    STATUS may be OUT_OF_TIME or STUCK besides what the kernels make of it.

    Parameters
    ----------
    kernel : what takes the steps, of :func:`dynsim.integrators.driver.direct`; default: that of the driver

    Returns
    -------
    prepared : the same, or a copy where the piece was left alone; that one cannot go on
    raised : what ``look`` has raised, or a signal
    """
    run, few, kernel = prepared.run, min(_short_steps(prepared), limit), kernel or driver.advance
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
        # Not where it has come to what its caller is to look at. (A pending step at the begin is to be accepted.)
        count = run.count
        due = count[ki.STATUS] == ki.RUNNING and count[ki.PENDING] == count[ki.TICKED] == count[ki.LOGGED] == 0
    if due and limit > few:
        remainder = partial(kernel, prepared.system, prepared.workspace, run, limit - few)
        ended, raised = attend(remainder, ask, both)
    watch.spend()
    if not ended:
        prepared = copied(prepared)
    count = prepared.run.count
    count[ki.ASKED] = 0
    if not ended or count[ki.STATUS] == ki.RUNNING:
        if isinstance(raised, OutOfTime):
            count[ki.STATUS] = raised.status
        elif not ended:
            count[ki.STATUS] = ki.STUCK
        elif watch.over:
            count[ki.STATUS] = ki.OUT_OF_TIME
    return prepared, None if isinstance(raised, OutOfTime) else raised


def copied(value: Any) -> Any:
    """Tables and arrays of their own, in which nothing moves any more."""
    if isinstance(value, Prepared):
        return replace(value, run=copied(value.run), workspace=copied(value.workspace), system=copied(value.system))
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, tuple):
        parts = map(copied, value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


# How fast friction changes with slip: why explicit steps are short.


Array = NDArray[np.float64]

# Steps of an explicit method at the limit of stability, in time constants: 3.3 by DOPRI5 [Hairer and Wanner], shorter
# after a rejected step, longer before one.
LEAST, MOST = 1.0, 5.0


def held_up(prepared: Prepared) -> str:
    """A clause about the contact whose friction changes so fast that explicit steps have to be this short, or ""."""
    run = prepared.run
    step = float(run.clock[ki.STEP])
    if not by_number(run.method).explicit or not prepared.contacts or not np.isfinite(run.y).all():
        return ""
    changing = fastest(prepared)
    if changing is None or not LEAST < step / changing.within < MOST:
        return ""
    return (
        f"steps are as short as {step:.1e} s because {changing.contact} slips at {changing.speed:.3g} m/s and its "
        f"friction changes within {changing.within:.3g} s; integrator.method: radau5 follows that with longer steps"
    )


@dataclass(frozen=True)
class Changing:
    """The contact whose friction changes fastest by itself, its slip [m/s], and τ of all together [s]."""

    contact: str
    speed: float
    within: float


def fastest(prepared: Prepared) -> Changing | None:
    """The fastest change of friction at the state of the run; None if none changes."""
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
    return Changing(prepared.contacts[k].name, speed, 1.0 / float(np.abs(np.linalg.eigvals(A)).max()))


def _slip(prepared: Prepared, k: int) -> Array:
    return np.asarray(prepared.workspace.contacts[k, ka.SLIP_VELOCITY : ka.SLIP_VELOCITY + 3])


def _friction(prepared: Prepared, k: int, normal: Array) -> tuple[Array, Array, Array]:
    """Friction of contact k that slips: minus its force per normal force, (3,); the rows of E on the surface; and D."""
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


# Names of the values of STATUS.
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
STEP_OVER = "integrator.method: time_stepping, which goes on through it"
_MODES = {ka.SLIDING: "slides", ka.STICKING: "sticks"}


def stopped(scenario: Scenario, prepared: Prepared) -> SimulationStopped:
    """Return the exception for a run whose STATUS shows that it stopped before its end."""
    run = prepared.run
    status, time = int(run.count[ki.STATUS]), float(run.clock[ki.TIME])
    kind = KINDS[status]
    if status != ki.STOPPED:  # a base that tips over does so for any reason
        q, v = (run.y[block(run.layout, name)] for name in ("q", "v"))
        elapsed = float((run.tick_table[:, ki.TICK_COUNT] * run.tick[:, ki.TICK_PERIOD]).max(initial=0.0))
        if unstable := unstable_stop(scenario, prepared, q, v, elapsed):
            words = f"stopped at t = {time:.6g} s"
            if status == ki.OUT_OF_TIME:
                words = _reason(scenario, prepared)
            return SimulationStopped(f"{words}: {unstable}", time=time, state=last_state(prepared, run.y), kind=kind)
    if finding := paradox(prepared.system, prepared.workspace, run, prepared.contacts):
        reached, y, words = finding
        return SimulationStopped(
            f"stopped at t = {reached:.6g} s: {words}", time=reached, state=last_state(prepared, y), kind=kind
        )
    return SimulationStopped(
        _reason(scenario, prepared), time=float(run.clock[ki.TIME]), state=last_state(prepared, run.y), kind=kind
    )


def last_state(prepared: Prepared, y: np.ndarray) -> dict[str, Sequence[float]]:
    """Return positions, rates and currents for a message, keyed by their names."""
    return {name: y[block(prepared.system.layout, name)].tolist() for name in ("q", "v", "current")}


def _listed(prepared: Prepared, *choices: NDArray[np.bool_]) -> str:
    """ " at" and the names of the contacts of the first choice, (c,) or more, that is not empty; "" if all are."""
    for chosen in choices:
        if chosen[: len(prepared.contacts)].any():
            return " at " + ", ".join(c.name for c, here in zip(prepared.contacts, chosen, strict=False) if here)
    return ""


def _doing(prepared: Prepared) -> str:
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
    """Return whether time stepping supports this system: real contacts, and no mobile base (dynsim.engine.prepare)."""
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
        return f"{where}: the state is no longer finite (divergence); look at the last state for a joint that runs away"
    if status == ki.NO_FORCES:
        names = ", ".join(contact.name for contact in prepared.contacts)
        return (
            f"{where}: no signs of the normal forces at {names} agree with dissipative friction (Painlevé's paradox); "
            "lower contacts.friction, or take contacts.pulling_friction: signed"
        )
    if status == ki.STEP_TOO_SMALL:
        stiff = "look at the last state for a joint that runs away"
        if method != "radau5":
            stiff = f"try integrator.method radau5, or {stiff}"
        if _can_step_over(prepared):
            stiff = f"try {STEP_OVER}{_doing(prepared)}"
        return f"{where}: the step size fell to {run.clock[ki.STEP]:.1e} s; {stiff}"
    if status == ki.STOPPED:
        return (
            f"{where}: the base tips over (tip margin zero), and plant.base.on_overturn is stop; brace it, move its "
            "caster or make it heavier, or take on_overturn: warn to go on as if it were held down"
        )
    if status == ki.NO_CONTACT_FORCES:
        names = _listed(prepared, prepared.workspace.active[:, ka.MODE] != ka.OPEN)
        return (
            f"{where}: no forces{names} agree with Coulomb's law (Painlevé's paradox, or rows that contradict each "
            "other); lower contacts.friction, or take another posture"
        )
    if status == ki.NO_PROGRESS:
        other = STEP_OVER if _can_step_over(prepared) else "another integrator.method"
        because = held_up(prepared) or f"take {other}, or longer steps where they are fixed"
        return (
            f"{where}: no progress, the last {ki.MOST_TRIALS} steps came no further than "
            f"{run.clock[ki.LEAST_PROGRESS]:.1e} s, the last of {run.clock[ki.STEP]:.1e} s{_doing(prepared)}; {because}"
        )
    if status == ki.OUT_OF_TIME:
        because = held_up(prepared)
        return (
            f"{where}: the wall limit, integrator.wall_limit_s = {scenario.integrator.wall_limit_s:g} s, is over, the "
            f"last step of {run.clock[ki.STEP]:.1e} s{_doing(prepared)}{'; ' if because else ''}{because}"
        )
    if status == ki.STUCK:
        return (
            f"{where}: one step of {run.clock[ki.STEP]:.1e} s does not end{_doing(prepared)}; "
            "take another integrator.method, or fewer contacts"
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
                f"{where}: {', '.join(joints)} hits and leaves its stop without end; "
                f"take {STEP_OVER if _can_step_over(prepared) else 'a larger integrator.atol'}"
            )
        return (
            f"{where}: {'the' if at else 'a'} contact{at} opens and closes, or slips and sticks, without end; "
            f"take {f'{STEP_OVER}, or ' if _can_step_over(prepared) else ''}a larger integrator.atol"
        )
    ws = prepared.workspace
    gaps, rates = ws.rows[: ws.counts[ka.ROWS], [ka.ROW_GAP, ka.ROW_RATE]].T
    worst = int(np.argmax(np.maximum(np.abs(gaps) / kp.GAP_TOLERANCE, np.abs(rates) / kp.RATE_TOLERANCE)))
    owner = int(ws.active[worst, ka.OWNER])
    if ws.active[worst, ka.ROW_KIND] == ka.JOINT_ROW:
        couplings = prepared.model.robot.couplings
        if owner >= len(couplings) + len(prepared.stops):
            joint = prepared.dry[owner - len(couplings) - len(prepared.stops)].joint
            return f"{where}: dry friction cannot keep joint {joint} where it is (off by {gaps[worst]:+.2e})"
        if owner >= len(couplings):
            joint = prepared.stops[owner - len(couplings)].joint
            return f"{where}: joint {joint} cannot be kept at its stop (off by {gaps[worst]:+.2e})"
        coupling = couplings[owner]
        failure = f"joint {coupling.joint} cannot be kept where {coupling.leader} leads it (off by {gaps[worst]:+.2e})"
    else:
        failure = f"contact {prepared.contacts[owner].name} cannot be kept on its surface (gap {gaps[worst]:+.2e} m, "
        failure += f"rate {rates[worst]:+.2e} m/s)"
    return f"{where}: {failure}; the contacts contradict each other or the arm is singular here"
