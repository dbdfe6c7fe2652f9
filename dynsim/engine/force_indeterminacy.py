"""Diagnosis of contact forces that are not unique: Painlevé's paradox, dependent rows; texts for warnings and stops.

The check during a run is compiled (dynsim.dynamics.contact.delassus); here its finding is located in time and
described, and the range of accelerations that dependent frictional rows allow is computed. docs/physics.md derives the
criteria.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.compile.shapes import share_of_axis
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import delassus as kq
from dynsim.dynamics.contact.delassus import RANK_TOLERANCE
from dynsim.dynamics.contact.rows import SIGNS_LIMIT
from dynsim.dynamics.derivative import System, derivative, new_workspace
from dynsim.dynamics.tree.articulated import accelerate
from dynsim.integrators import run as ki
from dynsim.model.description import Contact
from dynsim.record import Record

Array = NDArray[np.float64]

# Where the step size has collapsed, a determinant below this fraction of the frictionless one counts as the cause.
NEAR_ZERO = 1e-3
# A factor on the friction coefficients that avoids the paradox is reported if it is below this.
WORTH_SAYING = 0.99
# Halvings of the interval in which forces ceased to be unique.
BISECTIONS = 50
# Recorded samples at which the range of accelerations of dependent rows is computed.
SPREAD_SAMPLES = 5
# Singular values of A below this fraction of the largest are null: well above rounding, well below those of braces.
NULL_TOLERANCE = 1e-9
# A spread below this fraction of the accelerations is rounding of the null space.
SPREAD_TOLERANCE = 1e-7
# Most sets of modes that are examined, each by a singular value decomposition of the rows of all closed contacts.
MOST_SETS = 50
# Singular values of unit rows below this count as zero: their square is the tolerance of the elimination of A.
DEPENDENT = 1e-6


@dataclass(frozen=True)
class MotionSpread:
    """Range of one joint's acceleration over all admissible distributions of dependent frictional forces.

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
class Sharing:
    """Names of contacts, and of joints that dry friction keeps at rest, whose forces the motion does not determine.

    Contacts of a snake have the names of its wheels, and so have the wheels' joints.
    """

    contacts: list[str]
    joints: list[str]


@dataclass(frozen=True)
class ContactMatrices:
    """A(σ) = A0 − B diag(σ) of one state, A(σ) f = rhs, of the p active rows.

    Attributes
    ----------
    frictionless : A0 = J M⁻¹ Jᵀ, (p, p); friction : B, (p, p), zero for rows of sticking points and of joints
    rhs : (p,); force : f as the run has it, (p,); signs : σ as the run has it, (p,)
    free : (p,) bool: dissipative contacts with friction, whose σ is the sign of f
    owner : (p,) the contact of each row that slides, −1 for other rows
    """

    frictionless: Array
    friction: Array
    rhs: Array
    force: Array
    signs: Array
    free: NDArray[np.bool_]
    owner: NDArray[np.int64]

    def matrix(self, signs: Array) -> Array:
        """A(σ), (p, p)."""
        return self.frictionless - self.friction * signs

    def basis(self) -> Array:
        """Orthonormal basis of the range of A0, (p, rank)."""
        values, vectors = np.linalg.eigh(self.frictionless)
        return vectors[:, values > RANK_TOLERANCE * values.max(initial=0.0)]

    def determinant(self, signs: Array) -> float:
        """det A(σ) / det A0; with dependent rows of both on the range of A0."""
        Q = self.basis()
        return float(np.linalg.det(Q.T @ self.matrix(signs) @ Q) / np.linalg.det(Q.T @ self.frictionless @ Q))

    def choices(self) -> list[Array]:
        """The signs that are tried, the present ones first: all, or beyond SIGNS_LIMIT those that differ at one."""
        index = np.flatnonzero(self.free)
        if len(index) <= SIGNS_LIMIT:
            turned = [index[list(bits)] for bits in itertools.product((False, True), repeat=len(index))]
        else:
            turned = [index[:0], *index[:, None]]
        result = []
        for which in turned:
            signs = self.signs.copy()
            signs[which] *= -1.0
            result.append(signs)
        return result

    def solutions(self) -> list[Array]:
        """Forces (p,) of every choice of signs that agrees with them, each once; only for independent rows."""
        solutions: list[Array] = []
        for signs in self.choices():
            try:
                force = np.asarray(np.linalg.solve(self.matrix(signs), self.rhs), dtype=np.float64)
            except np.linalg.LinAlgError:
                continue
            scale = kq.FORCE_TOLERANCE * max(np.abs(force).max(), np.abs(self.force).max())
            agrees = (force * signs >= -scale)[self.free].all()
            if agrees and all(np.abs(force - other).max() > scale for other in solutions):
                solutions.append(force)
        return solutions

    def critical_friction(self) -> float | None:
        """The least factor s ≤ 1 on all friction at which a determinant vanishes, det(A0 − s B diag(σ)) = 0."""
        Q, largest = self.basis(), 0.0
        frictionless = Q.T @ self.frictionless @ Q
        for signs in self.choices():
            values = np.linalg.eigvals(np.linalg.solve(frictionless, Q.T @ (self.friction * signs) @ Q))
            real = values.real[np.abs(values.imag) <= 1e-9 * np.abs(values).max(initial=0.0)]
            largest = max(largest, real.max(initial=0.0))
        return 1.0 / largest if largest >= 1.0 else None

    def described(self, solution: Array) -> str:
        """The normal forces of one of the ``solutions`` at the points that slide.

        A solution appears where the determinant for its signs passes through zero, with forces that have no bound:
        computed there, they have signs and no size.
        """
        sliding = solution[self.owner >= 0]
        signs = np.where(self.free, np.copysign(1.0, solution), self.signs)
        if abs(self.determinant(signs)) < NEAR_ZERO:
            return f"({', '.join('+' if force > 0.0 else '-' for force in sliding)}) without bound"
        return f"({', '.join(f'{force:.4g}' for force in sliding)}) N"

    def reversed(self) -> NDArray[np.bool_]:
        """Rows whose own force alone would accelerate them against it: negative diagonal entries, (p,)."""
        own = np.diag(self.frictionless)
        return (own > 0.0) & (np.diag(self.matrix(self.signs)) < -kq.DIAGONAL_TOLERANCE * own)

    def finite(self) -> bool:
        """False for a state that has diverged."""
        return bool(np.isfinite(self.frictionless).all() and np.isfinite(self.friction).all())

    def unique(self) -> bool:
        """False where the compiled watch stops a run."""
        if not self.finite() or self.determinant(self.signs) <= 0.0 or self.reversed().all():
            return False
        if not self.free.any() or self.basis().shape[1] < len(self.rhs):
            return True
        return len(self.solutions()) <= 1 or min(map(self.determinant, self.choices())) > 0.0


