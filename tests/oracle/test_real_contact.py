"""Real contact against Pinocchio's ADMM solver of the same problem, and against MuJoCo's soft contacts."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from support.pinocchio_oracle import Oracle
from support.random_robots import assemble, random_contacts, random_positions, random_robot

from dynsim.dynamics.state import OUT_FORCE, OUT_VECTOR
from dynsim.integrators import run as ki
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot, vector

mujoco = pytest.importorskip("mujoco", minversion="4.0")

G = 9.81


def admm(W: np.ndarray, b: np.ndarray, mu: list[float]) -> tuple[np.ndarray, float]:
    """Forces (tangents, normal for each contact) by Pinocchio's ADMM solver, and its residual [N, m/s²]."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    models, datas = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
    for coefficient in mu:
        contact = pin.PointContactConstraintModel(model, 1)
        contact.setFriction(coefficient)
        models.append(pin.ConstraintModel(contact))
        datas.append(models[len(models) - 1].createData())
    settings, result = pin.ADMMSolverSettings(), pin.ADMMSolverResult()
    settings.max_iterations, settings.solve_ncp = 20000, True
    settings.absolute_feasibility_tol = settings.absolute_complementarity_tol = 1e-11
    settings.relative_feasibility_tol = settings.relative_complementarity_tol = 1e-12
    solver = pin.ADMMConstraintSolver(len(b))
    solver.solve(pin.DelassusOperatorDense(W), b, models, datas, settings, result)
    left = max(result.primal_feasibility, result.dual_feasibility, result.complementarity)
    return np.array(result.retrieveConstraintImpulses()), float(left)


def test_accelerations_from_rest_agree_with_admm():
    """Random robots at rest on random surfaces: which contacts leave, hold or give way, and v̇."""
    compared, agree = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(3, 9))
        robot = random_robot(rng, n, branches=bool(rng.random() < 0.5), motors=False)
        q = random_positions(rng, robot)
        contacts = [
            Contact(
                c.name, c.body, c.point, c.surface, friction=float(rng.uniform(0.1, 0.8)), pulling_friction="signed"
            )
            for c in random_contacts(rng, robot, q, int(rng.integers(1, 4)))
        ]
        b = assemble(robot, contacts, real=True)
        run = b.advance(b.new_run(b.state(q, np.zeros(n)), np.array([0.0, 1e-9])))
        if run.count[ki.STATUS] != ki.FINISHED:
            assert run.count[ki.STATUS] in (ki.FORCES_REVERSED, ki.NO_CONTACT_FORCES)
            continue
        ours = run.outputs("vdot")[0]
        oracle = Oracle(robot)
        M, rows, turn = oracle.mass_matrix(q), [], []
        for contact in contacts:
            body = robot.bodies.index(contact.body)
            position, J, _, _ = oracle.point(body, contact.point, q, np.zeros(n))
            normal = contact.surface.normal(position)
            first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
            first /= np.linalg.norm(first)
            turn.append(np.array([first, np.cross(normal, first), normal]))
            rows.append(J)
        world = np.vstack(rows)
        J = np.vstack([R @ row for R, row in zip(turn, rows, strict=True)])
        free = oracle.back(pin.aba(oracle.model, oracle.data, *(oracle.to(x) for x in (q, np.zeros(n), np.zeros(n)))))
        W = J @ np.linalg.solve(M, J.T)
        force = run.outputs("contact")[0, :, OUT_VECTOR : OUT_VECTOR + 3].ravel()
        np.testing.assert_allclose(M @ (ours - free), world.T @ force, rtol=0, atol=1e-9 * (1.0 + np.abs(force).max()))
        for k, contact in enumerate(contacts):
            mine = slice(3 * k, 3 * k + 3)
            check_law(turn[k] @ force[mine], J[mine] @ ours, contact.friction)
        f, left = admm(W, J @ free, [c.friction for c in contacts])
        if left > 1e-8:
            continue
        theirs = free + np.linalg.solve(M, J.T @ f)
        compared += 1
        agree += int(np.abs(ours - theirs).max() <= 1e-5 * (1.0 + np.abs(theirs).max()))
    # What is left has several solutions: a point that friction could jam, or let go.
    assert compared >= 25
    assert agree >= 0.9 * compared


def check_law(f: np.ndarray, a: np.ndarray, mu: float) -> None:
    """Coulomb's law between force and acceleration of a point at rest, along two tangents and the normal."""
    small, slow = 1e-8 * (1.0 + np.abs(f).max()), 1e-6 * (1.0 + np.abs(a).max())
    assert f[2] >= -small
    assert a[2] >= -slow
    assert min(f[2] / (1.0 + f[2]), a[2]) <= slow
    size, speed = float(np.linalg.norm(f[:2])), float(np.linalg.norm(a[:2]))
    assert size <= mu * f[2] + small
    if speed > slow and f[2] > small:
        assert f[:2] @ a[:2] == pytest.approx(-mu * f[2] * speed, rel=1e-5, abs=1e-7)


