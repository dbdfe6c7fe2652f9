"""The record of a dynamics run, made from the columns that the kernels wrote."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.hand_posture import hand_turns
from dynsim.compile.scene import robot_scene
from dynsim.compile.shapes import touching_points
from dynsim.dynamics import state as kst
from dynsim.dynamics.tree import support as ks
from dynsim.engine import summary as metrics
from dynsim.engine.prepare import Prepared
from dynsim.engine.provenance import provenance
from dynsim.engine.ring import counted_within
from dynsim.integrators import run as ki
from dynsim.model.base_pose import base_pose
from dynsim.model.description import Contact, Link, Robot
from dynsim.model.mobile_base import SUPPORTS, MobileBase
from dynsim.record import Event, Record
from dynsim.record.poses import TOUCHING, add_body_poses, point_positions
from dynsim.record.scene import Point, vector3
from dynsim.scenario import Scenario, build

# A last sample within this part of the run before its end counts as at it, see dynsim.engine.trace.even_times.
SAME_END = 1e-9


def make_record(
    scenario: Scenario,
    prepared: Prepared,
    wall: float,
    *,
    pushed: Sequence[int] | None = None,
    happened: Sequence[Event] = (),
    base_as_planned: bool = True,
    pictured: bool = True,
    begun: float = 0.0,
) -> Record:
    """Name the columns that the kernels wrote.

    ``pushed`` : which of the bodies' own wrenches, the last of the loads, have been set; None: there are none
    ``happened`` : events of the run
    ``base_as_planned`` : whether the wheels of a base follow what ``prepared.control`` says, and from its start
    ``pictured`` : with the scene, the poses of its bodies, and provenance
    ``begun`` : time at which the run began [s]; when samples begin later, all but the effort is counted from there
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
    # One unit for all: that of the columns that servos replay and figures draw.
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
        record.add("hand_turn_error", turned, "rad", description="angle between the hand's orientation and its target")
    _add_energies(record, prepared, pushed)
    for store, name in zip(_by_column(run.outputs("energy")), metrics.STORES, strict=True):
        record.add(name, store, "J", description=f"{name.removeprefix('energy_')} energy")
    record.add("energy_residual", metrics.energy_residual(record), "J", description="what the ledger does not explain")
    touch = run.outputs("contact")
    vector, slip = slice(kst.OUT_VECTOR, kst.OUT_VECTOR + 3), slice(kst.OUT_SLIP, kst.OUT_SLIP + 3)
    record.add(
        "contact_normal_force", touch[:, :, kst.OUT_FORCE], "N", labels=names, description="f_n; negative: pulling"
    )
    record.add("contact_force", touch[:, :, vector], "N", labels=names, description="normal and friction force, W")
    record.add("contact_gap", touch[:, :, kst.OUT_GAP], "m", labels=names, description="distance from the surface")
    record.add("contact_slip_velocity", touch[:, :, slip], "m/s", labels=names)
    _add_touch(record, prepared)
    if prepared.system.unilateral is not None:
        _add_unilateral(record, prepared)
    for event in happened:
        record.add_event(event.time, event.kind, event.name)
    if pictured:
        record.scene = robot_scene(robot, contacts, build.surfaces(scenario))
        if add_body_poses(record):
            _add_touching_points(record, robot, contacts)
    end = _end(record, prepared, pushed, begun, within=lost)
    record.summary = metrics.summarise(record, end, scenario, prepared, wall, begun)
    return record


def _end(record: Record, prepared: Prepared, pushed: Sequence[int] | None, begun: float, *, within: bool) -> Record:
    """All integrals at the end of what the summary is of, as a record of one sample.

    That is the whole run, whose tallies count up to its present time, which may be later than the last sample; of a
    ring that has lost samples (``within``) it is what it has.
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


def _add_energies(record: Record, prepared: Prepared, pushed: Sequence[int] | None) -> None:
    """Integrals of powers, and energies of impacts and of the scheme."""
    run, robot = prepared.run, prepared.model.robot
    for integral, (name, text) in zip(_by_column(run.states("ledger")), metrics.INTEGRALS.items(), strict=True):
        record.add(name, integral, "J", description=text)
    if prepared.system.unilateral is not None:
        for integral, (name, text) in zip(_by_column(run.states("loss")), metrics.LOSSES.items(), strict=True):
            record.add(name, integral, "J", description=text)
    if run.stepping is not None:
        record.add("loss_scheme", run.states("scheme")[:, 0], "J", description=metrics.SCHEME)
    if run.states("elastic").size:
        for integral, (name, text) in zip(_by_column(run.states("elastic")), metrics.ELASTIC.items(), strict=True):
            record.add(name, integral, "J", description=text)
    others = 0 if pushed is None else len(robot.bodies)
    shown = [*range(len(prepared.loads) - others), *(pushed or ())]
    if shown:
        labels = tuple(prepared.loads[k].name for k in shown)
        record.add("work_loads", run.states("load")[:, shown], "J", labels=labels, description="∫ W·V dt of each load")


def _add_touch(record: Record, prepared: Prepared) -> None:
    """Integrals of forces and slip of the contacts."""
    names, rows = tuple(contact.name for contact in prepared.contacts), len(record)
    integrals = prepared.run.states("contact").reshape(rows, len(names), kst.CONTACT_SIZE)
    record.add("contact_impulse", integrals[:, :, kst.IMPULSE], "N s", labels=names, description="∫ f_n dt")
    record.add("contact_slip_distance", integrals[:, :, kst.SLIP], "m", labels=names, description="∫ |v_t| dt")


def _by_column(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns beside each other in memory: the ledger is summed up from them again and again."""
    return np.ascontiguousarray(table.T)