def contact_matrices(system: System, ws: ka.Workspace, t: float, y: Array) -> ContactMatrices:
    """Evaluate the right-hand side at (t, y) and take A0, B and the forces out of the workspace."""
    derivative(system, t, y, ws, np.zeros_like(y))
    p = int(ws.counts[ka.ROWS])
    state, active = ws.rows[:p], ws.active[:p]
    rows, directions = ws.column[:, 1 : 1 + 2 * p : 2], ws.column[:, 2 : 2 + 2 * p : 2]
    inverse = ws.links[:, ka.INVERSE_D, None]
    frictionless = rows.T @ (inverse * rows)
    least = np.maximum(kq.IMMOBILE * (inverse * directions**2).sum(axis=0), state[:, ka.ROW_FLOOR])
    moving = np.diag(frictionless) > least
    frictionless = frictionless * np.outer(moving, moving)
    dissipative = active[:, ka.LAW] == ka.FRICTION_DISSIPATIVE
    signs = np.where(dissipative, state[:, ka.SIGN], 1.0)
    return ContactMatrices(
        frictionless=frictionless,
        friction=(frictionless - moving[:, None] * (rows.T @ (inverse * directions))) * signs,
        rhs=state[:, ka.RHS].copy(),
        force=state[:, ka.FORCE].copy(),
        signs=signs,
        free=dissipative & (state[:, ka.ROW_MU] > 0.0),
        owner=np.where(active[:, ka.ROW_KIND] == ka.SLIDING_ROW, active[:, ka.OWNER], -1),
    )


def locate(system: System, ws: ka.Workspace, run: ki.Run) -> tuple[float, Array]:
    """Time and state at which forces ceased to be unique, by halving the step that was not accepted.

    The state is taken as linear over that step, so the time is good to the second order of the step.
    """
    start, end = float(run.clock[ki.TIME]), float(run.clock[ki.NOT_UNIQUE])
    low, high = 0.0, 1.0
    if end > start:
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            y = run.y + middle * (run.y_new - run.y)
            if contact_matrices(system, ws, start + middle * (end - start), y).unique():
                low = middle
            else:
                high = middle
        return start + high * (end - start), run.y + high * (run.y_new - run.y)
    return start, run.y.copy()


