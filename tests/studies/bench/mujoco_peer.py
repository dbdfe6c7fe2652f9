"""The benchmark robot in MuJoCo, also a reference for tests: bodies, DC motors, voltage PD, contacts, time loops.

Built from the compiled tables of a system, so that both programs get the same numbers. Needs MuJoCo ≥ 4.0, whose
``dcmotor`` actuator has an inductance and takes position and velocity set-points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System

Array = NDArray[np.float64]

# Radius of a sphere about the contact point, which rests on a plane that is lower by this [m].
FOOT_RADIUS = 0.01
# Constraint impedance close to one: the minimum softness that MuJoCo's solver accepts.
STIFFEST = [0.9999, 0.9999, 0.001, 0.5, 2.0]


def build_mujoco(
    system: System,
    *,
    step: float,
    integrator: Literal["euler", "implicitfast"] = "euler",
    motors: bool = True,
    contacts: Literal["none", "soft", "equality"] = "none",
    cone: Literal["pyramidal", "elliptic"] = "pyramidal",
) -> Any:
    """Return the bodies, motors and contacts of ``system`` as a ``mujoco.MjModel``.

    Parameters
    ----------
    step : time step [s]
    motors : with ``dcmotor`` actuators and their PD (see :func:`setpoints`), or bodies only
    contacts : {"none", "soft", "equality"}
        "soft": MuJoCo's own contact of a small sphere with the floor z = 0: unilateral, with its soft friction.
        "equality": the point is held at its distance from the centre of a sphere surface by an equality constraint
        on the length of a tendon, MuJoCo's one-row bilateral constraint; without friction.
    cone : friction cone: MuJoCo's default, which is faster, or Coulomb's cone

    Notes
    -----
    The controller of ``dcmotor`` requests a torque and applies u = (R/K) τ + K v, compensating the back-EMF. With the
    torque gains k_p K/R and (k_d + K) K/R and a velocity set-point scaled by k_d/(k_d + K) this is exactly
    u = k_p (q_d − q) + k_d (v_d − v). K_m, J_m and D_m already include gear ratios.
    """
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = step
    spec.option.gravity = system.model.gravity
    spec.option.integrator = {
        "euler": mujoco.mjtIntegrator.mjINT_EULER,
        "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    }[integrator]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if cone == "elliptic" else mujoco.mjtCone.mjCONE_PYRAMIDAL
    bodies = _add_bodies(spec, system)
    if motors:
        _add_motors(spec, system)
    # Time constant of the soft constraints [s] and damping ratio: the stiffest that MuJoCo allows.
    solref = [2.0 * step, 1.0]
    radii = []
    for k in range(len(system.contacts.link)):
        body = bodies[system.contacts.link[k, ka.LINK]]
        point, mu = system.contacts.point[k], float(system.contacts.law[k, ka.MU])
        if contacts == "soft":
            _add_soft_contact(spec, body, k, point, mu, solref)
        elif contacts == "equality":
            radii.append(_add_tendon(spec, body, k, point, solref))
    model = spec.compile()
    # The equality refers to the tendon's length at q = 0, which only the compiled model contains.
    for k, radius in enumerate(radii):
        model.eq_data[k, 0] = radius - model.tendon_length0[k]
    return model


def state_of(model: Any, q: Array) -> Array:
    """Return MuJoCo's full physics state (time, q, v, activations) for rest in posture q without currents."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = q
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state


def setpoints(system: System, times: Array) -> Array:
    """Return controls of the ``dcmotor`` actuators at times, (T, 2 na): position and scaled velocity per motor."""
    position, rate = references(system, times)
    motor = system.drives.motor
    k_d = motor[:, ka.K_D]
    controls = np.empty((len(times), 2 * len(motor)))
    controls[:, 0::2] = position
    controls[:, 1::2] = rate * k_d / (k_d + motor[:, ka.K_M])
    return controls


def references(system: System, times: Array) -> tuple[Array, Array]:
    """Return joint references q_d and v_d of all motors, (T, na) [rad, rad/s], from the spline table of the kernels."""
    reference = system.reference
    start, spacing = reference.grid
    coefficients = reference.coefficients
    segment = np.clip(np.floor((times - start) / spacing).astype(int), 0, len(coefficients) - 1)
    x = (times - start - segment * spacing)[:, None]
    position = np.tile(reference.held, (len(times), 1))
    rate = np.zeros_like(position)
    for a, s in enumerate(reference.spline):
        if s >= 0:
            c = coefficients[segment, s]  # (T, 6)
            position[:, a] = (c * x ** np.arange(6)).sum(axis=1)
            rate[:, a] = (c[:, 1:] * np.arange(1, 6) * x ** np.arange(5)).sum(axis=1)
    return position, rate


def roll_out(model: Any, data: Any, start: Array, controls: Array) -> tuple[Array, Array, Array]:
    """Run one step per row of ``controls`` in one native call.

    Returns q, v and i after each step, (T, n), (T, n), (T, na).

    Parameters
    ----------
    start : full physics state; controls : (T, nu)
    """
    from mujoco import rollout

    states, _ = rollout.rollout(model, data, start[None], controls[None])
    path = states[0]
    nq, nv = model.nq, model.nv
    return path[:, 1 : 1 + nq], path[:, 1 + nq : 1 + nq + nv], path[:, 1 + nq + nv :]


