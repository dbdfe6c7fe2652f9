"""Record of a dynamics run: its signals from the kernel columns, summary, provenance, and the files of a run."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.compile.clearance import sinking
from dynsim.compile.hand_posture import hand_turns
from dynsim.compile.scene import robot_scene
from dynsim.dynamics import state as kst
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.tree import support as ks
from dynsim.engine.link_sensors import AppliedWrench, add_link_sensors
from dynsim.engine.prepare import Prepared
from dynsim.engine.ring import counted_within, time_shares, without_negligible
from dynsim.engine.target_distance import hand_distance
from dynsim.engine.warnings import warnings_of
from dynsim.errors import RecordError
from dynsim.integrators import run as ki
from dynsim.integrators.stepping import tables as kt
from dynsim.library import families
from dynsim.model.base_pose import base_pose
from dynsim.model.description import Array, Contact, Link, Robot
from dynsim.model.drives import Drive, Servo, TorqueSource, continuous_torque
from dynsim.model.mobile_base import SUPPORTS, MobileBase
from dynsim.record import Event, Record
from dynsim.record.measures import (
    RESIDUAL_LIMIT,
    STORES,
    base_summary,
    energy_turnover,
    hand_turn_error,
    sinks,
)
from dynsim.record.poses import NORMAL, TOUCHING, add_body_poses
from dynsim.record.scene import CarriedMass, Scene, SoftGripper, vector3
from dynsim.scenario import Scenario, build, to_yaml
from dynsim.scenario.schema import Payload
from dynsim.system.files import discard, json_text, replace_together, write_text
from dynsim.system.memo import recall

# Summary (``summary.json``) of a dynamics run: energies, tracking errors, contact forces, motor loads, warnings.


# Integrals computed by the integrator, in the order of the state (dynsim.dynamics.ledger).
INTEGRALS = {
    "energy_electrical": "∫ Σ u i dt, net electrical energy",
    "energy_electrical_drawn": "∫ Σ max(u i, 0) dt, one supply per motor, without regeneration",
    "heat_joule": "∫ Σ R i² dt",
    "loss_gear": "∫ Σ D_m v² dt",
    "loss_joint": "∫ Σ D v² dt",
    "heat_friction": "energy dissipated by contact friction",
    "work_constraint": "∫ Σ f_n n·v dt, work of the normal forces",
    "work_mechanical": "∫ Σ tau v dt, tau of [WM] eq 25",
    "energy_electrical_supply": "∫ max(Σ u i, 0) dt, one supply for all motors, without regeneration",
}

# Additional integrals of runs with springs or under the unilateral law.
ELASTIC = {
    "energy_elastic": "energy stored in contacts and ties since the start",
    "loss_damper": "energy dissipated by dampers of contacts and ties, and by ties beyond their bounds",
}
LOSSES = {"loss_impact": "energy lost in contact impacts", "loss_stop": "energy lost in impacts at joint stops"}

SCHEME = "energy lost by time stepping; negative: gained"

# Smallest height that landings resolve [m]. Each landing is located to within AT_ROOT, which leaves an error of the
# weight times AT_ROOT in the ledger. With this height as energy scale, ten landings reach the limit of the residual.
RESOLVED_M = 10.0 * ku.AT_ROOT / RESIDUAL_LIMIT

# Pulling forces of unilateral contacts below this fraction of their largest force are within the lift-off tolerance.
PULLS = 1e-3
_LOSS_KEYS = {"impact_loss": "loss_impact", "stop_loss": "loss_stop"}


def energy_residual(record: Record) -> NDArray[np.float64]:
    """Return electrical energy plus work of constraints and loads minus losses and stored energy change, (T,) [J]."""
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
    """Return the minimum denominator of the relative residual [J]: ``tolerance`` times the energy scale of the arm.

    The scale is the largest of kinetic energy, magnetic energy, change of potential energy, and gravity's ``lever``.
    Smaller energies are not resolved: an arm that hangs at rest would report the ratio of two rounding errors. Under
    the unilateral law (``real``) the floor is at least the total weight times :data:`RESOLVED_M`.
    """
    leverage, weight = gravity_lever(robot) if lever is None else lever
    stores = [record[name] - (record[name][:1] if name == "energy_potential" else 0.0) for name in STORES]
    floor = tolerance * max(leverage, *(float(np.abs(store).max(initial=0.0)) for store in stores))
    return max(floor, weight * RESOLVED_M) if real else floor


def gravity_lever(robot: Robot) -> tuple[float, float]:
    """Return the sum over all bodies of weight times arm length from the first joint to their centre [J], and the
    weight [N].
    """
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
    """Return the content of ``summary.json``.

    Parameters
    ----------
    record : Record
        Record of the run.
    end : Record
        One sample of all integrals, at the time up to which the statistics of ``prepared`` count.
    scenario : Scenario
        Scenario of the run.
    prepared : Prepared
        Prepared run after its last step.
    wall : float
        Wall-clock time of the integration [s].
    begun : float, optional
        Start time of the run [s].
    """
    run, robot, contacts = prepared.run, prepared.model.robot, prepared.contacts
    unilateral = prepared.system.unilateral
    duration = float(end.time[0] - (record.time[0] if len(record) else begun))
    # If only the last samples are kept, the wall-clock effort still covers the whole run.
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
        **hand_distance(record, prepared, scenario.metrics.settle_s, begun),
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
        **_drift(run),
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
    """Return the summary of a mobile base, empty without a base."""
    base, support = prepared.model.robot.base, prepared.run.support
    if base is None:
        return {}
    columns = [record.labels["q"].index(joint) for joint in base.wheels]
    # For rolling wheels s = r (φ_l + φ_r)/2 holds for any sample spacing.
    travel = base.wheel_radius * record["q"][:, columns].mean(axis=1)
    return {"base": base_summary(record, scenario.metrics.settle_s, support.least, travel)}


def _drift(run: ki.Run) -> dict[str, float]:
    """Return the largest gap of closed contacts [m]; empty for time stepping, where contacts have depths."""
    if run.stepping is not None:
        return {}
    return {"constraint_drift_max_m": float(run.extremes[:, ki.DRIFT_MAX].max(initial=0.0))}


def _loads(end: Record) -> dict[str, Any]:
    """Return the work of each external wrench [J], empty without loads."""
    if "work_loads" not in end:
        return {}
    return {"loads_work_J": dict(zip(end.labels["work_loads"], end["work_loads"][0].tolist(), strict=True))}


def _contact(
    record: Record, end: Record, k: int, contact: Contact, prepared: Prepared, duration: float, declared: bool
) -> dict[str, Any]:
    """Return the summary of a contact; for a declared point under the unilateral law including its minimum gap."""
    force, run, unilateral = record["contact_normal_force"][:, k], prepared.run, prepared.system.unilateral
    real = {} if unilateral is None else _modes(unilateral, k, duration)
    extremes = run.extremes[k] if run.count[ki.STEPS] else np.zeros(ki.EXTREMES_SIZE)
    # Under the unilateral law a force ends at zero; smaller pulling forces, up to PULLS, are the event tolerance.
    largest = float(max(extremes[ki.FORCE_MAX], force.max(initial=-np.inf)))
    lowest = float(min(extremes[ki.FORCE_MIN], force.min(initial=np.inf)))
    if unilateral is not None and lowest >= -PULLS * max(largest, 0.0):
        lowest = max(lowest, 0.0)
    # Steps may be longer than the interval in which a contact pulls. In this case, samples within the steps show the
    # interval.
    pulling, sampled = float(extremes[ki.PULLING]) / duration if duration > 0.0 else 0.0, int((force < 0.0).sum())
    if sampled > pulling * len(force) + 2.0:
        pulling = sampled / len(force)
    # Extremes are taken over the samples and all accepted steps, because steps are closer together than samples.
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
    """Return the part of a contact's summary that exists only under the unilateral law."""
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
    """Return a dict with one entry, or an empty dict if its value is unknown (see dynsim.engine.ring)."""
    return {} if np.isnan(value) else {key: float(value)}