def paradox(
    system: System, ws: ka.Workspace, run: ki.Run, contacts: Sequence[Contact]
) -> tuple[float, Array, str] | None:
    """Time, state and words of a stop by Painlevé's paradox, None when the run ended for another reason.

    A step size that collapses and a state that diverges count where the determinant has all but vanished: there the
    forces grow beyond bounds before any step can pass over the singularity.
    """
    status, near = int(run.count[ki.STATUS]), False
    if status in (ki.FORCES_REVERSED, ki.SEVERAL_FORCES):
        t, y = locate(system, ws, run)
    elif status in (ki.STEP_TOO_SMALL, ki.NOT_FINITE) and any(contact.friction > 0.0 for contact in contacts):
        t, y, near = float(run.clock[ki.TIME]), run.y.copy(), True
    else:
        return None
    matrices = contact_matrices(system, ws, t, y)
    if not matrices.finite():
        return None
    value = matrices.determinant(matrices.signs)
    if near and not abs(value) < NEAR_ZERO:
        return None
    several = matrices.free.any() and not near and matrices.basis().shape[1] == len(matrices.rhs)
    solutions = matrices.solutions() if several else []
    turned, sliding = matrices.reversed(), matrices.owner >= 0
    named = matrices.owner[turned if turned.any() else sliding]
    names = ", ".join(contacts[k].name for k in named)
    if len(solutions) > 1:
        forces = " and ".join(matrices.described(solution) for solution in solutions)
        count = "two" if len(solutions) == 2 else len(solutions)
        finding = (
            f"{count} consistent solutions (Painlevé's paradox) at {names}: normal forces {forces} agree with "
            "dissipative friction, so that the motion is not determined"
        )
    elif near:
        finding = (
            f"Painlevé's paradox at {names}: det J M⁻¹F falls to zero ({value:.1e} of its value without friction), "
            "where normal forces have no bound"
        )
    elif abs(value) < NEAR_ZERO:
        finding = (
            f"Painlevé's paradox at {names}: det J M⁻¹F passes through zero, where normal forces have no bound and "
            "turn round"
        )
    elif value < 0.0:
        finding = (
            f"Painlevé's paradox at {names}: det J M⁻¹F is negative ({value:.2g} of its value without friction), so "
            "that the contact moves against a force that pushes it"
        )
    else:
        finding = (
            f"Painlevé's paradox at {names}: {'every' if turned.all() else 'its'} diagonal entry of J M⁻¹F is "
            "negative, so that each of these points moves against a force that pushes it"
        )
    factor = matrices.critical_friction()
    below = ""
    if factor is not None and factor < WORTH_SAYING:
        coefficients = {contact.friction for contact in contacts}
        below = f" below {factor * max(coefficients):.3g}" if len(coefficients) == 1 else f" to less than {factor:.0%}"
    advice = f"lower contacts.friction{below}, or take another posture or direction of slip"
    return t, y, f"{finding}; {advice}"


def motion_spread(
    system: System, times: Array, states: Array, joints: Sequence[tuple[str, str]]
) -> MotionSpread | None:
    """The widest range of a joint's acceleration over all admissible splits of dependent forces, at a few samples.

    Parameters
    ----------
    times, states : recorded samples, (T,) and (T, m); up to SPREAD_SAMPLES of them are looked at
    joints : name of each joint and unit of its acceleration

    Returns
    -------
    MotionSpread | None
        None when forces alone are left open, and no motion.
    """
    worst: MotionSpread | None = None
    for row in np.unique(np.linspace(0, len(times) - 1, SPREAD_SAMPLES).astype(int)):
        taken, low, high = acceleration_range(system, float(times[row]), states[row])
        j = int(np.argmax(high - low))
        spread = high[j] - low[j]
        if spread > SPREAD_TOLERANCE * (1.0 + np.abs(taken).max()) and (
            worst is None or spread > worst.high - worst.low
        ):
            name, unit = joints[j]
            worst = MotionSpread(name, unit, float(times[row]), float(low[j]), float(high[j]), float(taken[j]))
    return worst


