"""Summary (``summary.json``) of a dynamics run: energies, tracking errors, contact forces, motor loads, warnings.

:func:`summarise` makes it from the record; the residual of the energy ledger is defined here too. The summary of the
kinematic snake is in :mod:`dynsim.engine.kinematic_record`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.compile.clearance import sinking
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.engine.prepare import Prepared
from dynsim.engine.warnings import warnings_of
from dynsim.integrators import run as ki
from dynsim.integrators.stepping import tables as kt
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.drives import Drive, Servo, TorqueSource
from dynsim.record import Record
from dynsim.record.measures import (
    RESIDUAL_LIMIT,
    STORES,
    base_summary,
    energy_turnover,
    hand_error,
    hand_turn_error,
    sinks,
)
from dynsim.scenario import Scenario, build
from dynsim.system.memo import recall

# Integrals that the integrator carries, in the order of the state (dynsim.dynamics.ledger).
INTEGRALS = {
    "energy_electrical": "∫ Σ u i dt, net electrical energy",
    "energy_electrical_drawn": "∫ Σ max(u i, 0) dt, a supply for each motor that takes nothing back",
    "heat_joule": "∫ Σ R i² dt",
    "loss_gear": "∫ Σ D_m v² dt",
    "loss_joint": "∫ Σ D v² dt",
    "heat_friction": "energy that contact friction takes",
    "work_constraint": "∫ Σ f_n n·v dt, work of the normal forces",
    "work_mechanical": "∫ Σ tau v dt, tau of [WM] eq 25",
    "energy_electrical_supply": "∫ max(Σ u i, 0) dt, one supply for all motors that takes nothing back",
}

# Those that runs under the unilateral law have beside them.
ELASTIC = {
    "energy_elastic": "energy that contacts and ties have stored since the start",
    "loss_damper": "energy that dampers of contacts and ties take, and what ties lose beyond their bounds",
}
LOSSES = {"loss_impact": "energy that impacts of contacts take", "loss_stop": "energy that impacts at joint stops take"}

SCHEME = "energy that the steps of time stepping take; negative: that they make"

# Heights below this are not resolved by landings [m]: each is found to AT_ROOT, which leaves the weight times that in
# the ledger, and here ten of them reach the limit of its residual.
RESOLVED_M = 10.0 * ku.AT_ROOT / RESIDUAL_LIMIT

# Pulling forces of unilateral contacts below this part of their largest force are the tolerance of lift-off.
PULLS = 1e-3
_LOSS_KEYS = {"impact_loss": "loss_impact", "stop_loss": "loss_stop"}


def energy_residual(record: Record) -> NDArray[np.float64]:
    """Electrical energy, work of constraints and loads minus losses minus the change of stored energy, (T,) [J]."""
    residual = record["energy_electrical"] + record["work_constraint"]
    if "work_loads" in record:
        residual = residual + record["work_loads"].sum(axis=1)
    for name in sinks(record):
        residual = residual - record[name]
    for name in STORES:
        residual = residual - (record[name] - record[name][:1])
    return residual


def residual_floor(
    record: Record, robot: Robot, tolerance: float, real: bool = False, lever: tuple[float, float] | None = None
) -> float:
    """Least denominator of the relative residual [J]: ``tolerance`` times the energy that the arm can have about it.

    That is the largest of kinetic energy, magnetic energy, change of potential energy, and gravity's ``lever``. Below
    it the integration resolves nothing: an arm that hangs at rest would report the ratio of two roundings. Under the
    unilateral law (``real``) it is at least the whole weight times :data:`RESOLVED_M`.
    """
    leverage, weight = gravity_lever(robot) if lever is None else lever
    stores = [record[name] - (record[name][:1] if name == "energy_potential" else 0.0) for name in STORES]
    floor = tolerance * max(leverage, *(float(np.abs(store).max(initial=0.0)) for store in stores))
    return max(floor, weight * RESOLVED_M) if real else floor


def gravity_lever(robot: Robot) -> tuple[float, float]:
    """Sum over all bodies of weight times the length of arm from the first joint to their centre [J]; weight [N]."""
    reach: dict[str, float] = {}
    lever, mass = 0.0, 0.0
    for link in robot.links:
        mass += link.inertia.mass
        reach[link.name] = 0.0 if link.parent is None else reach[link.parent] + float(np.linalg.norm(link.p_PJ))
        lever += link.inertia.mass * (reach[link.name] + float(np.linalg.norm(link.inertia.com)))
    gravity = float(np.linalg.norm(robot.gravity))
    return lever * gravity, mass * gravity


def summarise(
    record: Record, end: Record, scenario: Scenario, prepared: Prepared, wall: float, begun: float = 0.0
) -> dict[str, Any]:
    """The content of ``summary.json`` for a run that has taken ``wall`` [s], and began at ``begun`` [s].

    ``end`` : one sample of all integrals, at the time up to which the tallies of ``prepared`` count
    """
    run, robot, contacts = prepared.run, prepared.model.robot, prepared.contacts
    unilateral = prepared.system.unilateral
    duration = float(end.time[0] - (record.time[0] if len(record) else begun))
    # Of a ring, the effort is that of the whole run.
    elapsed = float(run.clock[ki.TIME]) - begun

    def final(name: str) -> float:
        return float(end[name][0])

    turnover = energy_turnover(record)
    residual = float(np.abs(record["energy_residual"]).max(initial=0.0))
    lever = recall("lever", lambda: gravity_lever(robot), robot)
    floor = residual_floor(record, robot, scenario.integrator.rtol, unilateral is not None, lever)
    scale = max(turnover, floor)
    sunk = sinking(robot, build.surfaces(scenario), record["q"])
    summary: dict[str, Any] = {
        "scenario": scenario.name,
        "variant": scenario.variant,
        "dynsim_version": __version__,
        "duration_s": duration,
        "integration_wall_s": wall,
        "real_time_factor": elapsed / wall if wall > 0.0 else 0.0,
        "method": prepared.choice.method,
        "method_reason": prepared.choice.reason,
        "steps": int(run.count[ki.STEPS]),
        "steps_rejected": int(run.count[ki.REJECTED]),
        "rhs_evaluations": int(run.count[ki.EVALUATIONS]),
        "projections": int(run.count[ki.PROJECTIONS]),
        **hand_error(record, scenario.metrics.settle_s),
        **hand_turn_error(record, scenario.metrics.settle_s),
        "electrical_energy_J": final("energy_electrical"),
        "electrical_energy_supply_J": final("energy_electrical_supply"),
        "electrical_energy_drawn_J": final("energy_electrical_drawn"),
        "mechanical_work_J": final("work_mechanical"),
        "joule_heat_J": final("heat_joule"),
        "gear_loss_J": final("loss_gear"),
        "joint_loss_J": final("loss_joint"),
        "friction_heat_J": final("heat_friction"),
        **({} if unilateral is None else {f"{key}_J": final(name) for key, name in _LOSS_KEYS.items()}),
        **({} if run.stepping is None else {"scheme_loss_J": final("loss_scheme")}),
        **({"damper_loss_J": final("loss_damper")} if "loss_damper" in record else {}),
        **_loads(end),
        "energy_turnover_J": turnover,
        "energy_residual_relative": residual / scale if scale > 0.0 else 0.0,
        "constraint_drift_max_m": float(run.extremes[:, ki.DRIFT_MAX].max(initial=0.0)),
        **_base(record, scenario, prepared),
        "contacts": [
            _contact(record, end, k, contact, prepared, duration, contact.name in scenario.config.contacts.points)
            for k, contact in enumerate(contacts)
        ],
        "sinking": [
            {"body": s.body, "surface": s.surface, "depth_m": s.depth, "since_s": float(record.time[s.sample])}
            for s in sunk
        ],
    }
    if unilateral is not None:
        summary["joint_stops"] = _joint_stops(record, prepared, duration)
    if run.stepping is not None:
        summary["time_stepping"] = _time_stepping(run, "loss_damper" in record)
    motors = motor_loads(record, robot)
    summary["warnings"] = warnings_of(record, scenario, prepared, summary, scale, sunk, motors, begun)
    summary["motors"] = motors
    if prepared.balance is not None:
        forces = prepared.balance.normal_forces
        summary["equilibrium"] = {
            "heat_W": prepared.balance.heat,
            **{f"{name}.normal_force_N": force for name, force in forces.items()},
        }
    return summary


def _base(record: Record, scenario: Scenario, prepared: Prepared) -> dict[str, Any]:
    """What there is to say of a mobile base, where there is one."""
    base, support = prepared.model.robot.base, prepared.run.support
    if base is None:
        return {}
    columns = [record.labels["q"].index(joint) for joint in base.wheels]
    # Rolling: s = r (φ_l + φ_r)/2, however far apart the samples are.
    travel = base.wheel_radius * record["q"][:, columns].mean(axis=1)
    return {"base": base_summary(record, scenario.metrics.settle_s, support.least, travel)}


def _loads(end: Record) -> dict[str, Any]:
    """Work of each external wrench [J], where there are some."""
    if "work_loads" not in end:
        return {}
    return {"loads_work_J": dict(zip(end.labels["work_loads"], end["work_loads"][0].tolist(), strict=True))}


def _contact(
    record: Record, end: Record, k: int, contact: Contact, prepared: Prepared, duration: float, declared: bool
) -> dict[str, Any]:
    """What a contact has done; of a declared point under the unilateral law also how near it came."""
    force, run, unilateral = record["contact_normal_force"][:, k], prepared.run, prepared.system.unilateral
    real = {} if unilateral is None else _modes(unilateral, k, duration)
    extremes = run.extremes[k] if run.count[ki.STEPS] else np.zeros(ki.EXTREMES_SIZE)
    # Under the unilateral law a force ends at zero; less is the tolerance of that event, up to PULLS.
    largest = float(max(extremes[ki.FORCE_MAX], force.max(initial=-np.inf)))
    lowest = float(min(extremes[ki.FORCE_MIN], force.min(initial=np.inf)))
    if unilateral is not None and lowest >= -PULLS * max(largest, 0.0):
        lowest = max(lowest, 0.0)
    # Steps may be longer than the time for which a contact pulls: then samples within them show it.
    pulling, sampled = float(extremes[ki.PULLING]) / duration if duration > 0.0 else 0.0, int((force < 0.0).sum())
    if sampled > pulling * len(force) + 2.0:
        pulling = sampled / len(force)
    # Extremes are those of every accepted step, which are closer together than the samples, and of the samples.
    return {
        "name": contact.name,
        "surface": contact.surface_name,
        "normal_force_min_N": lowest,
        "normal_force_mean_N": float(end["contact_impulse"][0, k] / duration) if duration > 0 else 0.0,
        "normal_force_max_N": largest,
        "closed_fraction": 1.0,
        "pulling_fraction": min(pulling, 1.0),
        "slip_distance_m": float(end["contact_slip_distance"][0, k]),
        **real,
        **({"gap_min_m": float(record["contact_gap"][:, k].min())} if real and declared and len(record) else {}),
    }


def _modes(unilateral: UnilateralArrays, k: int, duration: float) -> dict[str, Any]:
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
        **_known("impact_loss_J", tally[ku.LOSS]),
        "penetration_max_m": float(tally[ku.DEEPEST]),
    }


def _known(key: str, value: float) -> dict[str, float]:
    """An entry, unless it is not known (see dynsim.engine.ring)."""
    return {} if np.isnan(value) else {key: float(value)}


def _joint_stops(record: Record, prepared: Prepared, duration: float) -> list[dict[str, Any]]:
    """The joint stops that were touched."""
    unilateral = prepared.system.unilateral
    assert unilateral is not None
    units = {link.joint: link.units for link in prepared.model.robot.links}
    stops = []
    for stop, row in zip(prepared.stops, unilateral.stop, strict=True):
        if row[ku.HITS] > 0 or row[ku.CLOSED_TIME] > 0.0:
            # One column for both stops of a joint, positive at the lower one.
            force = stop.side * record["stop_force"][:, record.labels["stop_force"].index(stop.joint)]
            stops.append(
                {
                    "joint": stop.joint,
                    "limit": stop.position,
                    "unit": units[stop.joint][0],
                    "force_max": float(force.max(initial=0.0)),
                    "force_unit": units[stop.joint][3],
                    "hits": int(row[ku.HITS]),
                    "closed_fraction": min(float(row[ku.CLOSED_TIME]) / duration, 1.0) if duration > 0.0 else 0.0,
                    **_known("impact_loss_J", row[ku.STOP_LOSS]),
                }
            )
    return stops


def _time_stepping(run: ki.Run, springs: bool) -> dict[str, Any]:
    """How well time stepping has solved its contact problems, and how deep points came to lie.

    springs : contacts give way, or there are ties
    """
    assert run.stepping is not None
    results = run.stepping.statistics
    return {
        "step_s": float(run.clock[ki.STEP]),
        "contact_solves": int(results[kt.SOLVES]),
        "long_solves": int(results[kt.LONG_SOLVES]),
        "dropped_solves": int(results[kt.DROPPED]),
        "capped_solves": int(results[kt.CAPPED]),
        "residual_max_m_s": float(results[kt.WORST]),
        "limits_unsettled": int(results[kt.UNSETTLED]),
        "scheme_loss_worst_J": float(results[kt.TAKEN]),
        **(
            {"scheme_gain_J": float(results[kt.MADE]), "spring_rate_rad_per_s": float(results[kt.STIFFEST]) ** 0.5}
            if springs
            else {}
        ),
        **_known("half_step_energy_J", results[kt.HALF_STEP]),
        "penetration_max_m": float(results[kt.PENETRATION]),
    }


def motor_loads(record: Record, robot: Robot) -> list[dict[str, Any]]:
    """Of each motor the root mean square and the largest current and torque at the shaft, ratings, a servo's friction.

    Over the whole run, by trapezoids between the samples; a rating that is not known is left out.
    """
    units = {link.joint: "N_m" if link.units[3] == "N m" else "N" for link in robot.links}
    # Along samples, which lie together then: a third of the time.
    values = {name: np.ascontiguousarray(record[name].T) for name in ("current", "torque")}
    rms = {name: _rms(record.time, rows).tolist() for name, rows in values.items()}
    most = {
        name: np.maximum(rows.max(axis=1, initial=0.0), -rows.min(axis=1, initial=0.0)).tolist()
        for name, rows in values.items()
    }
    entries = []
    for a, motor in enumerate(robot.motors):
        unit = units[motor.joint]
        entry: dict[str, Any] = {"joint": motor.joint}
        torque = "torque" if unit == "N_m" else "force"
        if not isinstance(motor, TorqueSource):
            entry |= {"current_rms_A": rms["current"][a], "current_max_A": most["current"][a]}
        entry |= {f"{torque}_rms_{unit}": rms["torque"][a], f"{torque}_max_{unit}": most["torque"][a]}
        for key, rating in _ratings(motor, f"nominal_{torque}_{unit}").items():
            if np.isfinite(rating):
                entry[key] = rating
        entries.append(entry)
    return entries


def _ratings(motor: Drive, torque: str) -> dict[str, float]:
    """Ratings by key, infinite where they are not known."""
    if isinstance(motor, TorqueSource):
        return {torque: motor.nominal_torque}
    ratings = {
        "nominal_current_A": motor.nominal_current,
        "peak_current_A": motor.greatest_current,
        torque: motor.nominal_torque,
    }
    if isinstance(motor, Servo):
        ratings |= {"stall_torque_N_m": motor.stall_torque, "gear_friction_N_m": motor.coulomb_friction}
    return ratings


def _rms(time: Array, values: Array) -> Array:
    """Root mean square over time of each row, (k, T) → (k,)."""
    if len(time) < 2:
        return np.abs(values).max(axis=1, initial=0.0)
    # Half of each interval belongs to the sample at either end of it.
    weight = np.zeros(len(time))
    weight[:-1] = np.diff(time)
    weight[1:] += weight[:-1].copy()
    mean: Array = (values * values) @ weight / (2.0 * (time[-1] - time[0]))
    return np.sqrt(mean)