def mujoco_slope(alpha: float, mu: float, step: float) -> tuple[object, object]:
    """A ball of 3 kg that does not turn, on a slope that leans by α [rad]: elliptic cones, stiff contact."""
    gravity = f"{G * np.sin(alpha)} 0 {-G * np.cos(alpha)}"
    peer = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{step}" gravity="{gravity}" cone="elliptic" iterations="200" tolerance="1e-14"/>
        <worldbody><geom type="plane" size="50 50 1" condim="3" friction="{mu}" solref="{2 * step} 1"/>
        <body pos="0 0 0.05"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
        <joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.05" mass="3" condim="3" friction="{mu}"
        solref="{2 * step} 1"/></body></worldbody></mujoco>"""
    )
    return peer, mujoco.MjData(peer)


def slide(peer: object, data: object, duration: float) -> np.ndarray:
    for _ in range(round(duration / peer.opt.timestep)):
        mujoco.mj_step(peer, data)
    return np.array([data.qpos[0], data.qvel[0]])


def ours_on_slope(alpha: float, mu: float, duration: float) -> tuple[float, np.ndarray, float]:
    names = "xyz"
    links = tuple(
        Link(name, f"j{name}", names[k - 1] if k else None, "prismatic", np.eye(3)[k], Inertia(3.0 if k == 2 else 0.0))
        for k, name in enumerate(names)
    )
    gravity = G * vector(np.sin(alpha), 0.0, -np.cos(alpha))
    floor = Quadric(np.zeros((3, 3)), vector(0, 0, 1), 0.0)
    contact = Contact("foot", "z", np.zeros(3), floor, friction=mu, pulling_friction="signed")
    b = assemble(Robot("block", links, (), ("z", np.zeros(3)), gravity), [contact], real=True)
    run = b.simulate(b.state(np.zeros(3), np.zeros(3)), np.array([0.0, duration]))
    touch = run.outputs("contact")[-1, 0]
    return float(run.states("q")[-1, 0]), touch[OUT_VECTOR : OUT_VECTOR + 3], float(touch[OUT_FORCE])


def test_mujoco_slides_down_a_slope_as_fast():
    """Above the cone both slide with g (sin α − μ cos α): MuJoCo to the order of its step and its softness."""
    alpha, mu, duration = 0.5, 0.3, 0.5
    distance, _, _ = ours_on_slope(alpha, mu, duration)
    assert distance == pytest.approx(0.5 * G * (np.sin(alpha) - mu * np.cos(alpha)) * duration**2, rel=1e-9)
    peer, data = mujoco_slope(alpha, mu, 1e-4)
    assert slide(peer, data, duration)[0] == pytest.approx(distance, rel=5e-3)
    mean, wrench = np.zeros(2), np.zeros(6)
    for _ in range(2000):
        mujoco.mj_step(peer, data)
        if data.ncon:
            mujoco.mj_contactForce(peer, data, 0, wrench)
            mean += np.array([wrench[0], np.hypot(wrench[1], wrench[2])]) / 2000
    # Its ball rattles on the stiff floor; the forces keep to the cone all the same.
    assert mean[1] == pytest.approx(mu * mean[0], rel=5e-3)


def test_mujoco_creeps_inside_its_cone_and_dynsim_does_not():
    """The same friction force, m g sin α; MuJoCo's needs a speed to be made, dynsim's is that of a constraint."""
    alpha, mu = 0.3, 0.5
    distance, force, f_n = ours_on_slope(alpha, mu, 20.0)
    assert abs(distance) <= 1e-12
    np.testing.assert_allclose(force, 3.0 * G * vector(-np.sin(alpha), 0.0, np.cos(alpha)), rtol=1e-9, atol=1e-9)
    assert abs(force[0]) < mu * f_n
    peer, data = mujoco_slope(alpha, mu, 1e-3)
    settled = slide(peer, data, 1.0)
    later = slide(peer, data, 1.0)
    creep = later[0] - settled[0]
    assert 1e-6 < creep < 1e-2
    assert later[1] == pytest.approx(creep, rel=1e-3)
    wrench = np.zeros(6)
    mujoco.mj_contactForce(peer, data, 0, wrench)
    assert np.hypot(wrench[1], wrench[2]) == pytest.approx(abs(force[0]), rel=1e-3)