def acceleration_range(system: System, t: float, y: Array) -> tuple[Array, Array, Array]:
    """Accelerations at (t, y): those of the least-norm split, and least and greatest over all admissible ones, (n,).

    Admissible are all f with A f = rhs whose normal forces have the signs that they have in the least-norm split (so a
    support that pushes never pulls); friction keeps its direction. f = f0 + N z with the null space N of A, and the
    accelerations are linear in z: one linear programme per joint and end. Infinite where the set has no end.
    """
    ws = new_workspace(system)
    matrices = contact_matrices(system, ws, t, np.array(y))
    n, p = ws.joints.shape[0], len(matrices.rhs)
    taken, force = ws.joints[:, ka.QDD].copy(), matrices.force
    _, values, vectors = np.linalg.svd(matrices.matrix(matrices.signs))
    N = vectors[values <= NULL_TOLERANCE * values[0]].T
    response = np.zeros((n, p))
    directions = ws.column[:, 2 : 2 + 2 * p : 2].copy()
    for k in range(p):
        ws.column[:, 0] = directions[:, k]
        accelerate(system.model, ws)
        response[:, k] = ws.joints[:, ka.QDD]
    slope = response @ N
    scale = np.abs(force).max(initial=0.0)
    if N.shape[1] == 0 or scale == 0.0 or np.abs(slope).max() * scale <= SPREAD_TOLERANCE * (1.0 + np.abs(taken).max()):
        return taken, taken, taken
    from scipy.optimize import linprog

    signs = np.where(force < 0.0, -1.0, 1.0)
    ends = []
    for direction in (1.0, -1.0):
        change = np.zeros(n)
        for j in range(n):
            # In units of the largest force, so that the solver's absolute tolerances mean something.
            optimum = linprog(
                direction * slope[j],
                A_ub=-signs[:, None] * N,
                b_ub=np.maximum(signs * force / scale, 0.0),
                bounds=(None, None),
            )
            unbounded = optimum.status == 3
            change[j] = -direction * np.inf if unbounded else direction * (optimum.fun or 0.0) * scale
        ends.append(taken + change)
    return taken, np.minimum(ends[0], taken), np.maximum(ends[1], taken)


def sharing(
    model: Model, contacts: Sequence[Contact], q: Array, modes: Array, rests: NDArray[np.bool_] | None = None
) -> Sharing:
    """Contacts and joints whose rows depend on each other, in one sample of each set of modes.

    The sample is the first with the most joints at rest: rows that depend on each other do so among more rows too.

    Contacts may share with each other, and with joints that dry friction keeps at rest; joints alone share nothing.

    Rows that are zero, such as that across a planar arm, and those that depend on each other within one contact, as
    where an arm has two joints before it, leave no choice between contacts: each contact counts with an orthonormal
    basis of its own rows. Those that share are in the left null space of all bases together.

    Parameters
    ----------
    q : samples, (T, nq) [rad or m]
    modes : of the contacts in them, (T, c), dynsim.dynamics.tables: OPEN, SLIDING, STICKING
    rests : which joints dry friction keeps at rest in them, (T, n)
    """
    free = free_rates(model)
    rests = np.zeros((len(modes), model.n), dtype=bool) if rests is None else rests
    shared: set[int] = set()
    order = np.argsort(-rests.sum(axis=1), kind="stable")
    first = order[np.unique(modes[order], axis=0, return_index=True)[1]]
    closed = np.count_nonzero(modes != ka.OPEN, axis=1)
    several = [t for t in sorted(first) if closed[t] > 1 or (closed[t] > 0 and rests[t].any())]
    for t in several[:MOST_SETS]:
        bases, owner = [], []
        for k in np.flatnonzero(modes[t] != ka.OPEN).tolist():
            basis = row_basis(touching_rows(model, contacts[k], q[t], bool(modes[t, k] == ka.STICKING)) @ free)
            bases.append(basis)
            owner += [k] * len(basis)
        for k in np.flatnonzero(rests[t]).tolist():
            bases.append(row_basis(np.eye(model.n)[k][None] @ free))
            owner += [len(contacts) + k] * len(bases[-1])
        left, sizes, _ = np.linalg.svd(np.vstack(bases))
        rank = int(np.count_nonzero(sizes > DEPENDENT))
        shared.update(np.array(owner, dtype=int)[np.abs(left[:, rank:]).max(axis=1, initial=0.0) > DEPENDENT].tolist())
    c = len(contacts)
    return Sharing(
        [contacts[k].name for k in sorted(shared) if k < c],
        [model.joint_names[k - c] for k in sorted(shared) if k >= c],
    )


def free_rates(model: Model) -> Array:
    """Rates that couplings of joints allow, (n, n − k)."""
    rows = model.coupling_rows
    return np.linalg.svd(rows)[2][len(rows) :].T


