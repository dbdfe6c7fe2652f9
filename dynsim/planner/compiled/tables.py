"""Tables of the arm, its contact points and its path, and the workspace of the compiled functions."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from dynsim.dynamics.contact.distance import ShapeArrays
from dynsim.dynamics.contact.solids import PairArrays


class Arm(NamedTuple):
    """Joints with one coordinate each and the bodies they carry; n joints, parents before children."""

    parent: np.ndarray  # (n,) int, index of the parent joint; −1: the fixed base
    prismatic: np.ndarray  # (n,) int, 1 or 0
    rotation: np.ndarray  # (n, 9) joint frame at q = 0 in the parent's frame, or in W on the base
    origin: np.ndarray  # (n, 3) origin of that frame [m]
    axis: np.ndarray  # (n, 3)
    mass: np.ndarray  # (n,) [kg]
    com: np.ndarray  # (n, 3) centre of mass in the body's frame [m]
    # For prismatic joints, read forces instead of torques, and metres instead of radians.
    losses: np.ndarray  # (n,) D + D_m [N m s/rad]
    heat: np.ndarray  # (n,) R / K_m² [W/(N m)²]
    greatest: np.ndarray  # (n,) maximum torque at rest [N m]; inf: no limit
    lower: np.ndarray  # (n,) joint limits
    upper: np.ndarray  # (n,)
    gravity: np.ndarray  # (1, 3)
    hand: np.ndarray  # (1,) int, body of the hand
    hand_point: np.ndarray  # (1, 3) [m]
    shapes: ShapeArrays  # the surfaces
    pairs: PairArrays | None = None  # solids that must stay clear of each other, on bodies or (−1) fixed in W


class Points(NamedTuple):
    """Contact points of c braces, followed by points and pairs of solids that must stay clear; P in total."""

    body: np.ndarray  # (P,) int
    point: np.ndarray  # (P, 3) in the body's frame [m]
    radius: np.ndarray  # (P,) radius of a sphere around the point [m]
    surface: np.ndarray  # (P,) int; −1 − m: pair m of solids
    margin: np.ndarray  # (P,) minimum distance [m]; not used for braces
    friction: np.ndarray  # (c,) μ


class Course(NamedTuple):
    """Knots k with targets of the hand, and instants e; the instants of one posture are consecutive."""

    target: np.ndarray  # (K, h) position of the hand [m]; with an orientation, also two of its axes
    knot: np.ndarray  # (E,) int, last knot before the instant
    blend: np.ndarray  # (E, K)
    chord: np.ndarray  # (E, K) [1/s]
    bend: np.ndarray  # (E, K) [1/s²]
    share: np.ndarray  # (E,) fraction of the time; the sum is 1
    smooth: np.ndarray  # (K, K) SᵀS, where S q measures the smoothness of q
    ripple: np.ndarray  # (K, K) mean square of the accelerations that the instants do not see [1/s⁴]
    slip_scale: np.ndarray  # (1,) v_s: slip at which friction approaches its full value [m/s]
    guided: np.ndarray  # (K, c) int, 1 if the distance of a brace from its surface is prescribed, or 0
    apart: np.ndarray  # (K, c) this distance, otherwise the minimum distance [m]
    acting: np.ndarray  # (E, c) int, 1 if a brace may press, or 0


class Work(NamedTuple):
    """Results and workspace; :func:`dynsim.planner.arm.workspace` reads shapes and types from the annotations."""

    torque: Annotated[np.ndarray, "E n"]
    inertia: Annotated[np.ndarray, "E n n"]  # J_m + M of a posture near the instant, constant during a solution
    jolt: Annotated[np.ndarray, "n n"]  # mean over instants of (J_m + M) w (J_m + M): heat per squared acceleration
    by_q: Annotated[np.ndarray, "E n n"]  # ∂τ/∂q at fixed v and f
    by_v: Annotated[np.ndarray, "E n n"]
    by_f: Annotated[np.ndarray, "E n c"]
    gap: Annotated[np.ndarray, "K+1 P"]  # distance from the surface minus radius; the last row is for an instant
    gap_rate: Annotated[np.ndarray, "K+1 P n"]  # of nearby points only
    hand: Annotated[np.ndarray, "K+1 h"]
    hand_rate: Annotated[np.ndarray, "K+1 h n"]
    R: Annotated[np.ndarray, "n 9"]
    p: Annotated[np.ndarray, "n 3"]
    a: Annotated[np.ndarray, "n 3"]  # joint axes in W
    below: Annotated[np.ndarray, "n 4"]  # mass and first moment of the bodies that a joint carries
    moment: Annotated[np.ndarray, "n 3"]  # lever × weight of the bodies that a joint carries
    touch: Annotated[np.ndarray, "c n 3"]  # velocity of the contact point per unit rate
    turned: Annotated[np.ndarray, "c n 3"]  # ∂n/∂q of the normal at the brace
    normal: Annotated[np.ndarray, "c 3"]
    shift: Annotated[np.ndarray, "c n 3"]  # displacement of the contact point on the body per coordinate
    slip: Annotated[np.ndarray, "c 7"]  # u = v_t / √(|v_t|² + v_s²), velocity of the contact point, that square root
    force: Annotated[np.ndarray, "c 3"]
    turn: Annotated[np.ndarray, "n 3"]  # ∂F/∂q of a brace
    drift: Annotated[np.ndarray, "n 3"]  # ∂F/∂v
    basis: Annotated[np.ndarray, "K n n"]  # orthonormal basis; the last columns span the null space of hand and braces
    free: Annotated[np.ndarray, "K", int]  # number of these columns
    rows: Annotated[np.ndarray, "R n"]  # constraints of one knot
    normal_matrix: Annotated[np.ndarray, "R R"]
    right: Annotated[np.ndarray, "R"]
    H: Annotated[np.ndarray, "N N"]
    g: Annotated[np.ndarray, "N"]
    x: Annotated[np.ndarray, "max(N,n)"]  # L⁻¹ times the step without constraints
    step: Annotated[np.ndarray, "N"]
    B: Annotated[np.ndarray, "Kn+c n"]  # derivatives of the torques of an instant, one row for each unknown
    slope: Annotated[np.ndarray, "n n"]  # derivatives of the torques of an instant by the posture of a knot
    column: Annotated[np.ndarray, "Kn+c", int]
    start: Annotated[np.ndarray, "K", int]  # first unknown of each knot's posture; the forces of its instants follow
    pressed: Annotated[np.ndarray, "E", int]  # first force of each instant
    skyline: Annotated[np.ndarray, "N", int]  # first nonzero column of each row of H
    working: Annotated[np.ndarray, "W 3", int]  # violated constraints of the step: kind, knot or instant, index
    bound: Annotated[np.ndarray, "W"]
    normals: Annotated[np.ndarray, "N W"]  # normals of these constraints as columns, later multiplied by L⁻¹
    dual: Annotated[np.ndarray, "W W"]
    dual_right: Annotated[np.ndarray, "W"]
    multiplier: Annotated[np.ndarray, "W"]
    passive: Annotated[np.ndarray, "W", int]
    small: Annotated[np.ndarray, "W W"]
    small_right: Annotated[np.ndarray, "W"]
    index: Annotated[np.ndarray, "W", int]
    small_skyline: Annotated[np.ndarray, "max(W,R)", int]
    between: Annotated[np.ndarray, "n"]  # posture of an instant
    rate: Annotated[np.ndarray, "n"]  # velocity of an instant
    acceleration: Annotated[np.ndarray, "n"]  # acceleration of an instant
    weight: Annotated[np.ndarray, "E n"]  # weights of the squared torques in the model of the cost
    pull: Annotated[np.ndarray, "E n"]  # half the gradient of the cost by the torques, divided by the fraction of time
    change: Annotated[np.ndarray, "K n"]  # change of the postures in a step
    trial: Annotated[np.ndarray, "K n"]
    trial_forces: Annotated[np.ndarray, "E c"]
