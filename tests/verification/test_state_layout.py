"""Layout of states and outputs: another layout gives the same runs, and only dynsim.dynamics.state has the indices."""

from __future__ import annotations

import ast
import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.random_robots import ADAPTIVE, CompiledSystem, assemble, random_contacts, random_robot

import dynsim
from dynsim.dynamics.derivative import new_workspace
from dynsim.dynamics.state import OutputLayout, StateLayout, block
from dynsim.engine.force_indeterminacy import acceleration_range
from dynsim.integrators.methods import METHODS
from dynsim.integrators.run import FINISHED, PROJECTIONS, STATUS, STEPS, Run
from dynsim.integrators.simd.forms import aligned

PACKAGE, TESTS = Path(dynsim.__file__).parent, Path(__file__).parents[1]


def scatter(layout: Any, order: tuple[str, ...], gap: int, **more: int) -> Any:
    """Another layout of the same blocks: in this order, ``gap`` unused entries before and after each of them."""
    starts, end = {}, 0
    for name in order:
        starts[name] = end + gap
        end = starts[name] + width(layout, name) + gap
    return layout._replace(**starts, size=end, **more)


def width(standard: StateLayout | OutputLayout, name: str) -> int:
    """Entries of a block, from the layout that ``block`` describes."""
    columns = block(standard, name)
    return columns.stop - columns.start


def scattered_state(standard: StateLayout, gap: int) -> StateLayout:
    """Currents first and positions last, then the integrals in another order too."""
    head, tail = ("current", "v", "q"), ("contact", "elastic", "load", "scheme", "loss", "ledger")
    tracked = scatter(standard, head, gap).size
    return scatter(standard, head + tail, gap, tracked=tracked)


def scattered_outputs(standard: OutputLayout, gap: int) -> OutputLayout:
    """All columns in reverse order."""
    return scatter(standard, standard._fields[-2::-1], gap)


def part(
    values: np.ndarray,
    name: str,
    standard: StateLayout | OutputLayout,
    layout: StateLayout | OutputLayout | None = None,
) -> np.ndarray:
    """A block of values along their last axis, whatever their layout (the standard one by default)."""
    start = getattr(layout or standard, name)
    return values[..., start : start + width(standard, name)]


BLOCKS = ("q", "v", "current", "ledger", "contact", "load", "loss", "scheme", "elastic")
COLUMNS = ("vdot", "current", "voltage", "torque", "hand", "energy", "contact", "support", "stop", "dry", "tie")


class Pair:
    """A system with the standard layout, and the same one with another layout."""

    def __init__(self, standard: CompiledSystem, gap: int) -> None:
        self.standard = standard
        self.layout = scattered_state(standard.system.layout, gap)
        system = standard.system._replace(layout=self.layout, unilateral=copy.deepcopy(standard.system.unilateral))
        self.other = replace(standard, system=system, ws=new_workspace(system))
        self.gap = gap

    def moved(self, y: np.ndarray) -> np.ndarray:
        """A state of the standard layout, in the other one."""
        moved, standard = np.zeros(self.layout.size), self.standard.system.layout
        for name in BLOCKS:
            part(moved, name, standard, self.layout)[:] = part(y, name, standard)
        return moved

    def runs(self, y: np.ndarray, times: np.ndarray, method: str, limit: int, **options) -> tuple[Run, Run]:
        """A run of each; the other one has other columns of outputs too."""
        first = self.standard.advance(self.standard.new_run(y, times, method, **options), limit)
        second = self.other.new_run(self.moved(y), times, method, **options)
        columns = scattered_outputs(first.columns, self.gap)
        second = second._replace(columns=columns, output=np.zeros((len(times), columns.size)))
        if second.newton is not None and second.newton.lanes is not None:
            lanes = second.newton.lanes._replace(output=aligned(columns.size, 4))
            second = second._replace(newton=second.newton._replace(lanes=lanes))
        return first, self.other.advance(second, limit)

    def assert_same_states(self, first: np.ndarray, second: np.ndarray, rtol: float = 0.0) -> None:
        """All blocks agree, per unit of the block's largest value, and what belongs to no block is zero."""
        assert_same(first, second, BLOCKS, self.standard.system.layout, self.layout, rtol)


