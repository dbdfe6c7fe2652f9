"""What candidates and joint stops have done under the unilateral law, for summaries, and what to warn of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dynsim.compile.contact_law import START_TOLERANCE, JointStop, told
from dynsim.compile.control import JointControl
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.integrators.contacts import events as kev
from dynsim.integrators.stepping import tables as kt
from dynsim.model.description import Contact, Robot
from dynsim.record import Record

# Time stepping, without a warning: what its steps may take or make of the turnover, by how much of it the energy may
# depend on when within a step something happens, and how deep points may sink.
SCHEME_LIMIT = 1e-2
HALF_STEP_LIMIT = 2e-2
PENETRATION_LIMIT_M = 1e-3


def modes(unilateral: UnilateralArrays, k: int, duration: float) -> dict[str, Any]:
    """What a candidate has done under the unilateral law."""
    tally = unilateral.tally[k]
    fractions = tally[[ku.TIME_STICKING, ku.TIME_SLIDING]] / duration if duration > 0.0 else np.zeros(2)
    sticking, sliding = np.minimum(fractions, 1.0).tolist()
    return {
        "closed_fraction": min(sticking + sliding, 1.0),
        "pulling_fraction": 0.0,
        "sticking_fraction": sticking,
        "sliding_fraction": sliding,
        "lift_offs": int(tally[ku.LIFT_OFFS]),
        "landings": int(tally[ku.LANDINGS]),
        "slip_starts": int(tally[ku.SLIP_STARTS]),
        "bounces": int(tally[ku.BOUNCES]),
        "impact_loss_J": float(tally[ku.LOSS]),
        "penetration_max_m": float(tally[ku.DEEPEST]),
    }


def never_touched(record: Record, contacts: Sequence[dict[str, Any]], placed: Sequence[str]) -> list[str]:
    """Declared points that have carried nothing, as braces shall; of ``placed`` ones the start is on their surfaces."""
    found, columns = [], record.labels["contact_gap"]
    for contact in contacts:
        name = contact["name"]
        if "gap_min_m" in contact and contact["closed_fraction"] == 0.0:
            nearest = int(record["contact_gap"][:, columns.index(name)].argmin())
            found.append(
                f"{name}: this brace never touches the {contact['surface']}: it carries nothing; nearest "
                f"{1e3 * contact['gap_min_m']:.3g} mm at t = {record.time[nearest]:.4g} s"
                f"{'' if name in placed else ' (initial.on_surface lets it start there)'}"
            )
    return found


def touched_stops(
    record: Record, robot: Robot, stops: Sequence[JointStop], unilateral: UnilateralArrays, duration: float
) -> list[dict[str, Any]]:
    """The joint stops that were touched."""
    units = {link.joint: link.units for link in robot.links}
    found = []
    for stop, row in zip(stops, unilateral.stop, strict=True):
        if row[ku.HITS] > 0 or row[ku.CLOSED_TIME] > 0.0:
            # One column for both stops of a joint, positive at the lower one.
            force = stop.side * record["stop_force"][:, record.labels["stop_force"].index(stop.joint)]
            found.append(
                {
                    "joint": stop.joint,
                    "limit": stop.position,
                    "unit": units[stop.joint][0],
                    "force_max": float(force.max(initial=0.0)),
                    "force_unit": units[stop.joint][3],
                    "hits": int(row[ku.HITS]),
                    "closed_fraction": min(float(row[ku.CLOSED_TIME]) / duration, 1.0) if duration > 0.0 else 0.0,
                    "impact_loss_J": float(row[ku.STOP_LOSS]),
                }
            )
    return found


def beyond_stops(robot: Robot, stops: Sequence[JointStop], control: JointControl) -> list[str]:
    """References that lie beyond a joint stop: the controller will push against it, and miss what it follows."""
    follows = {motor.joint: bool(k_p > 0.0) for motor, k_p in zip(robot.motors, control.k_p, strict=True)}
    places = dict(zip(robot.joint_names, robot.position_index, strict=True))
    units = {link.joint: link.units[0] for link in robot.links}
    watched = [stop for stop in stops if follows.get(stop.joint, False)]
    if not watched or not np.isfinite(control.end):
        return []
    worst: dict[JointStop, tuple[float, float]] = {}
    first: dict[JointStop, float] = {}
    for times, q in control.positions(robot):
        for stop in watched:
            beyond = stop.side * (stop.position - q[:, places[stop.joint]])
            k = int(beyond.argmax())
            if beyond[k] > START_TOLERANCE:
                first.setdefault(stop, float(times[beyond > START_TOLERANCE][0]))
                worst[stop] = max(worst.get(stop, (0.0, 0.0)), (float(beyond[k]), float(times[k])))
    return [
        f"{stop.joint}: its reference goes beyond its stop at {told(stop.position, units[stop.joint])} by up to "
        f"{told(most, units[stop.joint])}, first at t = {first[stop]:.4g} s, most at t = {time:.4g} s; "
        "the motor pushes against the stop and misses its path: change the path or the limit"
        for stop, (most, time) in worst.items()
    ]


def chattered(contacts: Sequence[Contact], unilateral: UnilateralArrays) -> list[str]:
    """Contacts whose events came too fast to be followed one by one."""
    found = []
    for contact, tally in zip(contacts, unilateral.tally, strict=True):
        if tally[ku.CHATTERED]:
            found.append(
                f"{contact.name}: chatter, more than {kev.MOST_EVENTS} contact events within {kev.WINDOW:g} s; what "
                f"left more slowly than {tally[ku.SETTLE]:.0e} m/s was kept on the surface"
            )
    return found


def coarse(stepping: dict[str, Any], scale: float) -> list[str]:
    """Steps so long that they take or make energy, blur it, or let points sink in, and the step that would not.

    scale : turnover of the energy, no less than what the ledger resolves; zero before anything moves [J]
    """
    step, worst, blurred = (stepping[key] for key in ("step_s", "scheme_loss_worst_J", "half_step_energy_J"))
    warnings: list[str] = []
    if scale > 0.0 and abs(worst) > SCHEME_LIMIT * scale:
        warnings.append(
            f"time stepping: the steps themselves {'took' if worst > 0.0 else 'made'} up to {abs(worst):.3g} J, "
            f"{100 * abs(worst) / scale:.2g} % of the turnover (limit {100 * SCHEME_LIMIT:g} %); "
            f"integrator.step_s is {step:g}: take {_shorter(step * SCHEME_LIMIT * scale / abs(worst)):g}"
        )
    if scale > 0.0 and blurred > HALF_STEP_LIMIT * scale:
        warnings.append(
            f"time stepping: the power changes so fast that the energy is known to {blurred:.3g} J only, "
            f"{100 * blurred / scale:.2g} % of the turnover (limit {100 * HALF_STEP_LIMIT:g} %), as it "
            f"would change if all came half a step later; integrator.step_s is {step:g}: take "
            f"{_shorter(step * HALF_STEP_LIMIT * scale / blurred):g}"
        )
    deepest = stepping["penetration_max_m"]
    if deepest > PENETRATION_LIMIT_M:
        warnings.append(
            f"time stepping: points sink up to {1e3 * deepest:.3g} mm into their surfaces as they land (limit "
            f"{1e3 * PENETRATION_LIMIT_M:g} mm); integrator.step_s is {step:g}: take "
            f"{_shorter(step * PENETRATION_LIMIT_M / deepest):g}"
        )
    return warnings


def _shorter(step: float) -> float:
    """The step with one digit, rounded down."""
    power = 10.0 ** np.floor(np.log10(step))
    return float(np.floor(step / power) * power)


def capped(stepping: dict[str, Any]) -> list[str]:
    """Contact problems that were not solved; what lies deep in a surface is no drift, but shrinks with the step."""
    if not stepping["capped_solves"]:
        return []
    return [
        f"time stepping: {stepping['capped_solves']} of {stepping['contact_solves']} contact problems were given up "
        f"above {kt.BAD:g} m/s, the worst at {stepping['residual_max_m_s']:.1e} m/s: their forces are not quite "
        "Coulomb's; shorten integrator.step_s"
    ]
