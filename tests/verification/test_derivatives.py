"""Derivatives of inverse dynamics: against Pinocchio's, and against differences for every kind of joint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from support.pinocchio_oracle import Oracle

import dynsim
from dynsim import Model
from dynsim.dynamics.tree.joints import positions_along
from dynsim.model.description import Inertia, Link, Robot
from dynsim.model.joints.ball import ball, floating
from dynsim.model.joints.planar import planar, rolling
from dynsim.scenario import load_scenario

BOX = Inertia(1.2, np.array([0.02, -0.01, 0.1]), np.array([[0.03, 0.002, 0], [0.002, 0.04, -0.001], [0, -0.001, 0.02]]))


@pytest.mark.parametrize("name", ["elbow_comparison", "six_axis_arm", "thirty_links", "wall_push"])
def test_they_are_those_of_pinocchio(name: str) -> None:
    """computeRNEADerivatives of random states, to 1e-12 of the largest entry."""
    model = dynsim.build_model(load_scenario(name))
    oracle = Oracle(model.robot)
    rng = np.random.default_rng(5)
    for _ in range(3):
        q, v, vdot = rng.uniform(-1.5, 1.5, (3, model.n))
        actual = model.derivatives(q, v, vdot)
        by_q, by_v, M = pin.computeRNEADerivatives(oracle.model, oracle.data, *map(oracle.to, (q, v, vdot)))
        M = np.triu(M) + np.triu(M, 1).T
        for ours, theirs in ((actual.q, by_q), (actual.v, by_v), (actual.vdot, M)):
            expected = oracle.back(oracle.back(theirs).T).T
            np.testing.assert_allclose(ours, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


def machines() -> dict[str, Robot]:
    """A free body with a ball, a planar and a prismatic joint; an arm on a rolling base; one on wheels."""
    body = Link("torso", "free", None, "revolute", np.array([0.0, 0.0, 1.0]), BOX)
    arm = replace(body, name="arm", joint="shoulder", parent="torso", p_PJ=np.array([0.1, 0.2, 0.3]))
    plate = replace(arm, name="plate", joint="slab", axis=np.array([0.6, 0.0, 0.8]))
    rod = replace(plate, name="rod", joint="lift", parent="arm", kind="prismatic")
    hand = replace(rod, name="tip", joint="turn", parent="torso", kind="revolute", axis=np.array([0.0, 1.0, 0.0]))
    return {
        "free": Robot("free", (*floating(body), *ball(arm), *planar(plate), rod), (), ("rod", np.zeros(3))),
        "rolling": Robot("rolling", (*rolling(body), hand, replace(rod, parent="tip")), (), ("rod", np.zeros(3))),
        "wheeled": dynsim.build_model(load_scenario("mobile_reach")).robot,
    }


def difference(model: Model, q: np.ndarray, v: np.ndarray, vdot: np.ndarray, along: np.ndarray) -> np.ndarray:
    """∂tau/∂q along rates, by central differences of fourth order."""
    slope, step = np.zeros(model.nq), 1e-3
    positions_along(model.arrays, q, 0, along, slope)

    def at(h: float) -> np.ndarray:
        return model.inverse_dynamics(q + h * slope, v, vdot)

    return (8.0 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12.0 * step)


@pytest.mark.parametrize("name", machines())
def test_they_are_differences_for_every_kind_of_joint(name: str) -> None:
    model = Model(machines()[name])
    rng = np.random.default_rng(6)
    q = rng.uniform(-1.0, 1.0, model.nq)
    v, vdot = rng.uniform(-1.0, 1.0, (2, model.n))
    actual = model.derivatives(q, v, vdot)
    by_q = np.stack([difference(model, q, v, vdot, along) for along in np.eye(model.n)], axis=1)
    size = np.abs(by_q).max()
    np.testing.assert_allclose(actual.q, by_q, rtol=0.0, atol=1e-9 * size)
    # tau is a quadratic of v: central differences are exact.
    by_v = [
        0.5 * (model.inverse_dynamics(q, v + e, vdot) - model.inverse_dynamics(q, v - e, vdot)) for e in np.eye(model.n)
    ]
    np.testing.assert_allclose(actual.v, np.stack(by_v, axis=1), rtol=0.0, atol=1e-11 * size)
    np.testing.assert_allclose(actual.vdot, model.mass_matrix(q), rtol=0.0, atol=1e-12 * size)