def assert_same(first: np.ndarray, second: np.ndarray, names, standard, layout, rtol: float) -> None:
    """See :meth:`Pair.assert_same_states`."""
    used = np.zeros(layout.size, dtype=bool)
    for name in names:
        expected, computed = part(first, name, standard), part(second, name, standard, layout)
        scale = np.abs(expected).max(initial=0.0)
        np.testing.assert_allclose(computed, expected, rtol=0, atol=rtol * scale, err_msg=name)
        part(used, name, standard, layout)[:] = True
    assert not second[..., ~used].any()


def random_pair(seed: int, *, gap: int = 2, m_star: bool = False, real: bool = False) -> tuple[Pair, np.ndarray]:
    """A tree with motors and two contacts, at a state that leaves the surfaces: at angles near to closed ones."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 6)
    q = rng.normal(size=6)
    contacts = random_contacts(rng, robot, q, 2)
    standard = assemble(robot, contacts, m_star=m_star, held=q[: len(robot.motors)] + 0.3, real=real)
    assert standard.sizes[1] >= 2
    standard = standard.with_shapes() if real else standard
    y = standard.state(q + rng.normal(scale=1e-4, size=6), rng.normal(size=6), rng.normal(size=len(robot.motors)))
    # Integrals need not begin at zero.
    standard.part(y, "ledger")[:] = rng.normal(size=width(standard.system.layout, "ledger"))
    return Pair(standard, gap), y


SEEDS = (0, 1, 2)


def test_the_other_layout_is_another_one():
    pair, y = random_pair(0)
    standard, layout = pair.standard.system.layout, pair.layout
    places = [name for name in StateLayout._fields if name not in ("extra", "circuits")]
    assert all(getattr(standard, name) != getattr(layout, name) for name in places)
    assert layout.current < layout.v < layout.q < layout.tracked < layout.contact < layout.ledger < layout.size
    pair.assert_same_states(y, pair.moved(y))
    with pytest.raises(AssertionError, match="v\n"):
        pair.assert_same_states(y + 1e-9 * (np.arange(len(y)) == standard.v), pair.moved(y))


@pytest.mark.parametrize("m_star", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_right_hand_side(seed, m_star):
    pair, y = random_pair(seed, m_star=m_star)
    dy = pair.standard.derivative(y)
    assert np.isfinite(dy).all()
    pair.assert_same_states(dy, pair.other.derivative(pair.moved(y)))
    accelerations = acceleration_range(pair.standard.system, 0.0, y)
    np.testing.assert_array_equal(accelerations, acceleration_range(pair.other.system, 0.0, pair.moved(y)))


@pytest.mark.parametrize("seed", SEEDS)
def test_projection(seed):
    pair, y = random_pair(seed)
    first, second = pair.runs(y, np.array([1.0]), "dopri5", 0, step=1e-3)
    assert first.count[PROJECTIONS] >= 1
    np.testing.assert_array_equal(first.count, second.count)
    assert np.abs(pair.standard.part(first.y - y, "q")).max() > 1e-6
    assert np.abs(pair.standard.part(first.y - y, "v")).max() > 1e-3
    pair.assert_same_states(first.y, second.y)


def assert_same_runs(pair: Pair, first: Run, second: Run, rtol: float) -> None:
    pair.assert_same_states(first.y, second.y, rtol)
    pair.assert_same_states(first.sample, second.sample, rtol)
    assert_same(first.output, second.output, COLUMNS, first.columns, second.columns, rtol)
    np.testing.assert_allclose(second.extremes, first.extremes, rtol=rtol, atol=rtol)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", SEEDS)
def test_runs_at_fixed_steps(seed, method):
    pair, y = random_pair(seed, real=method == "time_stepping")
    times = np.array([0.0, 0.00505, 0.02])
    first, second = pair.runs(y, times, method, 10**4, step=2e-4, fixed=True)
    assert first.count[STEPS] >= 100
    assert first.count[STATUS] == second.count[STATUS] == FINISHED
    np.testing.assert_array_equal(first.count[[STEPS, PROJECTIONS]], second.count[[STEPS, PROJECTIONS]])
    # Rounding: sums over the state are taken in another order. It may also end Newton's method an iteration sooner.
    assert_same_runs(pair, first, second, 1e-10 if method == "radau5" else 1e-11)


@pytest.mark.parametrize("method", ADAPTIVE)
@pytest.mark.parametrize("seed", SEEDS)
def test_runs_with_error_control(seed, method):
    """Without gaps, over which the error norm would take its mean too: the same steps, sized by the same entries."""
    pair, y = random_pair(seed, gap=0)
    first, second = pair.runs(y, np.linspace(0.0, 0.1, 5), method, 10**4, rtol=1e-7)
    assert first.count[STATUS] == second.count[STATUS] == FINISHED
    assert second.count[STEPS] == pytest.approx(first.count[STEPS], rel=0.02)
    # Rounding of the norm changes the steps by as much; the finite differences in the Jacobian of radau5 magnify
    # that into where its iterations end, and so into its steps.
    assert_same_runs(pair, first, second, 1e-4 if method == "radau5" else 1e-9)


# Sizes of blocks. An index made of them knows what lies before the block it reaches.
SIZES = {"n", "nq", "na", "n_a"}
STATES = {"y", "y_new", "dy", "sample", "output", "out", "state", "derivative"}


def _name(node: ast.expr) -> str:
    """The last part of a dotted name, that of what is called, or nothing."""
    if isinstance(node, ast.Call):
        return _name(node.func)
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


def _is_size(node: ast.AST) -> bool:
    return isinstance(node, ast.expr) and _name(node) in {*SIZES, "len"}


def _counts_blocks(index: ast.expr) -> bool:
    """True for multiples of a size, like ``2 * n``."""
    return any(
        isinstance(node, ast.BinOp)
        and isinstance(node.op, ast.Mult)
        and any(isinstance(side, ast.Constant) for side in (node.left, node.right))
        and any(_is_size(side) for side in (node.left, node.right))
        for node in ast.walk(index)
    )


def knows_the_layout(source: str) -> list[str]:
    """Subscripts that find a block by the sizes of others: any of multiples of a size, and those of states by sizes."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Subscript):
            by_size = _name(node.value) in STATES and any(map(_is_size, ast.walk(node.slice)))
            if by_size or _counts_blocks(node.slice):
                lines.append(f"{node.lineno}: {ast.unparse(node)}")
    return lines


