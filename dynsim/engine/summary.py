"""From a record to the numbers of its summary: energies, tracking errors, contact forces, warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.compile.clearance import Sinking, sinking
from dynsim.compile.contact_law import JointStop, told
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.engine.base_metrics import tipped
from dynsim.engine.contact_metrics import capped, chattered, coarse, modes, never_touched, touched_stops
from dynsim.integrators import run as ki
from dynsim.model.description import Contact, Robot
from dynsim.model.drives import Drive, Motor, Servo, TorqueSource
from dynsim.record import Record
from dynsim.record.measures import RESIDUAL_LIMIT, STORES, base_summary, energy_turnover, hand_error, percent, sinks
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
LOSSES = {"loss_impact": "energy that impacts of contacts take", "loss_stop": "energy that impacts at joint stops take"}

SCHEME = "energy that the steps of time stepping take; negative: that they make"

DRIFT_LIMIT_M = 1e-9
# Friction heat below zero by no more than this share of the turnover is rounding.
FRICTION_ROUNDING = 1e-12
# Limits in files are rounded: a joint that starts at 1.5707963 = 90° is not beyond it.
LIMIT_SLACK = 1e-6
# Heights below this are not resolved by landings [m]: each is found to AT_ROOT, which leaves the weight times that in
# the ledger, and here ten of them reach the limit of its residual.
RESOLVED_M = 10.0 * ku.AT_ROOT / RESIDUAL_LIMIT
# Part of a limit of current that counts as reached.
NEAR_LIMIT = 1e-3
NOT_ENFORCED = "no law enforces this limit"


_LOSS_KEYS = {"impact_loss": "loss_impact", "stop_loss": "loss_stop"}


@dataclass(frozen=True)
class MotionSpread:
    """What dependent frictional rows leave open: the range of one joint's acceleration over all admissible splits.

    Attributes
    ----------
    joint : name; unit : of its acceleration
    time : [s]
    low, high : least and greatest acceleration; taken : that of the run, from the split of least norm
    """

    joint: str
    unit: str
    time: float
    low: float
    high: float
    taken: float


@dataclass(frozen=True)
class Counts:
    """What the integrator counted.

    Attributes
    ----------
    wall : wall time of the integration [s]
    choice : method of integration, and why that one
    steps, rejected : accepted and repeated steps
    evaluations : right-hand sides, those for samples and projections included
    projections : corrections onto the contact surfaces
    deficient : right-hand sides whose constraint forces were not unique
    extremes : (c, 6) over all steps, see dynsim.integrators: FORCE_MIN, FORCE_MAX, DRIFT_MAX, PULLING,
        LAST_FORCE, LOCAL_SINCE
    spread : motion that dependent rows leave open; None: none
    shared : contacts that share forces which the motion does not determine; of the unilateral law
    support : (4,) least loads of wheels and caster and least tip margin of a mobile base over all steps, else empty
    unilateral : tables of the unilateral law with what they have counted; None under the other one
    stops : joint stops, in their order there
    stepping : how time stepping has solved its contact problems, for the summary; None of other methods
    """

    wall: float
    choice: tuple[str, str]
    steps: int
    rejected: int
    evaluations: int
    projections: int
    deficient: int
    extremes: NDArray[np.float64]
    spread: MotionSpread | None = None
    shared: tuple[str, ...] = ()
    support: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    unilateral: UnilateralArrays | None = None
    stops: tuple[JointStop, ...] = ()
    stepping: dict[str, Any] | None = None


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
    record: Record,
    scenario: Scenario,
    contacts: Sequence[Contact],
    robot: Robot,
    counts: Counts,
) -> dict[str, Any]:
    """The content of ``summary.json``."""
    duration = float(record.time[-1] - record.time[0]) if len(record) else 0.0

    def final(name: str) -> float:
        return float(record[name][-1]) if len(record) else 0.0

    turnover = energy_turnover(record)
    residual = float(np.abs(record["energy_residual"]).max(initial=0.0))
    lever = recall("lever", lambda: gravity_lever(robot), robot)
    floor = residual_floor(record, robot, scenario.integrator.rtol, counts.unilateral is not None, lever)
    denominator = max(turnover, floor)
    sunk = sinking(robot, build.surfaces(scenario), record["q"])
    summary: dict[str, Any] = {
        "scenario": scenario.name,
        "variant": scenario.variant,
        "dynsim_version": __version__,
        "duration_s": duration,
        "integration_wall_s": counts.wall,
        "real_time_factor": duration / counts.wall if counts.wall > 0.0 else 0.0,
        "method": counts.choice[0],
        "method_reason": counts.choice[1],
        "steps": counts.steps,
        "steps_rejected": counts.rejected,
        "rhs_evaluations": counts.evaluations,
        "projections": counts.projections,
        **hand_error(record, scenario.metrics.settle_s),
        "electrical_energy_J": final("energy_electrical"),
        "electrical_energy_supply_J": final("energy_electrical_supply"),
        "electrical_energy_drawn_J": final("energy_electrical_drawn"),
        "mechanical_work_J": final("work_mechanical"),
        "joule_heat_J": final("heat_joule"),
        "gear_loss_J": final("loss_gear"),
        "joint_loss_J": final("loss_joint"),
        "friction_heat_J": final("heat_friction"),
        **({} if counts.unilateral is None else {f"{key}_J": final(name) for key, name in _LOSS_KEYS.items()}),
        **({} if counts.stepping is None else {"scheme_loss_J": final("loss_scheme")}),
        **_loads(record),
        "energy_turnover_J": turnover,
        "energy_residual_relative": residual / denominator if denominator > 0.0 else 0.0,
        "constraint_drift_max_m": float(counts.extremes[:, ki.DRIFT_MAX].max(initial=0.0)),
        **_base(record, scenario, robot, counts),
        "contacts": [
            _contact(record, k, contact, counts, duration, contact.name in scenario.config.contacts.points)
            for k, contact in enumerate(contacts)
        ],
        "sinking": [
            {"body": s.body, "surface": s.surface, "depth_m": s.depth, "since_s": float(record.time[s.sample])}
            for s in sunk
        ],
    }
    if counts.unilateral is not None:
        summary["joint_stops"] = touched_stops(record, robot, counts.stops, counts.unilateral, duration)
    if counts.stepping is not None:
        summary["time_stepping"] = counts.stepping
    summary["warnings"] = _warnings(record, scenario, contacts, robot, counts, summary, denominator) + _sunk(
        record, sunk
    )
    return summary


def _base(record: Record, scenario: Scenario, robot: Robot, counts: Counts) -> dict[str, Any]:
    """What there is to say of a mobile base, where there is one."""
    if robot.base is None:
        return {}
    columns = [record.labels["q"].index(joint) for joint in robot.base.wheels]
    # Rolling: s = r (φ_l + φ_r)/2, however far apart the samples are.
    travel = robot.base.wheel_radius * record["q"][:, columns].mean(axis=1)
    return {"base": base_summary(record, scenario.metrics.settle_s, counts.support, travel)}


def _loads(record: Record) -> dict[str, Any]:
    """Work of each external wrench [J], where there are some."""
    if "work_loads" not in record:
        return {}
    work = record["work_loads"][-1] if len(record) else np.zeros(len(record.labels["work_loads"]))
    return {"loads_work_J": dict(zip(record.labels["work_loads"], work.tolist(), strict=True))}


def _contact(
    record: Record, k: int, contact: Contact, counts: Counts, duration: float, declared: bool
) -> dict[str, Any]:
    """What a contact has done; of a declared point under the unilateral law also how near it came."""
    force = record["contact_normal_force"][:, k]
    real = {} if counts.unilateral is None else modes(counts.unilateral, k, duration)
    # Under the unilateral law a force ends at zero; what lies below is the tolerance of that event.
    least = -np.inf if counts.unilateral is None else 0.0
    extremes = counts.extremes[k] if counts.steps else np.zeros(ki.EXTREMES_SIZE)
    # Extremes are those of every accepted step, which are closer together than the samples, and of the samples.
    return {
        "name": contact.name,
        "surface": contact.surface_name,
        "normal_force_min_N": max(float(min(extremes[ki.FORCE_MIN], force.min(initial=np.inf))), least),
        "normal_force_mean_N": float(record["contact_impulse"][-1, k] / duration) if duration > 0 else 0.0,
        "normal_force_max_N": float(max(extremes[ki.FORCE_MAX], force.max(initial=-np.inf))),
        "closed_fraction": 1.0,
        "pulling_fraction": min(float(extremes[ki.PULLING]) / duration, 1.0) if duration > 0.0 else 0.0,
        "slip_distance_m": float(record["contact_slip_distance"][-1, k]) if len(record) else 0.0,
        **real,
        **({"gap_min_m": float(record["contact_gap"][:, k].min())} if real and declared and len(record) else {}),
    }


def _warnings(
    record: Record,
    scenario: Scenario,
    contacts: Sequence[Contact],
    robot: Robot,
    counts: Counts,
    summary: dict[str, Any],
    scale: float,
) -> list[str]:
    found = [] if counts.unilateral is None else [*chattered(contacts, counts.unilateral)]
    initial = scenario.config.initial
    for contact in summary["contacts"]:
        if contact["normal_force_min_N"] < 0.0:
            found.append(
                f"{contact['name']}: the {contact['surface']} pulls on this brace for "
                f"{percent(contact['pulling_fraction'])} of the run, with up to "
                f"{-contact['normal_force_min_N']:.3g} N; a real arm would lift off"
            )
    found.extend(never_touched(record, summary["contacts"], () if initial is None else initial.on_surface))
    for contact, since in zip(contacts, counts.extremes[:, ki.LOCAL_SINCE], strict=True):
        if np.isfinite(since):
            found.append(
                f"{contact.name}: from t = {since:.4g} s on, its friction turns its own force against it (negative "
                "diagonal of J M⁻¹F, Painlevé's paradox at one contact): only the other braces hold it there, and "
                "whether real ones do depends on their stiffness; lower contacts.friction or take another posture"
            )
    # Within an impact friction may give what the normal impulse takes: only their sum is a loss.
    given = -summary["friction_heat_J"] - max(summary.get("impact_loss_J", 0.0), 0.0)
    if given > FRICTION_ROUNDING * summary["energy_turnover_J"]:
        put = f"friction has put {given:.3g} J into the arm: "
        if counts.unilateral is None:
            put += "f_t = μ f_n reverses with a pulling normal force "
            put += "(contacts.pulling_friction: dissipative takes μ |f_n|)"
        else:
            put += "an error of the integration; shorten integrator.step_s or tighten integrator.rtol"
        found.append(put)
    limited = [(a, motor, limits) for a, motor in enumerate(robot.motors) for limits in _limits_of(motor)]
    # Along samples: a third of the time.
    peaks = {name: np.abs(record[name].T.copy()).max(axis=1, initial=0.0) for name in {one[1] for *_, one in limited}}
    for a, motor, (what, signal, limit, unit) in limited:
        # The current of a DC motor comes near to the limit of its driver, and does not reach it.
        reached = limit * (1.0 - NEAR_LIMIT) if isinstance(motor, Motor) and what == "current" else limit
        # A run that diverged may have NaN, which hides a peak.
        if not peaks[signal][a] < reached:
            saturated = np.abs(record[signal][:, a]) >= reached
            if isinstance(motor, Servo):
                # Without a current its voltage is the back-EMF.
                saturated &= record["current"][:, a] != 0.0
            if saturated.any():
                found.append(
                    f"{motor.joint}: {what} at its limit of {limit:g} {unit} for "
                    f"{100 * saturated.mean():.1f} % of the run"
                )
    found.extend(_passed_limits(record, robot, counts.unilateral is not None))
    if robot.base is not None:
        found.extend(tipped(record, robot.base, counts.support, scenario.metrics.settle_s))
    if summary["energy_residual_relative"] > RESIDUAL_LIMIT:
        found.append(
            f"the energy ledger does not close: residual {summary['energy_residual_relative']:.1e} of the turnover; "
            "tighten integrator.rtol or the step"
        )
    if counts.stepping is not None:
        found.extend(capped(counts.stepping))
        found.extend(coarse(counts.stepping, scale))
    elif summary["constraint_drift_max_m"] > DRIFT_LIMIT_M:
        found.append(f"contacts drifted by {summary['constraint_drift_max_m']:.1e} m")
    if counts.deficient and counts.unilateral is None:
        found.append(
            f"contact rows depended on each other in {counts.deficient} evaluations: forces are the split of least norm"
        )
    elif counts.shared:
        found.append(
            f"{', '.join(counts.shared)}: shared forces which the motion does not determine, as points that stick do: "
            "they are the split of least norm among those that lie in all friction cones"
        )
    if counts.spread is not None:
        s = counts.spread
        found.append(
            f"with friction, dependent contact rows leave the motion open too: at t = {s.time:.4g} s the acceleration "
            f"of {s.joint} is anything from {s.low:.4g} to {s.high:.4g} {s.unit} over the splits of the normal forces "
            f"that keep their signs (this run: {s.taken:.4g}); take away braces until the rest are independent"
        )
    return found


def _limits_of(motor: Drive) -> list[tuple[str, str, float, str]]:
    """Limits of a motor: what is limited, its signal, the limit and its unit."""
    if isinstance(motor, TorqueSource):
        return [("torque", "current", motor.torque_limit, "N m")]
    limits = [("voltage", "voltage", motor.voltage_limit, "V")]
    if isinstance(motor, Servo) or np.isfinite(motor.current_limit):
        limits.append(("current", "current", motor.greatest_current, "A"))
    return limits


def _sunk(record: Record, sunk: Sequence[Sinking]) -> list[str]:
    """One warning per surface: the bodies that samples of the record show below it, and the one that is deepest."""
    found = []
    for surface in dict.fromkeys(s.surface for s in sunk):
        below = [s for s in sunk if s.surface == surface]
        deepest = max(below, key=lambda s: s.depth)
        names = ", ".join(s.body for s in below)
        verb = "passes" if len(below) == 1 else "pass"
        # Bodies from URDF have no radius.
        thick = any(s.radius > 0.0 for s in below)
        beyond = " by more than the link's radius" if thick else ""
        radius = f", of {1e3 * deepest.radius:g} mm," if thick else ""
        found.append(
            f"{names} {verb} below {surface}{beyond}: {deepest.body}{radius} by up to {1e3 * deepest.depth:.3g} mm in "
            f"the samples, first at t = {record.time[min(s.sample for s in below)]:.4g} s; "
            "surfaces hold only the points of contacts"
        )
    return found


def _passed_limits(record: Record, robot: Robot, real: bool) -> list[str]:
    """Limits of joints that samples of the record lie beyond.

    Stops are the only ones that are enforced, and only under the unilateral law (``real``); beyond them lies then what
    the steps of time stepping let joints go too far.
    """
    torque = dict(zip(record.labels["torque"], record["torque"].T, strict=True))
    found = []
    for link, k, v in zip(robot.links, robot.position_index, record["v"].T, strict=True):
        if all(abs(one) == np.inf for one in (link.lower, link.upper, link.velocity_limit, link.effort_limit)):
            continue
        q = record["q"][:, k]
        position, velocity, _, force = link.units
        passed = (
            "the stop holds only at the ends of steps: a shorter integrator.step_s lets it pass less"
            if real
            else "stops are enforced under contacts.law: unilateral"
        )
        for what, limit, unit, beyond, note in (
            ("lower position", link.lower, position, link.lower - q, passed),
            ("upper position", link.upper, position, q - link.upper, passed),
            ("velocity", link.velocity_limit, velocity, np.abs(v) - link.velocity_limit, NOT_ENFORCED),
            (
                "effort",
                link.effort_limit,
                force,
                np.abs(torque.get(link.joint, np.zeros_like(q))) - link.effort_limit,
                NOT_ENFORCED,
            ),
        ):
            over = np.flatnonzero(beyond > LIMIT_SLACK)
            if over.size:
                amount, first = beyond[over].max(), record.time[over[0]]
                found.append(
                    f"{link.joint}: passes its {what} limit of {told(limit, unit, 4)} by up to "
                    f"{told(amount, unit, 3)}, first at t = {first:.4g} s; {note}"
                )
    return found
