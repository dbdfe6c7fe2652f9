"""How long a right-hand side and a whole run take, and how exact the run is, beside Pinocchio and MuJoCo.

All contenders get the same robot, from the same tables, and run in one thread. They take turns and medians of CPU time
are reported, so that what else the machine does hits all alike; ratios carry over to other machines, times do not.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from dynsim._version import __version__
from dynsim.engine.dynamics import Prepared, prepare
from dynsim.kernels import arrays as ka
from dynsim.kernels.integrate import run as ki
from dynsim.kernels.integrate.driver import advance
from dynsim.kernels.jit import kernel
from dynsim.kernels.state import block
from dynsim.kernels.system import System, derivative
from dynsim.scenario import load_scenario
from dynsim.studies import mujoco_peer, pinocchio_peer

Array = NDArray[np.float64]
# Called with what is being measured and the fraction done.
BenchProgress = Callable[[str, float], None]

SCENARIO = "elbow_comparison"
SIZES = (10, 30, 100, 300, 1000)
STEP = 1e-3  # MuJoCo's and RK4's step in the whole job [s]
# Larger sizes are left out, by ``quick``. Pinocchio's Data grows with the square of the links: 0.85 GB at 300.
PINOCCHIO_LINKS_MAX = {True: 100, False: 300}
MUJOCO_LINKS_MAX = {True: 300, False: 1000}
SPHERE_RADIUS = 100.0  # of the surfaces that stand for the floor where MuJoCo holds points by tendons [m]

DYNSIM_FREE, DYNSIM_CONTACTS = "dynsim", "dynsim, 2 contacts"
ABA, CONSTRAINT_DYNAMICS, LCABA = "Pinocchio ABA", "Pinocchio constraintDynamics", "Pinocchio lcaba"
MUJOCO_FREE, MUJOCO_CONTACTS = "MuJoCo mj_step", "MuJoCo mj_step, 2 contacts"
CONTENDERS = (DYNSIM_FREE, DYNSIM_CONTACTS, ABA, CONSTRAINT_DYNAMICS, LCABA, MUJOCO_FREE, MUJOCO_CONTACTS)
# Measured in Python calls, with the cost of the call taken off.
_CALLED_FROM_PYTHON = (CONSTRAINT_DYNAMICS, LCABA)
_PYTHON_ABA = "Pinocchio ABA, one Python call each"


@kernel
def repeat_derivative(system: System, y: Array, ws: ka.Workspace, dy: Array, count: int) -> float:
    """``count`` right-hand sides at slightly different states; returns a sum, so that none can be left out."""
    total = 0.0
    first = y[0]
    for k in range(count):
        y[0] = first + 1e-3 * (k & 7)
        derivative(system, 1e-3 * (k & 1023), y, ws, dy)
        total += dy[y.shape[0] - 1]
    y[0] = first
    return total


@dataclass(frozen=True)
class Timed:
    """Something to time: ``call(count)`` does the work at least ``count`` times and returns how many times."""

    name: str
    call: Callable[[int], int]


def run_bench(quick: bool = False, progress: BenchProgress | None = None) -> dict[str, Any]:
    """Measure everything.

    Parameters
    ----------
    quick : fewer rounds, and MuJoCo only up to 300 links
    progress : called with what comes next and the fraction done

    Returns
    -------
    dict, ready for JSON
        ``machine``, ``versions``, ``method`` (how it was measured), ``right_hand_side`` (per size: microseconds by
        contender, medians and minima), ``job`` (per case and program: wall time and errors), ``ratios`` (how many
        times longer the other program takes), ``unavailable`` (what is missing and why).
    """
    report = progress or (lambda text, fraction: None)
    mujoco_missing = _why_no_mujoco()
    # Many short samples: the median then leaves out those in which another process had the core.
    rounds, share = (25, 2e-3) if quick else (101, 5e-3)
    sizes: list[dict[str, Any]] = []
    python_call = None
    for k, n in enumerate(SIZES):
        report(f"right-hand side, {n} links", 0.6 * k / len(SIZES))
        with_mujoco = not mujoco_missing and n <= MUJOCO_LINKS_MAX[quick]
        with_pinocchio = n <= PINOCCHIO_LINKS_MAX[quick]
        arms = {contacts: prepare(_arm(n, contacts)) for contacts in (False, True)}
        timed = [
            Timed(DYNSIM_FREE, _derivative_loop(arms[False])),
            Timed(DYNSIM_CONTACTS, _derivative_loop(arms[True])),
        ]
        if with_pinocchio:
            timed += _pinocchio_contenders(arms[True])
        if with_mujoco:
            timed += _mujoco_contenders(arms[True])
        samples = _take_turns(timed, rounds, share)
        # What a call from Python costs does not depend on the size; where the work is least, it is seen best.
        if python_call is None and _PYTHON_ABA in samples and ABA in samples:
            python_call = max(0.0, float(np.median(samples[_PYTHON_ABA]) - np.median(samples[ABA])))
        sizes.append(_row(n, samples, python_call or 0.0))
    jobs: list[dict[str, Any]] = []
    for k, case in enumerate(CASES):
        report(f"10 s job, {case}", 0.6 + 0.4 * k / len(CASES))
        jobs += _measure_job(case, 3 if quick else 21, with_mujoco=not mujoco_missing)
    report("done", 1.0)
    result: dict[str, Any] = {
        "machine": _machine(),
        "versions": _versions(),
        "method": {
            "quick": quick,
            "rounds": rounds,
            "seconds_per_sample": share,
            "python_call_us": None if python_call is None else 1e6 * python_call,
            "statistic": "CPU time of the one thread, median over interleaved rounds; minima, and wall times of the "
            "whole jobs, beside it",
            "mujoco_step_s": STEP,
            "dynsim": "right-hand side with motors, references, friction and all energy integrals, in a compiled loop",
            "pinocchio": "bodies and rotor inertia only; ABA in its own native loop (abaInParallel, one thread); "
            "constraintDynamics and lcaba from Python with 2 x 3 rows and no friction, less the cost of a Python call, "
            "which is that of ABA called from Python less that of ABA in the native loop",
            "mujoco": "bodies, rotor inertia and damping, no motors; mj_step in mujoco.rollout (one thread)",
        },
        "right_hand_side": sizes,
        "job": jobs,
        "unavailable": {"mujoco": mujoco_missing} if mujoco_missing else {},
    }
    result["ratios"] = _ratios(sizes, jobs)
    return result


def _row(n: int, samples: dict[str, list[float]], python_call: float) -> dict[str, Any]:
    """Microseconds of every contender at n links, Python calls taken off where the work is called from Python."""
    row: dict[str, Any] = {"links": n, "median_us": {}, "minimum_us": {}}
    for name, values in samples.items():
        if name == _PYTHON_ABA:
            continue
        off = python_call if name in _CALLED_FROM_PYTHON else 0.0
        row["median_us"][name] = 1e6 * (float(np.median(values)) - off)
        row["minimum_us"][name] = 1e6 * (float(np.min(values)) - off)
    return row


def _arm(n: int, contacts: bool) -> Any:
    """The published arm with n links: links beyond the tenth are copies, bent to and fro, and all hold still."""
    overrides: dict[str, Any] = {}
    if n != 10:
        angles = load_scenario(SCENARIO).plant.initial_deg
        overrides = {
            "plant.chain.1.count": n - 1,
            "plant.initial_deg": [*angles, *([30, -30] * n)][:n],
            "controller.hand": None,
        }
    return load_scenario(SCENARIO, "two_elbows" if contacts else "no_elbow", overrides)


def _derivative_loop(prepared: Prepared) -> Callable[[int], int]:
    y, ws = prepared.run.y.copy(), prepared.workspace
    y[prepared.model.n : 2 * prepared.model.n] = 0.1  # slipping, turning: no term is zero
    dy = np.zeros_like(y)

    def call(count: int) -> int:
        repeat_derivative(prepared.system, y, ws, dy, count)
        return count

    call(1)
    return call


def _pinocchio_contenders(prepared: Prepared) -> list[Timed]:
    import pinocchio

    model = pinocchio_peer.build_pinocchio(prepared.system.model)
    q, v = prepared.model.robot.initial, np.full(prepared.model.n, 0.1)
    links = [int(link) for link in prepared.system.contacts.link[:, ka.LINK]]
    data = model.createData()
    timed = [Timed(_PYTHON_ABA, _one_by_one(pinocchio_peer.python_aba(model, data, q, v)))]
    if hasattr(pinocchio, "abaInParallel"):
        batch = max(2, 3000 // prepared.model.n)
        timed.insert(0, Timed(ABA, _in_batches(pinocchio_peer.native_aba(model, q, v, batch), batch)))
    for algorithm, name in (("constraintDynamics", CONSTRAINT_DYNAMICS), ("lcaba", LCABA)):
        if hasattr(pinocchio, algorithm):
            timed.append(Timed(name, _one_by_one(pinocchio_peer.constrained(model, data, algorithm, links, q, v))))
    return timed


def _mujoco_contenders(prepared: Prepared) -> list[Timed]:
    timed = []
    for name, contacts in ((MUJOCO_FREE, "none"), (MUJOCO_CONTACTS, "soft")):
        model = mujoco_peer.build_mujoco(prepared.system, step=STEP, motors=False, contacts=contacts)  # type: ignore[arg-type]
        steps = 5
        batch = max(1, 20_000 // prepared.model.n**2)
        call = mujoco_peer.steps_call(model, prepared.model.robot.initial, batch, steps)
        timed.append(Timed(name, _in_batches(call, batch * steps)))
    return timed


def _one_by_one(call: Callable[[], Any]) -> Callable[[int], int]:
    def repeat(count: int) -> int:
        for _ in range(count):
            call()
        return count

    return repeat


def _in_batches(call: Callable[[], Any], batch: int) -> Callable[[int], int]:
    def repeat(count: int) -> int:
        calls = max(1, round(count / batch))
        for _ in range(calls):
            call()
        return calls * batch

    return repeat


def _take_turns(timed: list[Timed], rounds: int, share: float) -> dict[str, list[float]]:
    """Seconds per unit of work of every contender, one sample per round, the contenders interleaved.

    CPU time of this thread, in which all of them run: what other processes take does not count.
    """
    counts = {}
    for contender in timed:
        contender.call(1)  # warm caches, and a first guess of the cost
        started = time.thread_time()
        done = contender.call(1)
        cost = (time.thread_time() - started) / done
        # A Python loop or a compiled loop of one is mostly overhead: measure again with a fair number.
        count = max(1, min(int(0.2 * share / cost), 10_000))
        started = time.thread_time()
        done = contender.call(count)
        counts[contender.name] = max(1, int(share * done / (time.thread_time() - started)))
    samples: dict[str, list[float]] = {contender.name: [] for contender in timed}
    for k in range(rounds):
        for contender in timed:
            # A contender that takes far longer than a sample should gets fewer of them.
            if k >= 3 and sum(samples[contender.name]) * counts[contender.name] > 4.0 * rounds * share:
                continue
            started = time.thread_time()
            done = contender.call(counts[contender.name])
            samples[contender.name].append((time.thread_time() - started) / done)
    return samples


@dataclass(frozen=True)
class Case:
    """One whole run that several programs do.

    Attributes
    ----------
    variant : str
        Of elbow_comparison.
    mujoco_contacts : str
        ``contacts`` of :func:`dynsim.studies.mujoco_peer.build_mujoco`.
    same_physics : bool
        Whether the programs solve the same equations; where not, MuJoCo's rows are marked and no ratio is given.
    note : str
    """

    variant: str
    mujoco_contacts: str
    same_physics: bool
    note: str


CASES = {
    "free arm": Case("no_elbow", "none", True, "same equations in both"),
    "two elbows held, no friction": Case(
        "two_elbows", "equality", True, f"both hold the elbows to spheres of {SPHERE_RADIUS:g} m radius; MuJoCo softly"
    ),
    "two elbows, friction": Case(
        "two_elbows", "soft", False, "dynsim: the paper's bilateral law; MuJoCo: its soft unilateral contact"
    ),
}
DYNSIM_DEFAULT, DYNSIM_RK4 = "dynsim rk43 rtol 1e-6", "dynsim RK4 1 ms"
MUJOCO_EULER, MUJOCO_IMPLICIT = "MuJoCo Euler 1 ms", "MuJoCo implicitfast 1 ms"
# Method, first or fixed step, rtol, atol.
_INTEGRATORS = {DYNSIM_DEFAULT: ("rk43", 0.0, 1e-6, 1e-8), DYNSIM_RK4: ("rk4", STEP, 1e-6, 1e-8)}
_TIGHT = {"integrator.method": "dopri5", "integrator.rtol": 1e-11, "integrator.atol": 1e-13}


def _measure_job(case_name: str, rounds: int, *, with_mujoco: bool) -> list[dict[str, Any]]:
    """Wall time and error of the 10 s run for every program; the reference is dynsim at rtol 1e-11."""
    case = CASES[case_name]
    reference = prepare_case(case, _TIGHT)
    _advance(reference)
    run = reference.run
    q, i = run.states("q"), run.states("current")
    hand = _hand_path(reference, q)

    paths: dict[str, tuple[Array, Array]] = {}
    timed: list[Timed] = []
    for name in _INTEGRATORS:
        timed.append(Timed(name, _dynsim_job(name, reference, paths)))
    if with_mujoco:
        for name, integrator in ((MUJOCO_EULER, "euler"), (MUJOCO_IMPLICIT, "implicitfast")):
            timed.append(Timed(name, _mujoco_job(name, case, integrator, reference, paths)))
    walls: dict[str, list[float]] = {job.name: [] for job in timed}
    cores: dict[str, list[float]] = {job.name: [] for job in timed}
    for job in timed:
        job.call(1)
    for _ in range(rounds):
        for job in timed:
            started, started_cpu = time.perf_counter(), time.thread_time()
            job.call(1)
            walls[job.name].append(time.perf_counter() - started)
            cores[job.name].append(time.thread_time() - started_cpu)
    rows = []
    for job in timed:
        positions, currents = paths[job.name]
        distance = np.linalg.norm(_hand_path(reference, positions) - hand, axis=1)
        rows.append(
            {
                "case": case_name,
                "note": case.note,
                "program": job.name,
                "wall_median_s": float(np.median(walls[job.name])),
                "wall_minimum_s": float(np.min(walls[job.name])),
                "cpu_median_s": float(np.median(cores[job.name])),
                "same_physics": case.same_physics or job.name.startswith("dynsim"),
                "hand_error_max_m": float(distance.max()),
                "hand_error_rms_m": float(np.sqrt((distance**2).mean())),
                "current_error_max_A": float(np.abs(currents - i).max()),
            }
        )
    return rows


def prepare_case(case: Case, options: dict[str, Any]) -> Prepared:
    """The case compiled for dynsim at its initial state; ``options`` are overrides of the scenario."""
    overrides = dict(options)
    if case.mujoco_contacts == "equality":
        model = load_scenario(SCENARIO, case.variant)
        overrides["contacts.friction"] = 0.0
        built = prepare(model)
        for contact in model.contacts():
            x, y, z = built.model.point_position(contact.body, contact.point, built.model.robot.initial)
            overrides[f"surfaces.under_{contact.name}"] = {
                "type": "sphere",
                "center_m": [float(x), float(y), float(z) - SPHERE_RADIUS],
                "radius_m": SPHERE_RADIUS,
            }
            overrides[f"contacts.points.{contact.name}.surface"] = f"under_{contact.name}"
    return prepare(load_scenario(SCENARIO, case.variant, overrides))


def _advance(prepared: Prepared) -> None:
    advance(prepared.system, prepared.workspace, prepared.run, np.iinfo(np.int64).max)
    if prepared.run.count[ki.STATUS] != ki.FINISHED:
        raise RuntimeError(f"the benchmark run stopped at t = {prepared.run.clock[ki.TIME]:.3f} s")


def _dynsim_job(name: str, reference: Prepared, paths: dict[str, tuple[Array, Array]]) -> Callable[[int], int]:
    method, step, rtol, atol = _INTEGRATORS[name]
    n, na, c = reference.model.n, len(reference.system.drives.table), len(reference.contacts)
    y = np.zeros_like(reference.run.y)
    y[block(reference.run.layout, "q")] = reference.model.robot.initial
    run = ki.new_run(
        ki.METHODS[method],
        y,
        reference.run.layout,
        reference.run.columns,
        n=n,
        na=na,
        c=c,
        sample_time=reference.run.sample_time,
        hand=(reference.run.hand_link, reference.run.hand_point),
        end=float(reference.run.clock[ki.END]),
        step=step,
        step_max=np.inf,
        rtol=rtol,
        atol=atol,
    )
    prepared = replace(reference, run=run)
    fresh = {field: getattr(run, field).copy() for field in ("y", "clock", "count", "extremes")}

    def call(count: int) -> int:
        for field, values in fresh.items():
            getattr(prepared.run, field)[:] = values
        _advance(prepared)
        paths[name] = prepared.run.states("q"), prepared.run.states("current")
        return 1

    return call


def _mujoco_job(
    name: str, case: Case, integrator: str, reference: Prepared, paths: dict[str, tuple[Array, Array]]
) -> Callable[[int], int]:
    import mujoco

    times = reference.run.sample_time
    model = mujoco_peer.build_mujoco(
        reference.system,
        step=STEP,
        integrator=integrator,  # type: ignore[arg-type]
        contacts=case.mujoco_contacts,  # type: ignore[arg-type]
    )
    data = mujoco.MjData(model)
    start = mujoco_peer.state_of(model, reference.model.robot.initial)
    controls = mujoco_peer.setpoints(reference.system, np.arange(round(times[-1] / STEP)) * STEP)
    rows = np.round(times[1:] / STEP).astype(int) - 1

    def call(count: int) -> int:
        q, _, i = mujoco_peer.roll_out(model, data, start, controls)
        first = start[1 : 1 + model.nq], np.zeros(i.shape[1])
        paths[name] = np.vstack([first[0], q[rows]]), np.vstack([first[1], i[rows]])
        return 1

    return call


def _hand_path(prepared: Prepared, q: Array) -> Array:
    """Hand positions for joint positions q, (T, n) → (T, 3) [m]."""
    model = prepared.model
    return np.array([model.point_position(*model.robot.hand, row) for row in q])


def _ratios(sizes: list[dict[str, Any]], jobs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times longer (or less exact) each peer is than dynsim at the same task."""
    rows: list[dict[str, Any]] = []
    pairs = (
        (ABA, DYNSIM_FREE),
        (CONSTRAINT_DYNAMICS, DYNSIM_CONTACTS),
        (LCABA, DYNSIM_CONTACTS),
        (MUJOCO_FREE, DYNSIM_FREE),
        (MUJOCO_CONTACTS, DYNSIM_CONTACTS),
    )
    for peer, ours in pairs:
        entry: dict[str, Any] = {"task": "right-hand side or step", "peer": peer, "dynsim": ours}
        for key, kind in (("time_by_links", "median_us"), ("time_by_links_minima", "minimum_us")):
            entry[key] = {
                str(row["links"]): row[kind][peer] / row[kind][ours] if peer in row[kind] else None for row in sizes
            }
        rows.append(entry)
    for case in CASES:
        row = {job["program"]: job for job in jobs if job["case"] == case}
        for peer in (MUJOCO_EULER, MUJOCO_IMPLICIT):
            for ours in (DYNSIM_DEFAULT, DYNSIM_RK4):
                entry = {"task": f"10 s job, {case}", "peer": peer, "dynsim": ours}
                known = peer in row
                for key, kind in (
                    ("time", "cpu_median_s"),
                    ("time_wall", "wall_median_s"),
                    ("time_wall_minima", "wall_minimum_s"),
                ):
                    entry[key] = row[peer][kind] / row[ours][kind] if known else None
                comparable = known and row[peer]["same_physics"]
                entry["hand_error"] = (
                    row[peer]["hand_error_max_m"] / row[ours]["hand_error_max_m"] if comparable else None
                )
                rows.append(entry)
    return rows