@pytest.mark.parametrize(
    "line",
    [
        "v = y[n : 2 * n]",
        "q = run.sample[:, :n]",
        "energy = run.output[:, n + 2 * na + 3 : n + 2 * na + 6]",
        "current = values[2 * model.n :]",
        "dy[n + i] = 0.0",
        "power = b.derivative(y)[2 * len(q) + FRICTION]",
        "y[: prepared.model.n] = 0.1",
    ],
)
def test_index_arithmetic_on_a_state_is_found(line):
    assert len(knows_the_layout(line)) == 1


@pytest.mark.parametrize(
    "line", ["dy[layout.v + i] = joints[i, QDD]", 'y[block(layout, "q")] = initial', "x[:n] = column[i, 1 + 2 * k]"]
)
def test_other_indices_are_not(line):
    assert knows_the_layout(line) == []


# A model of its own, with a state of its own.
OWN_STATE = {TESTS / "support" / "rotors.py"}


def _sources() -> list[Path]:
    files = [*PACKAGE.rglob("*.py"), *TESTS.rglob("*.py")]
    assert PACKAGE / "dynamics" / "derivative.py" in files
    assert TESTS / "support" / "random_robots.py" in files
    return sorted({*files} - OWN_STATE - {PACKAGE / "dynamics" / "state.py"})


def test_no_source_file_computes_where_a_block_lies():
    offsets = {str(path): knows_the_layout(path.read_text(encoding="utf-8")) for path in _sources()}
    assert {path: lines for path, lines in offsets.items() if lines} == {}
    for path in OWN_STATE:
        assert knows_the_layout(path.read_text(encoding="utf-8")), f"{path} needs no exception any more"


def test_tests_read_runs_by_name():
    """Not run.sample[...], run.output[...] or run.y[...], which need to know what lies where."""
    lines = [
        f"{path}:{node.lineno}"
        for path in _sources()
        if path.is_relative_to(TESTS)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Attribute)
        and node.value.attr in ("sample", "output", "y")
    ]
    assert lines == []