def steps_call(model: Any, q: Array, batch: int, steps: int) -> Callable[[], Any]:
    """Return a native call of ``batch`` short runs from rest at q, of ``steps`` steps: contacts do not change."""
    import mujoco
    from mujoco import rollout

    data = mujoco.MjData(model)
    start = np.tile(state_of(model, q), (batch, 1))
    return lambda: rollout.rollout(model, data, start, nstep=steps)


def _add_bodies(spec: Any, system: System) -> list[Any]:
    import mujoco

    tree, table = system.model.tree, system.model.body
    bodies: list[Any] = []
    for i in range(len(tree)):
        row = table[i]
        parent = spec.worldbody if tree[i, ka.PARENT] < 0 else bodies[tree[i, ka.PARENT]]
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, row[ka.R_PJ : ka.R_PJ + 9])
        xx, xy, xz, yy, yz, zz = row[ka.INERTIA : ka.INERTIA + 6]
        body = parent.add_body(
            name=f"body_{i}",
            pos=row[ka.P_PJ : ka.P_PJ + 3],
            quat=quaternion,
            mass=row[ka.MASS],
            ipos=row[ka.COM : ka.COM + 3],
            fullinertia=[xx, yy, zz, xy, xz, yz],
            explicitinertial=True,
        )
        prismatic = tree[i, ka.KIND] == ka.PRISMATIC
        body.add_joint(
            name=f"joint_{i}",
            type=mujoco.mjtJoint.mjJNT_SLIDE if prismatic else mujoco.mjtJoint.mjJNT_HINGE,
            axis=row[ka.AXIS : ka.AXIS + 3],
            armature=row[ka.ARMATURE],
            damping=row[ka.DAMPING] + row[ka.GEAR_DAMPING],
        )
        bodies.append(body)
    return bodies


def _add_motors(spec: Any, system: System) -> None:
    import mujoco

    for a, link in enumerate(system.drives.table[:, ka.DRIVEN]):
        motor = system.drives.motor[a]
        K, R = motor[ka.K_M], motor[ka.RESISTANCE]
        limit = motor[ka.U_MAX] if np.isfinite(motor[ka.U_MAX]) else 0.0
        actuator = spec.add_actuator(
            name=f"motor_{a}", target=f"joint_{link}", trntype=mujoco.mjtTrn.mjTRN_JOINT, gear=[1, 0, 0, 0, 0, 0]
        )
        actuator.set_to_dcmotor(
            motorconst=[K, 0.0],
            resistance=R,
            inductance=[motor[ka.INDUCTANCE], 0.0],
            controller=[motor[ka.K_P] * K / R, 0.0, (motor[ka.K_D] + K) * K / R, 0.0, 0.0, limit],
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_POS) | int(mujoco.mjtCtrlInput.mjINPUT_VEL),
        )


def _add_soft_contact(spec: Any, body: Any, k: int, point: Array, mu: float, solref: list[float]) -> None:
    import mujoco

    if k == 0:
        spec.worldbody.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[10, 10, 1],
            pos=[0, 0, -FOOT_RADIUS],
            contype=0,
            conaffinity=0,
        )
    body.add_geom(
        name=f"foot_{k}",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[FOOT_RADIUS, 0, 0],
        pos=point[ka.POINT : ka.POINT + 3],
        contype=0,
        conaffinity=0,
        mass=0.0,
    )
    pair = spec.add_pair(geomname1="floor", geomname2=f"foot_{k}", condim=3 if mu > 0.0 else 1, solref=solref)
    pair.friction = [mu, mu, 0.0, 0.0, 0.0]


def _add_tendon(spec: Any, body: Any, k: int, point: Array, solref: list[float]) -> float:
    import mujoco

    Q = point[[ka.QUADRIC, ka.QUADRIC + 3, ka.QUADRIC + 5]]
    if not (Q[0] == Q[1] == Q[2] != 0.0):
        raise ValueError("an equality constraint on a tendon stands for a sphere surface only")
    centre = -point[ka.QUADRIC + 6 : ka.QUADRIC + 9] / Q[0]
    radius = float(np.sqrt(centre @ centre - 2.0 * point[ka.QUADRIC + 9] / Q[0]))
    spec.worldbody.add_site(name=f"centre_{k}", pos=centre)
    body.add_site(name=f"point_{k}", pos=point[ka.POINT : ka.POINT + 3])
    tendon = spec.add_tendon(name=f"tendon_{k}")
    tendon.wrap_site(f"centre_{k}")
    tendon.wrap_site(f"point_{k}")
    equality = spec.add_equality(name=f"held_{k}", type=mujoco.mjtEq.mjEQ_TENDON, name1=f"tendon_{k}", solref=solref)
    equality.solimp = STIFFEST
    return radius