def contact_point(model: Model, contact: Contact, q: Array) -> tuple[Array, Array]:
    """Normal of the surface, (3,), and Jacobian of the point that is nearest to it, (3, n)."""
    body, point = model.robot.attach(contact.body, contact.point)
    if contact.tip is not None:
        end = model.robot.attach(contact.body, contact.tip)[1]
        start, other = (model.point_position(body, at, q) for at in (point, end))
        point = point + share_of_axis(contact, start, other) * (end - point)
    rotation, origin = model.body_pose(body, q)
    normal = contact.surface.normal(origin + rotation @ point)
    return normal, model.point_jacobian(body, point - contact.radius * (rotation.T @ normal), q)


def touching_rows(model: Model, contact: Contact, q: Array, sticks: bool) -> Array:
    """Jacobian of the forces of a contact that rigid bodies would have to determine, (r, n).

    A point that sticks has three, one that slides the normal force. The depth of a compliant contact determines its
    normal force: it has those across the normal, or none.
    """
    normal, jacobian = contact_point(model, contact, q)
    if contact.stiffness > 0.0:
        return (np.eye(3) - np.outer(normal, normal)) @ jacobian if sticks else np.zeros((0, jacobian.shape[1]))
    return jacobian if sticks else (normal @ jacobian)[None]


def row_basis(rows: Array) -> Array:
    """Orthonormal basis of the space of some rows, (r, n)."""
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    # A row of zeros has rounding of its size.
    return basis[sizes > max(DEPENDENT * sizes.max(initial=0.0), 1e-9)]


# Contacts that friction can wedge by itself: forces of one contact that push against no joint, inside its cone.


# Samples in which a contact is examined, at equal distances among those in which it is closed.
POSTURES = 20
# A force that leaves its cone by less, relative or in N, lies on it except for rounding.
ON_CONE = 1e-6


@dataclass(frozen=True)
class Wedge:
    """A contact that can wedge itself, the least coefficient that does it, its own at rest, and the time [s]."""

    contact: Contact
    least: float
    friction: float
    time: float


def wedges(model: Model, contacts: Sequence[Contact], record: Record) -> list[Wedge]:
    """Contacts whose motion is not unique because they can wedge themselves, each where the least friction does it.

    Springs decide the normal forces of compliant contacts. Friction that depends on direction (``grip``) is left out:
    it has another cone, and does not oppose slip.
    """
    result, free, q = list[Wedge](), free_rates(model), record["q"]
    for k, contact in enumerate(contacts):
        friction = contact.friction_at_rest
        if contact.stiffness > 0.0 or contact.grip_axis is not None or friction == 0.0:
            continue
        mode, own = record["contact_mode"][:, k], list[Wedge]()
        closed = np.flatnonzero(mode != ka.OPEN)
        for t in closed[np.unique(np.linspace(0, len(closed) - 1, min(POSTURES, len(closed))).astype(int))].tolist():
            if not np.isfinite(q[t]).all():
                continue
            normal, jacobian = contact_point(model, contact, q[t])
            least, moving = least_coefficient(jacobian @ free, normal)
            if least > friction:
                continue
            if mode[t] == ka.SLIDING or not _holds(moving, normal, friction, record["contact_force"][t, k]):
                own.append(Wedge(contact, least, friction, float(record.time[t])))
        if own:
            # The first of those that are equal except for rounding.
            result.append(min(own, key=lambda wedge: float(f"{wedge.least:.4g}")))
    return result


def least_coefficient(jacobian: Array, normal: Array) -> tuple[float, Array]:
    """μ* of a contact with ``jacobian`` (3, f), infinite for none, and the directions Q of its motion, (3, r).

    A point that joints do not move along the normal carries nothing, and has none either.
    """
    moving = row_basis(jacobian.T).T
    along = normal @ moving
    own, other = float(np.linalg.norm(along)), float(np.linalg.norm(normal - moving @ along))
    # Blocked directions are known up to DEPENDENT: what is less is a direction across the normal.
    if own <= DEPENDENT or other <= DEPENDENT:
        return np.inf, moving
    return own / other, moving


def _holds(moving: Array, normal: Array, friction: float, force: Array) -> bool:
    """Whether the contact would stick without the force that blocks it too, ``force`` (3,) being all that it has."""
    along = normal @ moving
    # Of two directions one is along the surface; of one, which is not across the normal, none is.
    slips = np.array([[-along[1]], [along[0]]]) / np.linalg.norm(along) if len(along) == 2 else np.zeros((1, 0))
    needed = np.linalg.solve(np.column_stack([along, slips]), moving.T @ force)
    slack = ON_CONE * (1.0 + float(np.linalg.norm(force)))
    return bool(np.abs(needed[1:]).max(initial=0.0) <= friction * needed[0] + slack and needed[0] >= -slack)
