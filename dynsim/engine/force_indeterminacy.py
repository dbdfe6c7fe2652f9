"""Contact forces that are not unique: Painlevé's paradox, dependent rows, contacts wedged by friction.

The check during a run is compiled (dynsim.dynamics.contact.delassus). When that check fails, this module finds the time
of the failure and writes the text of the warning or stop message. It also computes the range of accelerations that
dependent frictional rows allow. docs/theory/uniqueness.md derives the criteria.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.compile.touching import touch
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import delassus as kq
from dynsim.dynamics.contact.rows import SIGNS_LIMIT
from dynsim.dynamics.derivative import System, derivative, new_workspace
from dynsim.dynamics.linear import RANK_TOLERANCE
from dynsim.dynamics.tree.articulated import accelerate
from dynsim.integrators import run as ki
from dynsim.model.description import Contact
from dynsim.record import Record

Array = NDArray[np.float64]

# When the step size has collapsed, a determinant below this fraction of the frictionless one counts as the cause.
NEAR_ZERO = 1e-3
# A friction factor that avoids the paradox is reported if it is below this.
WORTH_SAYING = 0.99
# Number of bisections of the interval in which forces stop being unique.
BISECTIONS = 50
# Recorded samples at which the acceleration range of dependent rows is computed.
SPREAD_SAMPLES = 5
# Singular values of A below this fraction of the largest one count as zero. The fraction is well above rounding errors
# and well below the singular values of braces.
NULL_TOLERANCE = 1e-9
# A spread below this fraction of the accelerations is a rounding error of the null space.
SPREAD_TOLERANCE = 1e-7
# Maximum number of mode sets examined, each by a singular value decomposition of the rows of all closed contacts.
MOST_SETS = 50
# Singular values of normalised rows below this count as zero. Its square is the tolerance in the elimination of A.
DEPENDENT = 1e-6


@dataclass(frozen=True)
class MotionSpread:
    """Range of one joint's acceleration over all admissible distributions of dependent frictional forces.

    Attributes
    ----------
    joint : str
        Name of the joint.
    unit : str
        Unit of its acceleration.
    time : float
        Time of the sample [s].
    low, high : float
        Minimum and maximum acceleration.
    taken : float
        Acceleration in the run, which uses the least-norm split of the forces.
    """

    joint: str
    unit: str
    time: float
    low: float
    high: float
    taken: float


@dataclass(frozen=True)
class ContactMatrices:
    """Matrices of the equation A(σ) f = rhs of the p active rows at one state, with A(σ) = A0 − B diag(σ).

    Attributes
    ----------
    frictionless : (p, p) ndarray
        A0 = J M⁻¹ Jᵀ.
    friction : (p, p) ndarray
        B, zero for rows of sticking points and of joints.
    rhs : (p,) ndarray
        Right-hand side.
    force : (p,) ndarray
        Forces f in the run.
    signs : (p,) ndarray
        Signs σ in the run.
    free : (p,) ndarray of bool
        True for dissipative contacts with friction, whose σ is the sign of f.
    owner : (p,) ndarray of int
        Index of the contact of each sliding row, −1 for other rows.
    """

    frictionless: Array
    friction: Array
    rhs: Array
    force: Array
    signs: Array
    free: NDArray[np.bool_]
    owner: NDArray[np.int64]

    def matrix(self, signs: Array) -> Array:
        """Return A(σ), (p, p)."""
        return self.frictionless - self.friction * signs

    def basis(self) -> Array:
        """Return an orthonormal basis of the range of A0, (p, rank)."""
        values, vectors = np.linalg.eigh(self.frictionless)
        return vectors[:, values > RANK_TOLERANCE * values.max(initial=0.0)]

    def determinant(self, signs: Array) -> float:
        """Return det A(σ) / det A0; with dependent rows, both determinants are restricted to the range of A0."""
        Q = self.basis()
        return float(np.linalg.det(Q.T @ self.matrix(signs) @ Q) / np.linalg.det(Q.T @ self.frictionless @ Q))

    def choices(self) -> list[Array]:
        """Return the sign vectors to try, the present one first.

        Beyond SIGNS_LIMIT free rows, only vectors that differ in one sign are returned.
        """
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
        """Return the forces (p,) for every choice of signs that agrees with these forces, without duplicates.

        Requires independent rows.
        """
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
        """Return the smallest factor s ≤ 1 that, applied to all friction, makes det(A0 − s B diag(σ)) zero, or None."""
        Q, largest = self.basis(), 0.0
        frictionless = Q.T @ self.frictionless @ Q
        for signs in self.choices():
            values = np.linalg.eigvals(np.linalg.solve(frictionless, Q.T @ (self.friction * signs) @ Q))
            real = values.real[np.abs(values.imag) <= 1e-9 * np.abs(values).max(initial=0.0)]
            largest = max(largest, real.max(initial=0.0))
        return 1.0 / largest if largest >= 1.0 else None

    def described(self, solution: Array) -> str:
        """Describe the normal forces of one of the ``solutions`` at the sliding points.

        A solution first appears where the determinant for its signs passes through zero. Its forces are unbounded
        there, so only their signs are meaningful.
        """
        sliding = solution[self.owner >= 0]
        signs = np.where(self.free, np.copysign(1.0, solution), self.signs)
        if abs(self.determinant(signs)) < NEAR_ZERO:
            return f"({', '.join('+' if force > 0.0 else '-' for force in sliding)}) without bound"
        return f"({', '.join(f'{force:.4g}' for force in sliding)}) N"

    def reversed(self) -> NDArray[np.bool_]:
        """Return a mask, (p,), of rows with a negative diagonal entry: they accelerate against their own force."""
        own = np.diag(self.frictionless)
        return (own > 0.0) & (np.diag(self.matrix(self.signs)) < -kq.DIAGONAL_TOLERANCE * own)

    def finite(self) -> bool:
        """Return False if the state has diverged."""
        return bool(np.isfinite(self.frictionless).all() and np.isfinite(self.friction).all())

    def unique(self) -> bool:
        """Return False if the compiled check would stop the run."""
        if not self.finite() or self.determinant(self.signs) <= 0.0 or self.reversed().all():
            return False
        if not self.free.any() or self.basis().shape[1] < len(self.rhs):
            return True
        return len(self.solutions()) <= 1 or min(map(self.determinant, self.choices())) > 0.0


def contact_matrices(system: System, ws: ka.Workspace, t: float, y: Array) -> ContactMatrices:
    """Evaluate the right-hand side at (t, y) and return A0, B and the forces from the workspace."""
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
    """Find the time [s] and state at which the forces stopped being unique, by bisection of the rejected step.

    The state is interpolated linearly over that step, so the time is second-order accurate in the step size.
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
    """Return time [s], state and message if Painlevé's paradox ended the run, or None if it ended for another reason.

    A collapsed step size or a diverged state counts as the paradox if the determinant has nearly vanished, because
    forces grow without bound before any step can pass the singularity.
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
            f"{count} consistent solutions (Painlevé's paradox) at {names}: normal forces {forces} are "
            "consistent with dissipative friction, so the motion is not determined"
        )
    elif near:
        finding = (
            f"Painlevé's paradox at {names}: det J M⁻¹F approaches zero ({value:.1e} of its value without friction), "
            "where normal forces are unbounded"
        )
    elif abs(value) < NEAR_ZERO:
        finding = (
            f"Painlevé's paradox at {names}: det J M⁻¹F passes through zero, where normal forces are unbounded and "
            "change sign"
        )
    elif value < 0.0:
        finding = (
            f"Painlevé's paradox at {names}: det J M⁻¹F is negative ({value:.2g} of its value without friction), so "
            "the contact accelerates against the force that pushes it"
        )
    else:
        finding = (
            f"Painlevé's paradox at {names}: {'every' if turned.all() else 'its'} diagonal entry of J M⁻¹F is "
            "negative, so each of these points accelerates against the force that pushes it"
        )
    factor = matrices.critical_friction()
    below = ""
    if factor is not None and factor < WORTH_SAYING:
        coefficients = {contact.friction for contact in contacts}
        below = f" below {factor * max(coefficients):.3g}" if len(coefficients) == 1 else f" to less than {factor:.0%}"
    advice = f"lower contacts.friction{below}, or change the posture or the slip direction"
    return t, y, f"{finding}; {advice}"


def motion_spread(
    system: System, times: Array, states: Array, joints: Sequence[tuple[str, str]]
) -> MotionSpread | None:
    """Find the widest range of a joint's acceleration over all admissible splits of dependent forces.

    Parameters
    ----------
    system : System
        System of the run.
    times : (T,) ndarray
        Times of the recorded samples [s]; at most SPREAD_SAMPLES of them are examined.
    states : (T, m) ndarray
        States at these times.
    joints : sequence of (str, str)
        Name of each joint and unit of its acceleration.

    Returns
    -------
    MotionSpread or None
        None if only the forces are indeterminate, not the motion.
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
    """Return accelerations at (t, y), (n,) each: the least-norm split, and minimum and maximum over admissible splits.

    A force vector f is admissible if A f = rhs and its normal forces have the same signs as in the least-norm split (a
    support that pushes never pulls); friction keeps its direction. With the null space N of A, f = f0 + N z, and the
    accelerations are linear in z. Each bound of each joint is therefore a linear program. Unbounded sets give infinite
    values.
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
            # Scale the forces by the largest one to match the absolute tolerances of the solver.
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
    model: Model, contacts: Sequence[Contact], q: Array, modes: Array, rests: NDArray[np.bool_]
) -> tuple[list[str], list[str]]:
    """Find contacts and joints whose rows depend on each other, in one sample for each combination of modes.

    For each set, the first sample with the most joints at rest is used, because dependent rows stay dependent when rows
    are added. Contacts may share forces with each other and with joints that dry friction keeps at rest; joints without
    a contact are not reported.

    Zero rows, such as the row across a planar arm, and rows that depend on each other within one contact, as with only
    two joints before it, leave no choice between contacts: each contact is represented by an orthonormal basis of its
    rows. Contacts that share forces appear in the left null space of all bases together.

    Parameters
    ----------
    model : Model
        Model of the robot.
    contacts : sequence of Contact
        The c contacts of the run.
    q : (T, nq) ndarray
        Positions of the samples [rad or m].
    modes : (T, c) ndarray
        Contact modes: OPEN, SLIDING or STICKING of dynsim.dynamics.tables.
    rests : (T, n) ndarray of bool
        Joints that dry friction keeps at rest.

    Returns
    -------
    contacts, joints : list of str
        Names of the contacts, and of the joints that dry friction keeps at rest. Contacts of a snake, and the joints of
        its wheels, have the names of the wheels.
    """
    free = free_rates(model)
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
    names = [contact.name for contact in contacts] + list(model.joint_names)
    return [names[k] for k in sorted(shared) if k < c], [names[k] for k in sorted(shared) if k >= c]


def free_rates(model: Model) -> Array:
    """Return a basis of the rates that joint couplings allow, (n, n − k)."""
    rows = model.coupling_rows
    return np.linalg.svd(rows)[2][len(rows) :].T


def contact_point(model: Model, contact: Contact, q: Array) -> tuple[Array, Array]:
    """Return normal, (3,), and Jacobian of the velocity against the surface, (3, n), where a contact touches."""
    at = touch(model, contact, q)
    return at.normal, at.jacobian(model, q)


def touching_rows(model: Model, contact: Contact, q: Array, sticks: bool) -> Array:
    """Return the Jacobian rows of the contact forces that rigid bodies would have to determine, (r, n).

    A sticking point has three rows, a sliding point one (its normal force). The depth of a compliant contact determines
    its normal force, so only its tangential rows remain if it sticks, and none if it slides.
    """
    normal, jacobian = contact_point(model, contact, q)
    if contact.stiffness > 0.0:
        return (np.eye(3) - np.outer(normal, normal)) @ jacobian if sticks else np.zeros((0, jacobian.shape[1]))
    return jacobian if sticks else (normal @ jacobian)[None]


def row_basis(rows: Array) -> Array:
    """Return an orthonormal basis of the row space, (r, n)."""
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    # Rounding errors in a zero row can reach this size.
    return basis[sizes > max(DEPENDENT * sizes.max(initial=0.0), 1e-9)]


# Contacts wedged by friction alone: a force inside the friction cone of such a contact acts on no joint.


# Number of samples in which a contact is examined, evenly spaced over the samples in which it is closed.
POSTURES = 20
# A force outside its cone by less than this, relative or in N, counts as on the cone.
ON_CONE = 1e-6


@dataclass(frozen=True)
class Wedge:
    """A contact that can wedge itself.

    Attributes
    ----------
    contact : Contact
        The contact.
    least : float
        Smallest friction coefficient that wedges it.
    friction : float
        Static friction coefficient of the contact.
    time : float
        Time of the sample [s].
    """

    contact: Contact
    least: float
    friction: float
    time: float


def wedges(model: Model, contacts: Sequence[Contact], record: Record) -> list[Wedge]:
    """Find contacts that can wedge themselves, so that their motion is not unique.

    Each is reported at the sample that requires the least friction. Compliant contacts are skipped because springs
    determine their normal forces. Friction that depends on direction (``grip``) is skipped because it has a different
    cone and does not oppose slip.

    Parameters
    ----------
    model : Model
        Model of the robot.
    contacts : sequence of Contact
        Contacts of the run.
    record : Record
        Record with ``q``, ``contact_mode`` and ``contact_force``.

    Returns
    -------
    list of Wedge
        At most one entry per contact.
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
            # Use the first of several values that are equal up to rounding.
            result.append(min(own, key=lambda wedge: float(f"{wedge.least:.4g}")))
    return result