def _add_unilateral(record: Record, prepared: Prepared) -> None:
    """Modes of the contacts, forces of joint stops, dry frictions and ties."""
    run, robot = prepared.run, prepared.model.robot
    names = tuple(contact.name for contact in prepared.contacts)
    modes = run.outputs("contact")[:, :, kst.OUT_MODE]
    record.add("contact_mode", modes, "1", labels=names, description="0 off its surface, 1 sliding, 2 sticking")
    if prepared.stops:
        units = {link.joint: link.units[3] for link in robot.links}
        joints = tuple(dict.fromkeys(stop.joint for stop in prepared.stops))
        force = np.zeros((len(record), len(joints)))
        for stop, column in zip(prepared.stops, run.outputs("stop").T, strict=True):
            force[:, joints.index(stop.joint)] += stop.side * column
        unit = " or ".join(dict.fromkeys(units[joint] for joint in joints))
        record.add("stop_force", force, unit, labels=joints, description="of joint stops; positive at a lower limit")
    if prepared.dry:
        units = {link.joint: link.units[3] for link in robot.links}
        joints = tuple(friction.joint for friction in prepared.dry)
        unit = " or ".join(dict.fromkeys(units[joint] for joint in joints))
        record.add("joint_friction", run.outputs("dry"), unit, labels=joints, description="dry friction on the joints")
    if robot.ties:
        unit = " or ".join(dict.fromkeys("N m" if tie.turns else "N" for tie in robot.ties))
        names = tuple(tie.name for tie in robot.ties)
        record.add("tie_force", run.outputs("tie"), unit, labels=names, description="on the first body of each tie")


def _add_touching_points(record: Record, robot: Robot, contacts: Sequence[Contact]) -> None:
    """Where forces act on spheres and capsules, in single precision as the poses; on points it is where they are."""
    shaped = [contact for contact in contacts if contact.radius > 0.0 or contact.tip is not None]
    if not shaped:
        return
    places = np.empty((len(record), len(shaped), 3), dtype=np.float32)
    # The last samples of a run that diverged may be beyond all bounds.
    with np.errstate(over="ignore", invalid="ignore"):
        for k, contact in enumerate(shaped):
            ends = [
                point_positions(record, Point(contact.name, "contact", body, vector3(at)))
                for body, at in (
                    robot.attach(contact.body, end) for end in (contact.point, contact.tip) if end is not None
                )
            ]
            places[:, k] = touching_points(contact, *ends)
    names = tuple(contact.name for contact in shaped)
    record.add(TOUCHING, places, "m", labels=names, description="where forces act on spheres and capsules")


def _add_base(record: Record, prepared: Prepared, base: MobileBase, as_planned: bool) -> None:
    """Where the base is and should be, and what the ground carries; see dynsim.dynamics.tree.support."""
    robot, run = prepared.model.robot, prepared.run
    pose, speed = base_pose(robot, run.states("q")), run.states("v")[:, list(map(robot.joint_names.index, base.wheels))]
    record.add("base_pose", pose, "m, m, rad", labels=("x", "y", "heading"), description="base in the world")
    target = prepared.control.base_target(robot, record.time) if as_planned else None
    if target is not None:
        record.add("base_target", target, "m, m, rad", labels=("x", "y", "heading"), description="by the references")
    sides, support = SUPPORTS[:2], run.outputs("support")
    parts = (slice(ks.LOADS, ks.LOADS + 3), slice(ks.PRESSURE, ks.PRESSURE + 2), slice(ks.TRACTION, ks.TRACTION + 2))
    load, pressure, traction = (support[:, part] for part in parts)
    record.add("wheel_speed", speed, "rad/s", labels=sides, description="positive rolls ahead")
    record.add("wheel_load", load, "N", labels=SUPPORTS, description="normal forces; negative: pulling")
    record.add("center_of_pressure", pressure, "m", labels=("x", "y"), description="in the world; NaN for no load")
    record.add("tip_margin", support[:, ks.MARGIN], "1", description="1 at the incentre, 0 tipping; -1 lifted")
    record.add("traction_demand", traction, "1", labels=sides, description="|F|/(μ N); NaN without load")


def _joint_units(links: Iterable[Link]) -> Sequence[str]:
    """Units of position, velocity, acceleration and force of joints; "rad or m" when there are both kinds."""
    units = sorted({link.units for link in links}, reverse=True)
    return [" or ".join(dict.fromkeys(kinds)) for kinds in zip(*units, strict=True)]
