"""The benchmark: everything is measured, set side by side, and put into one result for JSON."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Callable
from typing import Any

from dynsim._version import __version__
from dynsim.engine.provenance import commit
from dynsim.studies.bench import job, precision, right_hand_side, sweeps, variants
from dynsim.studies.bench.programs import (
    ABA,
    CONSTRAINT_DYNAMICS,
    DYNSIM_CONTACTS,
    DYNSIM_DOPRI5,
    DYNSIM_FREE,
    DYNSIM_RADAU5,
    LCABA,
    MUJOCO_CONTACTS,
    MUJOCO_EULER,
    MUJOCO_FREE,
    MUJOCO_IMPLICIT,
    SCENARIO,
    STEP,
)

# Called with what is being measured and the fraction done.
BenchProgress = Callable[[str, float], None]

SIZES = (10, 30, 100, 300, 1000)
# Larger sizes are left out, by ``quick``. Pinocchio's Data grows with the square of the links: 0.85 GB at 300.
PINOCCHIO_LINKS_MAX = {True: 100, False: 300}
MUJOCO_LINKS_MAX = {True: 300, False: 1000}


def run_bench(quick: bool = False, progress: BenchProgress | None = None) -> dict[str, Any]:
    """Measure everything.

    Parameters
    ----------
    quick : fewer rounds, MuJoCo only up to 300 links, work and precision of one scenario
    progress : called with what comes next and the fraction done

    Returns
    -------
    dict, ready for JSON
        ``machine``, ``versions``, ``method`` (how it was measured), ``right_hand_side`` (per size: microseconds by
        contender, medians and minima), ``job`` (per case and program: wall time and errors), ``variants`` (per variant,
        contacts and method: time), ``sweeps`` (per number of runs and processes: wall time), ``precision`` (per shipped
        scenario, method and tolerance: time, error, ledger), ``ratios`` (how many times longer the other program
        takes, or dynsim otherwise), ``unavailable`` (what is missing and why).
    """
    report = progress or (lambda text, fraction: None)
    mujoco_missing = _why_no_mujoco()
    # Many short samples: the median then leaves out those in which another process had the core.
    rounds, share = (25, 2e-3) if quick else (101, 5e-3)
    sizes: list[dict[str, Any]] = []
    python_call = None
    for k, n in enumerate(SIZES):
        report(f"right-hand side, {n} links", 0.4 * k / len(SIZES))
        with_mujoco = not mujoco_missing and n <= MUJOCO_LINKS_MAX[quick]
        samples = right_hand_side.measure(
            n, rounds, share, with_pinocchio=n <= PINOCCHIO_LINKS_MAX[quick], with_mujoco=with_mujoco
        )
        # What a call from Python costs does not depend on the size; where the work is least, it is seen best.
        if python_call is None:
            python_call = right_hand_side.python_call_cost(samples)
        sizes.append(right_hand_side.row(n, samples, python_call or 0.0))
    jobs: list[dict[str, Any]] = []
    for k, case in enumerate(job.CASES):
        report(f"10 s job, {case}", 0.4 + 0.2 * k / len(job.CASES))
        jobs += job.measure_job(case, 3 if quick else 21, with_mujoco=not mujoco_missing)
    report("variants, on a real floor too", 0.6)
    elbows = variants.measure(3 if quick else 9)
    report("sweeps", 0.65)
    swept = sweeps.measure(quick)
    exact: list[dict[str, Any]] = []
    names = [SCENARIO] if quick else list(precision.scenarios())
    for k, name in enumerate(names):
        report(f"work and precision, {name}", 0.7 + 0.3 * k / len(names))
        exact += precision.measure(name, 1 if quick else precision.ROUNDS)
    report("done", 1.0)
    result: dict[str, Any] = {
        "machine": machine(),
        "versions": versions(),
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
        "variants": elbows,
        "sweeps": swept,
        "precision": exact,
        "unavailable": {"mujoco": mujoco_missing} if mujoco_missing else {},
    }
    result["ratios"] = [*_ratios(sizes, jobs), *_own_ratios(jobs), *_at_equal_error(exact)]
    result["ratios"] += [*_ratios_of_variants(elbows), *_growth(swept)]
    return result


def _ratios_of_variants(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times longer dopri5 takes than radau5, all variants on a real floor than glued, a small inductance."""

    def total(contacts: str, method: str, variant: str | None = None) -> float:
        return sum(
            row["cpu_minimum_s"]
            for row in rows
            if row["contacts"] == contacts and row["method"] == method and variant in (None, row["variant"])
        )

    first, explicit, implicit = rows[0]["variant"], *variants.METHODS
    found = [
        {
            "task": f"10 s job, {first}, {variants.GLUED}, least time",
            "peer": f"dynsim {explicit}",
            "dynsim": f"dynsim {implicit}",
            "time": total(variants.GLUED, explicit, first) / total(variants.GLUED, implicit, first),
        }
    ]
    for method in variants.METHODS:
        found.append(
            {
                "task": f"all variants, dynsim {method}",
                "peer": variants.REAL,
                "dynsim": variants.GLUED,
                "time": total(variants.REAL, method) / total(variants.GLUED, method),
            }
        )
    small = total(variants.SMALL, implicit, first) / total(variants.GLUED, implicit, first)
    found.append(
        {"task": f"{first}, dynsim {implicit}", "peer": variants.SMALL, "dynsim": variants.GLUED, "time": small}
    )
    return found


