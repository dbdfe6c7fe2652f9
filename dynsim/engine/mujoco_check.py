"""Comparison of a scenario with its MJCF export: features that are not exported, and the same run in MuJoCo."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dynsim.compile.scene import drawn_surface
from dynsim.engine.prepare import Prepared
from dynsim.errors import ModelError, first_few
from dynsim.model.description import Array, Load, Robot
from dynsim.model.drives import Motor, Servo
from dynsim.model.mjcf import control_scale
from dynsim.record import Record
from dynsim.scenario import Scenario, build

STEPS = (1e-3, 1e-4)
"""Longest steps of the comparison [s]: the step of the exported file, and a tenth of it."""


def omissions(scenario: Scenario, prepared: Prepared, touching: bool) -> list[str]:
    """Return a text for each feature of a scenario that its MJCF export omits or approximates.

    Parameters
    ----------
    scenario, prepared : Scenario, Prepared
        The scenario, and the same compiled.
    touching : bool
        Whether contacts are exported.
    """
    robot, contacts = prepared.model.robot, prepared.contacts
    law = scenario.config.contacts.law
    surfaces = {name: (drawn_surface(name, s), s.carrier) for name, s in build.surfaces(scenario).items()}
    unsupported = [
        name for name, (s, _) in surfaces.items() if s.kind in ("quadric", "height_field") or (s.radius or 0.0) < 0.0
    ]
    moving = [name for name, (s, carrier) in surfaces.items() if s.kind == "plane" and carrier]
    lost = [c.name for c in contacts if not touching or c.surface_name in (*unsupported, *moving)]
    kept = [c for c in contacts if c.name not in lost]
    dc = [m for m in robot.motors if isinstance(m, Motor)]
    servos = [m for m in robot.motors if isinstance(m, Servo)]
    reference = prepared.system.reference
    features = {
        "contacts do not collide; pass --contacts": lost if not touching else [],
        "MJCF has no such surface; contacts there are omitted": unsupported if touching else [],
        "in MuJoCo, planes are fixed to the world; contacts on planes of bodies are omitted; use a box": (
            moving if touching else []
        ),
        "bilateral contacts become unilateral": [c.name for c in kept] if law == "bilateral" else [],
        "restitution is omitted": [c.name for c in kept if c.restitution > 0.0],
        "friction keeps only its kinetic coefficient": [
            c.name
            for c in kept
            if c.friction_at_rest != c.friction or c.stribeck or c.viscous_friction or c.grip != 1.0
        ],
        "contact stiffness and damping are omitted": [c.name for c in kept if c.stiffness > 0.0],
        "loads are omitted, but --check applies them": [load.name for load in prepared.loads],
        "the current limit bounds the torque, not the voltage": [m.joint for m in dc if np.isfinite(m.current_limit)],
        "smoothed gear friction becomes dry friction": [
            m.joint for m in servos if m.coulomb_friction and (m.coulomb_speed is not None or law == "bilateral")
        ],
        "dry friction has no effect in dynsim under the bilateral law": [
            *(link.joint for link in robot.links if link.friction and law == "bilateral"),
            *(m.joint for m in dc if m.dry_friction and law == "bilateral"),
        ],
        "joint limits have no effect in dynsim under the bilateral law": [
            link.joint for link in robot.links if law == "bilateral" and np.isfinite([link.lower, link.upper]).all()
        ],
        "commands are continuous, not sampled": ["controller.sample_time_s"] if prepared.control.sample_time else [],
        "planned voltages are part of the controls": ["controller.feed_forward"] if reference.voltage.size else [],
    }
    return [f"{first_few(names)}: {text}" for text, names in features.items() if names]


class Difference(NamedTuple):
    """Largest difference between dynsim and MuJoCo: quantity, its value and unit, label of the column, and time [s]."""

    quantity: str
    value: float
    unit: str
    label: str
    time: float


def mujoco_for(prepared: Prepared) -> Any:
    """Return the module of MuJoCo, which can run the exported scenario.

    Raises
    ------
    ModelError
        If MuJoCo is not installed, or an operator or a controller rewrites the references during the run.
    """
    if prepared.control.teleop is not None or prepared.control.task_space is not None:
        raise ModelError("--check requires references that are known in advance; here they depend on the run")
    try:
        return importlib.import_module("mujoco")
    except ImportError as error:
        raise ModelError(f"--check requires MuJoCo: pip install 'mujoco>=4.0' ({error})") from error


def compare(prepared: Prepared, record: Record, path: Path) -> dict[float, list[Difference]]:
    """Run an exported scenario in MuJoCo and return the largest differences from its record, by longest step [s].

    Parameters
    ----------
    prepared, record : Prepared, Record
        The compiled scenario, and its record.
    path : Path
        Exported file.

    Raises
    ------
    ModelError
        If MuJoCo cannot read the file or diverges; see also :func:`mujoco_for`.
    """
    mujoco = mujoco_for(prepared)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ModelError(f"{path}: MuJoCo cannot read this file: {' '.join(str(error).split())}") from error
    # Otherwise MuJoCo prints its warnings, and writes them to a file in the working directory.
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        return {step: list(_differences(mujoco, model, prepared, record, step)) for step in STEPS}
    finally:
        mujoco.set_mju_user_warning(None)


def _differences(mujoco: Any, model: Any, prepared: Prepared, record: Record, step: float) -> Iterator[Difference]:
    robot = prepared.model.robot
    at_q, at_v = _coordinates(model, robot)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    time, q, v = record.time, record["q"], record["v"]
    data.qpos[at_q], data.qvel[at_v] = q[0], v[0]
    _set_currents(mujoco, model, data, record)
    peer_q, peer_v, energy = np.full_like(q, np.nan), np.full_like(v, np.nan), np.full((len(time), 2), np.nan)
    for k, t in enumerate(time):
        if k:
            count = int(np.ceil((t - time[k - 1]) / step * (1.0 - 1e-9)))
            model.opt.timestep = (t - time[k - 1]) / count
            starts = time[k - 1] + model.opt.timestep * np.arange(count)
            wrenches = [load.components(starts) for load in prepared.loads]
            for i, control in enumerate(controls(prepared, starts)):
                data.ctrl[:] = control
                _apply_loads(mujoco, model, data, prepared.loads, [wrench[i] for wrench in wrenches])
                mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        peer_q[k], peer_v[k] = data.qpos[at_q], data.qvel[at_v]
        energy[k] = data.energy[1], data.energy[0]
        if not data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number == 0:
            raise ModelError(f"MuJoCo's simulation with steps of {1e3 * step:g} ms diverges at t = {t:.4g} s")
    own = np.stack([record["energy_kinetic"], record["energy_potential"] - record["energy_potential"][0]], axis=1)
    energy[:, 1] -= energy[0, 1]
    of_rates = {link.joint: link.units[1] for link in robot.links}
    of_positions = {name: link.units[0] for link in robot.links for name in link.coordinates}
    for quantity, error, labels, unit in (
        ("position", peer_q - q, record.labels["q"], of_positions),
        ("velocity", peer_v - v, record.labels["v"], of_rates),
        ("energy", energy - own, ("kinetic", "potential"), dict.fromkeys(("kinetic", "potential"), "J")),
    ):
        k, column = np.unravel_index(np.abs(error).argmax(), error.shape) if error.size else (0, 0)
        label = labels[column]
        yield Difference(quantity, float(np.abs(error[k, column])), unit[label], label, float(time[k]))


def _apply_loads(mujoco: Any, model: Any, data: Any, loads: Sequence[Load], wrenches: Sequence[Array]) -> None:
    """Apply the wrenches of loads, (6,) each [N, N m], at the present posture."""
    if not loads:
        return
    data.qfrc_applied[:] = 0.0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    for load, wrench in zip(loads, wrenches, strict=True):
        body = data.body(load.body)
        R = body.xmat.reshape(3, 3)
        force, torque = ((R if load.in_body else np.eye(3)) @ part for part in (wrench[:3], wrench[3:]))
        mujoco.mj_applyFT(model, data, force, torque, body.xpos + R @ load.point, body.id, data.qfrc_applied)


def _coordinates(model: Any, robot: Robot) -> tuple[Array, Array]:
    """Return the indices in MuJoCo's positions and velocities of a robot's coordinates, (nq,), and rates, (n,)."""
    names = {model.joint(k).name for k in range(model.njnt)}
    at_q, at_v = np.zeros(robot.nq, dtype=int), np.zeros(len(robot.links), dtype=int)
    rows, joint = dict.fromkeys(names, 0), ""
    for i, (link, first) in enumerate(zip(robot.links, robot.position_index, strict=True)):
        # A free joint has the name of the joint of its rows; a ball joint has the name of its first row.
        joint = next((name for name in (link.joint_of_rows or "", link.joint) if name in names), joint)
        start, width, row = model.joint(joint), len(link.row.neutral), rows[joint]
        at_v[i] = start.dofadr[0] + row
        at_q[first : first + width] = start.qposadr[0] + row + np.arange(width)
        rows[joint] += 1
    return at_q, at_v


def _set_currents(mujoco: Any, model: Any, data: Any, record: Record) -> None:
    """Set the currents of DC motors to their values at the start of a record."""
    for label, current in zip(record.labels["current"], record["current"][0], strict=True):
        actuator = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, label)
        if model.actuator_actnum[actuator]:
            data.act[model.actuator_actadr[actuator]] = current


def controls(prepared: Prepared, times: Array) -> Array:
    """Return the controls of the exported actuators at times [s], (T, na); see :mod:`dynsim.model.mjcf`."""
    reference, control = prepared.system.reference, prepared.control
    position, rate = np.tile(reference.held, (len(times), 1)), np.zeros((len(times), len(reference.held)))
    moving = reference.spline >= 0
    pieces, x = _pieces(reference.coefficients, reference.grid, times)
    pieces = pieces[:, reference.spline[moving]]
    position[:, moving] = np.einsum("tac,tc->ta", pieces, x)
    rate[:, moving] = np.einsum("tac,tc->ta", pieces[..., 1:] * np.arange(1, 6), x[:, :5])
    scale = np.array(
        [control_scale(*loop) for loop in zip(prepared.model.robot.motors, control.k_p, control.k_d, strict=True)]
    ).reshape(-1, 3)
    sent = position * scale[:, 0] + rate * scale[:, 1]
    if reference.voltage.size:
        planned, x = _pieces(reference.voltage, reference.grid, times, len(reference.voltage) * reference.grid[1])
        sent += np.einsum("tac,tc->ta", planned, x) * scale[:, 2]
    return sent


def _pieces(coefficients: Array, grid: Array, times: Array, end: float = np.inf) -> tuple[Array, Array]:
    """Return the polynomials of splines at times, (T, a, 6), and the powers of the time within them, (T, 6)."""
    x = np.minimum(times - grid[0], end)
    segment = np.clip((x / grid[1]).astype(int), 0, len(coefficients) - 1)
    return coefficients[segment], (x - segment * grid[1])[:, None] ** np.arange(6)