def least_coefficient(jacobian: Array, normal: Array) -> tuple[float, Array]:
    """Return μ* of a contact with ``jacobian`` (3, f), and the directions Q of its motion, (3, r).

    μ* is infinite if friction cannot wedge the contact, or if no joint moves the point along the normal.
    """
    moving = row_basis(jacobian.T).T
    along = normal @ moving
    own, other = float(np.linalg.norm(along)), float(np.linalg.norm(normal - moving @ along))
    # Blocked directions are accurate to DEPENDENT; smaller components count as zero.
    if own <= DEPENDENT or other <= DEPENDENT:
        return np.inf, moving
    return own / other, moving


def _holds(moving: Array, normal: Array, friction: float, force: Array) -> bool:
    """Return whether the contact would stick even without the wedging force; ``force`` (3,) is its total force."""
    along = normal @ moving
    # Two directions of motion always include one along the surface. A single direction that is not perpendicular to the
    # normal does not.
    slips = np.array([[-along[1]], [along[0]]]) / np.linalg.norm(along) if len(along) == 2 else np.zeros((1, 0))
    needed = np.linalg.solve(np.column_stack([along, slips]), moving.T @ force)
    slack = ON_CONE * (1.0 + float(np.linalg.norm(force)))
    return bool(np.abs(needed[1:]).max(initial=0.0) <= friction * needed[0] + slack and needed[0] >= -slack)