def _growth(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times longer sweeps take in one process than in several, and with more runs."""
    wall = {(row["runs"], row["jobs"]): row["wall_s"] for row in rows}
    least, most = min(row["runs"] for row in rows), max(row["runs"] for row in rows)
    jobs = sorted({row["jobs"] for row in rows})
    found = []
    for runs in sorted({row["runs"] for row in rows}):
        if len(jobs) > 1:
            found.append(
                {
                    "task": f"sweep of {runs} runs",
                    "peer": "1 process",
                    "dynsim": f"{jobs[-1]} processes",
                    "time": wall[runs, 1] / wall[runs, jobs[-1]],
                }
            )
    found += [
        {
            "task": f"sweep, processes: {count}",
            "peer": f"{most} runs",
            "dynsim": f"{least} runs",
            "time": wall[most, count] / wall[least, count],
        }
        for count in jobs
    ]
    return found


def _own_ratios(jobs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times longer dynsim takes by dopri5 than by radau5."""
    rows = []
    for case in job.CASES:
        row = {one["program"]: one for one in jobs if one["case"] == case}
        explicit, implicit = row[DYNSIM_DOPRI5], row[DYNSIM_RADAU5]
        rows.append(
            {
                "task": f"10 s job, {case}, by method",
                "peer": DYNSIM_DOPRI5,
                "dynsim": DYNSIM_RADAU5,
                "time": explicit["cpu_median_s"] / implicit["cpu_median_s"],
                "time_minima": explicit["cpu_minimum_s"] / implicit["cpu_minimum_s"],
                "hand_error": explicit["hand_error_max_m"] / implicit["hand_error_max_m"],
            }
        )
    return rows


def _at_equal_error(exact: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times longer dopri5 takes than radau5 for the same error of 1e-6."""
    rows = []
    for scenario in dict.fromkeys(row["scenario"] for row in exact):
        of_one = [row for row in exact if row["scenario"] == scenario]
        rows.append(
            {
                "task": f"{scenario}, error {precision.EQUAL_ERROR:g}",
                "peer": "dynsim dopri5",
                "dynsim": "dynsim radau5",
                "time": precision.work_at_equal_error(of_one, "radau5", "dopri5", precision.EQUAL_ERROR),
            }
        )
    return rows


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
    for case in job.CASES:
        row = {one["program"]: one for one in jobs if one["case"] == case}
        for peer in (MUJOCO_EULER, MUJOCO_IMPLICIT):
            for ours in (DYNSIM_DOPRI5, DYNSIM_RADAU5):
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


def _why_no_mujoco() -> str:
    """Why MuJoCo cannot take part; empty when it can."""
    try:
        import mujoco
    except ImportError:
        return "mujoco is not installed (pip install 'dynsim[bench]')"
    if int(mujoco.__version__.split(".")[0]) < 4:
        return f"mujoco {mujoco.__version__}: its dcmotor takes no position and velocity set-points before 4.0"
    return ""


def machine() -> dict[str, Any]:
    """Processor, number of its cores, and system."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    return {"cpu": model, "cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}"}


def versions() -> dict[str, str]:
    """Of dynsim, with its commit, of Python and of the other programs."""
    found = {"dynsim": __version__, "commit": commit(), "python": platform.python_version()}
    for package in ("numba", "numpy", "pin", "mujoco"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found
