"""Messages and last state of an integration that stopped before its end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.contact_law import START_TOLERANCE
from dynsim.compile.mobility import moving_nothing
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.state import block
from dynsim.engine.force_indeterminacy import paradox
from dynsim.engine.prepare import Prepared
from dynsim.engine.soundness import unstable_stop
from dynsim.engine.stiff_friction import held_up
from dynsim.errors import SimulationStopped
from dynsim.integrators import project as kp
from dynsim.integrators import run as ki
from dynsim.scenario import Scenario

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