def format_table(result: dict[str, Any]) -> list[Table]:
    """The result as tables that fit 80 columns: microseconds, whole jobs, ratios (RK4's are in the JSON only)."""
    sizes = result["right_hand_side"]
    times = _table("One right-hand side (Pinocchio: solve, MuJoCo: step), median µs", "links")
    for row in sizes:
        times.add_column(str(row["links"]), justify="right")
    for name in CONTENDERS:
        times.add_row(name, *(_number(row["median_us"].get(name)) for row in sizes))

    whole = _table("10 s of the published arm; largest errors against rtol 1e-11", "")
    whole.caption = "* another contact law, so its error is no measure"
    for heading in ("wall ms", "CPU ms", "hand mm", "rms mm", "current A"):
        whole.add_column(heading, justify="right")
    for case in CASES:
        whole.add_row(f"[bold]{case}[/bold]")
        by_program = {row["program"]: row for row in result["job"] if row["case"] == case}
        for program in (DYNSIM_DEFAULT, DYNSIM_RK4, MUJOCO_EULER, MUJOCO_IMPLICIT):
            row = by_program.get(program, {})
            whole.add_row(
                f"  {program}{'' if row.get('same_physics', True) else ' *'}",
                _number(row.get("wall_median_s"), 1e3),
                _number(row.get("cpu_median_s"), 1e3),
                _number(row.get("hand_error_max_m"), 1e3),
                _number(row.get("hand_error_rms_m"), 1e3),
                _number(row.get("current_error_max_A")),
            )

    ratios = _table("Time (and hand error) of the peer over that of dynsim, by links and for the job", "peer")
    for row in sizes:
        ratios.add_column(str(row["links"]), justify="right")
    ratios.add_column("job", justify="right")
    ratios.add_column("error", justify="right")
    task = ""
    for row in result["ratios"]:
        if "time_by_links" in row:
            ratios.add_row(row["peer"], *(_number(ratio) for ratio in row["time_by_links"].values()), "", "")
        elif row["dynsim"] == DYNSIM_DEFAULT:
            if row["task"] != task:
                task = row["task"]
                ratios.add_row(f"[bold]{task.removeprefix('10 s job, ')}[/bold]")
            ratios.add_row(f"  {row['peer']}", *("" for _ in sizes), _number(row["time"]), _number(row["hand_error"]))
    return [times, whole, ratios]


def _table(title: str, first: str) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), title_justify="left", caption_justify="left")
    table.add_column(first, no_wrap=True)
    return table


def _number(value: float | None, scale: float = 1.0) -> str:
    """Three significant digits, or a dash for what was not measured."""
    if value is None:
        return "–"
    value *= scale
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def _why_no_mujoco() -> str:
    """Why MuJoCo cannot take part; empty when it can."""
    try:
        import mujoco
    except ImportError:
        return "mujoco is not installed (pip install 'dynsim[bench]')"
    if int(mujoco.__version__.split(".")[0]) < 4:
        return f"mujoco {mujoco.__version__}: its dcmotor takes no position and velocity set-points before 4.0"
    return ""


def _machine() -> dict[str, Any]:
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    return {"cpu": model, "cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}"}


def _versions() -> dict[str, str]:
    found = {"dynsim": __version__, "python": platform.python_version()}
    for package in ("numba", "numpy", "pin", "mujoco"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found