def _joint_stops(record: Record, prepared: Prepared, duration: float) -> list[dict[str, Any]]:
    """Return the entries of the joint stops that were hit."""
    unilateral = prepared.system.unilateral
    assert unilateral is not None
    units = {link.joint: link.units for link in prepared.model.robot.links}
    stops = []
    for stop, row in zip(prepared.stops, unilateral.stop, strict=True):
        if row[ku.HITS] > 0 or row[ku.CLOSED_TIME] > 0.0:
            # Both stops of a joint share one column, positive at the lower stop.
            force = stop.side * record["stop_force"][:, record.labels["stop_force"].index(stop.joint)]
            stops.append(
                {
                    "joint": stop.joint,
                    "stop": "lower" if stop.side > 0.0 else "upper",
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
    """Return statistics of the contact solver and the maximum penetration.

    ``springs`` is True with compliant contacts or ties.
    """
    assert run.stepping is not None
    results = run.stepping.statistics
    return {
        "step_s": float(run.clock[ki.STEP]),
        "contact_solves": int(results[kt.SOLVES]),
        "long_solves": int(results[kt.LONG_SOLVES]),
        "cycled_solves": int(results[kt.CYCLED]),
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
    """Return rms and maximum of current and shaft torque of each motor, its ratings, and the friction of servos.

    Values cover the whole run and use the trapezoidal rule between samples; unknown ratings are omitted.
    """
    units = {link.joint: "N_m" if link.units[3] == "N m" else "N" for link in robot.links}
    # Contiguous samples for each motor reduce the time to a third.
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
    """Return ratings by key, infinite if unknown."""
    if isinstance(motor, TorqueSource):
        return {torque: motor.nominal_torque}
    ratings = {
        "nominal_current_A": motor.nominal_current,
        "peak_current_A": motor.greatest_current,
        torque: motor.nominal_torque,
        torque.replace("nominal", "continuous"): continuous_torque(motor),
    }
    if isinstance(motor, Servo):
        ratings |= {"stall_torque_N_m": motor.stall_torque, "gear_friction_N_m": motor.coulomb_friction}
    return ratings


def _rms(time: Array, values: Array) -> Array:
    """Return the root mean square over time of each row, (k, T) → (k,)."""
    if len(time) < 2:
        return np.abs(values).max(axis=1, initial=0.0)
    mean: Array = (values * values) @ time_shares(time) / (time[-1] - time[0])
    return np.sqrt(mean)


# Provenance of a record: scenario, engine, versions of dynsim, libraries and Python, commit, and date.


LIBRARIES = ("numpy", "scipy", "numba", "h5py")
# File of a built package that contains the commit it was built from.
BUILT_FROM = "commit.txt"


def provenance(scenario: Scenario) -> dict[str, Any]:
    """Return all information needed to reproduce the record."""
    return {
        "scenario": scenario.resolved,
        "engine": scenario.engine,
        "dynsim_version": __version__,
        "commit": commit(),
        "libraries": {name: _version(name) for name in LIBRARIES} | families.libraries(),
        "python": platform.python_version(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


@lru_cache
def _version(library: str) -> str:
    # Cached, because reading all metadata takes 6 ms, as long as a short run of a sweep.
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "unknown"


@lru_cache
def commit() -> str:
    """Return the commit of the running checkout or of the installed package; "" if unknown.

    The commit is read from .git once, because starting git would take longer. For a package, ``.ci/build_hook.py``
    stores it.
    """
    built = Path(__file__).resolve().parents[1] / BUILT_FROM
    if built.is_file():
        return built.read_text(encoding="ascii").strip()
    git = Path(__file__).resolve().parents[2] / ".git"
    try:
        if git.is_file():  # a linked work tree
            # In a submodule the path is relative to this file.
            git = git.parent / git.read_text(encoding="utf-8").removeprefix("gitdir:").strip()
        head = (git / "HEAD").read_text(encoding="utf-8").strip()
        if not head.startswith("ref:"):
            return head
        name = head.removeprefix("ref:").strip()
        common = git / "commondir"
        root = (git / common.read_text(encoding="utf-8").strip()) if common.is_file() else git
        if (root / name).is_file():
            return (root / name).read_text(encoding="utf-8").strip()
        packed = (root / "packed-refs").read_text(encoding="utf-8").splitlines()
        return next((line.split()[0] for line in packed if line.endswith(" " + name)), "")
    except (OSError, UnicodeDecodeError):
        return ""


# If the last sample is before the end of the run by less than this fraction of the run, it counts as at the end, see
# dynsim.engine.trace.even_times.
SAME_END = 1e-9


def pictured_parts(scene: Scene, scenario: Scenario) -> Scene:
    """Return the scene with the parts that only the scenario defines: objects, mesh folders and the gripper."""
    plant, grip, tip = scenario.plant, None, 0.0
    # A length of zero means that the robot has no gripper, unless there are objects to grasp.
    law = getattr(plant, "gripper", None)
    if law is not None and (plant.gripper_length_m or scenario.config.objects):
        grip = SoftGripper(law.capture_m, law.bound_N, law.turning_bound_N_m)
        tip = 0.0 if plant.controlled_point == "gripper" else plant.gripper_length_m
    files = (getattr(part, "file", None) for part in (plant, getattr(plant, "arm", None)))
    folders = tuple(str(Path(file).parent) for file in files if file is not None)
    return replace(scene, objects=tuple(scenario.config.objects or ()), mesh_folders=folders, grip=grip, tip=tip)


def drawn_scene(scenario: Scenario, robot: Robot, contacts: Sequence[Contact]) -> Scene | None:
    """Return the scene of a robot for pictures; None if it cannot be drawn."""
    scene = robot_scene(robot, contacts, build.surfaces(scenario))
    if scene is None:
        return None
    payloads = []
    for name, load in scenario.config.loads.items():
        if isinstance(load, Payload) and load.mass_kg > 0.0:
            body, point = robot.attach(load.body, np.array(load.point_m))
            payloads.append(CarriedMass(name, body, vector3(point), load.mass_kg, load.radius_m))
    return pictured_parts(replace(scene, payloads=tuple(payloads)), scenario)


def make_record(
    scenario: Scenario,
    prepared: Prepared,
    wall: float,
    *,
    pushed: Sequence[int] = (),
    pushes: Sequence[AppliedWrench] = (),
    happened: Sequence[Event] = (),
    base_as_planned: bool = True,
    pictured: bool = True,
    begun: float = 0.0,
) -> Record:
    """Create the record of a run from the columns that the kernels wrote.

    Parameters
    ----------
    scenario : Scenario
        Scenario of the run.
    prepared : Prepared
        Prepared run after its last step.
    wall : float
        Wall-clock time of the integration [s].
    pushed : sequence of int, optional
        Indices of the loads that are wrenches of the caller and have been set.
    pushes : sequence of AppliedWrench, optional
        These wrenches in chronological order, if the scenario has sensors on links.
    happened : sequence of Event, optional
        Events of the run.
    base_as_planned : bool, optional
        False if the wheels of a base did not follow the references of ``prepared.control`` from the start.
    pictured : bool, optional
        If False, omit the scene, the poses of its bodies, and provenance.
    begun : float, optional
        Start time of the run [s]; if samples start later, everything except the computing effort counts from the first
        sample.
    """
    count, times = int(prepared.run.count[ki.SAMPLE]), prepared.run.sample_time
    lost = count > 0 and times[0] > begun
    if lost:
        happened = [event for event in happened if times[0] <= event.time <= times[count - 1]]
        prepared = counted_within(prepared, happened)
    model, run, contacts = prepared.model, prepared.run, prepared.contacts
    robot = model.robot
    rows = int(run.count[ki.SAMPLE])
    joints, driven = robot.joint_names, tuple(motor.joint for motor in robot.motors)
    names = tuple(contact.name for contact in contacts)
    record = Record(run.sample_time[:rows], provenance=provenance(scenario) if pictured else None)
    angle, rate, acceleration, _ = _joint_units(robot.links)
    with_motor = set(driven)
    *_, force = _joint_units([link for link in robot.links if link.joint in with_motor] or robot.links)
    # All columns have the same unit, because servos replay them together and figures draw them together.
    positions = "joint positions" if robot.base is None else "joint positions; base.x and base.y [m]"
    record.add("q", run.states("q"), angle, labels=robot.position_names, description=positions)
    record.add("v", run.states("v"), rate, labels=joints, description="joint rates")
    record.add("vdot", run.outputs("vdot"), acceleration, labels=joints, description="joint accelerations")
    if robot.base is not None:
        _add_base(record, prepared, robot.base, base_as_planned)
    current, voltage = run.outputs("current"), run.outputs("voltage")
    record.add("current", current, "A", labels=driven, description="motor currents")
    record.add("voltage", voltage, "V", labels=driven, description="motor terminal voltages")
    record.add("torque", run.outputs("torque"), force, labels=driven, description="shaft torques, [WM] eq 25")
    record.add("power", current * voltage, "W", labels=driven, description="electrical power u i")
    record.add("hand_position", run.outputs("hand"), "m", labels=("x", "y", "z"))
    target = prepared.control.target(record.time)
    if target is not None:
        record.add("target_position", target, "m", labels=("x", "y", "z"))
    if prepared.control.orientation is not None:
        turned = hand_turns(model, run.states("q"), prepared.control.orientation)
        record.add("hand_turn_error", turned, "rad", description="angle between hand orientation and target")
    _add_energies(record, prepared, pushed)
    for store, name in zip(_by_column(run.outputs("energy")), STORES, strict=True):
        record.add(name, store, "J", description=f"{name.removeprefix('energy_')} energy")
    record.add("energy_residual", energy_residual(record), "J", description="residual of the energy balance")
    touch = run.outputs("contact")
    vector, slip = slice(kst.OUT_VECTOR, kst.OUT_VECTOR + 3), slice(kst.OUT_SLIP, kst.OUT_SLIP + 3)
    record.add(
        "contact_normal_force", touch[:, :, kst.OUT_FORCE], "N", labels=names, description="f_n; negative: pulling"
    )
    record.add("contact_force", touch[:, :, vector], "N", labels=names, description="normal and friction force, in W")
    record.add("contact_gap", touch[:, :, kst.OUT_GAP], "m", labels=names, description="distance from the surface")
    record.add("contact_slip_velocity", touch[:, :, slip], "m/s", labels=names)
    _add_touch(record, prepared)
    if prepared.system.unilateral is not None:
        _add_unilateral(record, prepared)
    add_link_sensors(record, scenario, prepared, pushes)
    happened, prepared = without_negligible(record, prepared, happened)
    for event in happened:
        record.add_event(event.time, event.kind, event.name)
    if pictured:
        record.scene = drawn_scene(scenario, robot, contacts)
        if add_body_poses(record):
            _add_touching_points(record, contacts, touch)
    end = _end(record, prepared, pushed, begun, within=lost)
    record.summary = summarise(record, end, scenario, prepared, wall, begun)
    return record


def _end(record: Record, prepared: Prepared, pushed: Sequence[int], begun: float, *, within: bool) -> Record:
    """Return all integrals at the end of the summarised interval, as a record of one sample.

    For a whole run, whose statistics count up to the present time, the end may be later than the last sample. If
    samples were lost (``within``), the end is the last sample.
    """
    run, rows = prepared.run, len(record)
    time, state = float(run.clock[ki.TIME]), run.y
    if rows and (within or time - record.time[-1] <= SAME_END * (time - begun)):
        time, state = float(record.time[-1]), run.sample[rows - 1]
    count = run.count.copy()
    count[ki.SAMPLE] = 1
    prepared, end = replace(prepared, run=run._replace(sample=state[None], count=count)), Record(np.array([time]))
    _add_energies(end, prepared, pushed)
    _add_touch(end, prepared)
    return end


def _add_energies(record: Record, prepared: Prepared, pushed: Sequence[int]) -> None:
    """Add integrals of powers, and energy losses of impacts and of the integration scheme."""
    run = prepared.run
    for integral, (name, text) in zip(_by_column(run.states("ledger")), INTEGRALS.items(), strict=True):
        record.add(name, integral, "J", description=text)
    if prepared.system.unilateral is not None:
        for integral, (name, text) in zip(_by_column(run.states("loss")), LOSSES.items(), strict=True):
            record.add(name, integral, "J", description=text)
    if run.stepping is not None:
        record.add("loss_scheme", run.states("scheme")[:, 0], "J", description=SCHEME)
    if run.states("elastic").size:
        for integral, (name, text) in zip(_by_column(run.states("elastic")), ELASTIC.items(), strict=True):
            record.add(name, integral, "J", description=text)
    # Wrenches of the caller have no coefficients.
    shown = [k for k, load in enumerate(prepared.loads) if len(load.coefficients) or k in pushed]
    if shown:
        labels = tuple(prepared.loads[k].name for k in shown)
        record.add("work_loads", run.states("load")[:, shown], "J", labels=labels, description="∫ W·V dt of each load")


def _add_touch(record: Record, prepared: Prepared) -> None:
    """Add integrals of forces and slip of the contacts."""
    names, rows = tuple(contact.name for contact in prepared.contacts), len(record)
    integrals = prepared.run.states("contact").reshape(rows, len(names), kst.CONTACT_SIZE)
    record.add("contact_impulse", integrals[:, :, kst.IMPULSE], "N s", labels=names, description="∫ f_n dt")
    record.add("contact_slip_distance", integrals[:, :, kst.SLIP], "m", labels=names, description="∫ |v_t| dt")


def _by_column(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the columns as contiguous rows, because the ledger sums them many times."""
    return np.ascontiguousarray(table.T)


def _add_unilateral(record: Record, prepared: Prepared) -> None:
    """Add modes of the contacts, and forces of joint stops, dry friction and ties."""
    run, robot = prepared.run, prepared.model.robot
    units = {link.joint: link.units[3] for link in robot.links}

    def unit(joints: Sequence[str]) -> str:
        return " or ".join(dict.fromkeys(units[joint] for joint in joints))

    names, modes = tuple(contact.name for contact in prepared.contacts), run.outputs("contact")[:, :, kst.OUT_MODE]
    record.add("contact_mode", modes, "1", labels=names, description="0 off its surface, 1 sliding, 2 sticking")
    if prepared.stops:
        joints, text = tuple(dict.fromkeys(stop.joint for stop in prepared.stops)), "positive at a lower limit"
        force = np.zeros((len(record), len(joints)))
        for stop, column in zip(prepared.stops, run.outputs("stop").T, strict=True):
            force[:, joints.index(stop.joint)] += stop.side * column
        record.add("stop_force", force, unit(joints), labels=joints, description=f"force of joint stops; {text}")
    if prepared.dry:
        joints, force = tuple(friction.joint for friction in prepared.dry), run.outputs("dry")
        record.add("joint_friction", force, unit(joints), labels=joints, description="dry friction on the joints")
    if robot.ties:
        names, kinds = tuple(tie.name for tie in robot.ties), ["N m" if tie.turns else "N" for tie in robot.ties]
        text, both = "force on the first body of each tie", " or ".join(dict.fromkeys(kinds))
        record.add("tie_force", run.outputs("tie"), both, labels=names, description=text)


def _add_touching_points(record: Record, contacts: Sequence[Contact], touch: Array) -> None:
    """Add where forces act on spheres, capsules and solids, and normals of surfaces on bodies, in single precision."""
    at = [k for k, c in enumerate(contacts) if c.radius > 0.0 or c.tip is not None or c.solid is not None]
    carried = [k for k, c in enumerate(contacts) if c.surface.carrier is not None or c.is_between_bodies]
    for columns, name, first, unit, text in (
        (at, TOUCHING, kst.OUT_POSITION, "m", "points of force application on spheres, capsules and solids"),
        (carried, NORMAL, kst.OUT_NORMAL, "1", "normals of solids and of surfaces that bodies carry, in W"),
    ):
        if columns:
            values = touch[:, columns, first : first + 3].astype(np.float32)
            record.add(name, values, unit, labels=tuple(contacts[k].name for k in columns), description=text)


def _add_base(record: Record, prepared: Prepared, base: MobileBase, as_planned: bool) -> None:
    """Add pose, target and ground forces of the base; see dynsim.dynamics.tree.support."""
    robot, run = prepared.model.robot, prepared.run
    pose, speed = base_pose(robot, run.states("q")), run.states("v")[:, list(map(robot.joint_names.index, base.wheels))]
    record.add("base_pose", pose, "m, m, rad", labels=("x", "y", "heading"), description="base pose in the world")
    target = prepared.control.base_target(robot, record.time) if as_planned else None
    if target is not None:
        record.add(
            "base_target",
            target,
            "m, m, rad",
            labels=("x", "y", "heading"),
            description="target pose according to the references",
        )
    sides, support = SUPPORTS[:2], run.outputs("support")
    parts = (slice(ks.LOADS, ks.LOADS + 3), slice(ks.PRESSURE, ks.PRESSURE + 2), slice(ks.TRACTION, ks.TRACTION + 2))
    load, pressure, traction = (support[:, part] for part in parts)
    record.add("wheel_speed", speed, "rad/s", labels=sides, description="wheel speeds; positive: forward")
    record.add("wheel_load", load, "N", labels=SUPPORTS, description="normal forces; negative: pulling")
    record.add("center_of_pressure", pressure, "m", labels=("x", "y"), description="in world axes; NaN without load")
    record.add("tip_margin", support[:, ks.MARGIN], "1", description="1: at the incentre, 0: tipping, -1: lifted")
    record.add("traction_demand", traction, "1", labels=sides, description="|F|/(μ N); NaN without load")


def _joint_units(links: Iterable[Link]) -> Sequence[str]:
    """Return the units of position, velocity, acceleration and force of joints; "rad or m" if both kinds exist."""
    units = sorted({link.units for link in links}, reverse=True)
    return [" or ".join(dict.fromkeys(kinds)) for kinds in zip(*units, strict=True)]


# Files of a run: their names, and functions that write record, summary and scenario and replace them together.


RUN_FILES = ("record.h5", "summary.json", "scenario.yaml")
# Files that are made from records and can be regenerated.
FIGURE_FORMATS = ("png", "pdf", "svg")
VIEW = "view.html"
FIGURES = (*(f"figures/*.{kind}" for kind in FIGURE_FORMATS), "figures/animation.gif", "figures/captions.txt", VIEW)
COMPARISON_FILES = (
    "comparison.json",
    "comparison.csv",
    "captions.txt",
    *(f"compare_*.{kind}" for kind in FIGURE_FORMATS),
    VIEW,
)


def save_run(record: Record, folder: Path) -> None:
    """Write ``record.h5``, ``summary.json`` and the resolved ``scenario.yaml`` to a folder, either all three or none.

    A process killed while it replaces them leaves a file ``INCOMPLETE``, for which :meth:`Record.load` checks.

    Raises
    ------
    RecordError
        If a file cannot be written; older files remain unchanged.
    """
    contents: dict[str, bytes | memoryview] = {
        "record.h5": record.to_hdf5(),
        "summary.json": json_text(record.summary).encode("utf-8"),
        "scenario.yaml": to_yaml(record.provenance["scenario"]).encode("utf-8"),
    }
    # Figures of another record must not remain next to this record.
    discard(folder, FIGURES)
    replace_together(folder, contents)


def save_drive(record: Record, folder: Path) -> None:
    """Write the files of a live drive; if the record cannot be written, keep the script that reproduces it.

    Raises
    ------
    RecordError
        If not all files could be written; the message states whether the script was saved.
    """
    try:
        save_run(record, folder)
    except RecordError as error:
        script = folder / "scenario.yaml"
        try:
            write_text(script, to_yaml(record.provenance["scenario"]))
        except RecordError:
            raise error from None
        raise RecordError(f"{error}; the script was saved and reproduces the record: dynsim run {script}") from None
