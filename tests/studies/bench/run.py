"""The whole benchmark: all measurements in one result, ready for JSON."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from dynsim._version import __version__
from dynsim.engine.recording import commit
from studies.bench import job, precision, right_hand_side, snake, sweeps
from studies.bench.programs import SCENARIO, STEP

SIZES = (10, 30, 100, 300, 1000)


def run_bench(quick: bool = False, tell: Callable[[str], object] = lambda text: None) -> dict[str, Any]:
    """Measure everything.

    Parameters
    ----------
    quick : up to 100 links, fewer rounds, smaller sweeps, work and precision of one scenario
    tell : called with the name of the next measurement

    Returns
    -------
    dict, ready for JSON
        ``machine``, ``versions``, ``method`` (how it was measured), ``unavailable`` (missing programs and why), and
        lists of dicts: ``right_hand_side`` (by links and program), ``job`` (by case and program: time and errors),
        ``variants`` (time), ``snake`` (by program: time, distance from the paper), ``sweeps`` (by number of runs and of
        processes: wall time), ``precision`` (by shipped scenario, method and tolerance: time, error, ledger).
    """
    missing = {name: why for name, why in (("mujoco", _why_no_mujoco()), ("pinocchio", _why_no_pinocchio())) if why}
    with_mujoco, with_pinocchio = "mujoco" not in missing, "pinocchio" not in missing
    # Many short samples: the median then excludes samples in which another process had the core.
    rounds, share = (25, 2e-3) if quick else (101, 5e-3)
    tell("right-hand sides")
    sizes = right_hand_side.measure(
        SIZES[:3] if quick else SIZES, rounds, share, with_mujoco=with_mujoco, with_pinocchio=with_pinocchio
    )
    jobs: list[dict[str, Any]] = []
    for case in job.CASES:
        tell(f"10 s job, {case}")
        jobs += job.measure(case, 3 if quick else 21, with_mujoco=with_mujoco)
    tell("variants")
    elbows = job.measure_variants(3 if quick else 9)
    tell("snake")
    snakes = snake.measure(1 if quick else 5, with_mujoco=with_mujoco)
    tell("sweeps")
    swept = sweeps.measure(quick)
    exact: list[dict[str, Any]] = []
    for name in [SCENARIO] if quick else precision.scenarios():
        tell(f"work and precision, {name}")
        exact += precision.measure(name, 1 if quick else 3)
    return {
        "machine": machine(),
        "versions": versions(),
        "method": {
            "quick": quick,
            "rounds": rounds,
            "seconds_per_sample": share,
            "mujoco_step_s": STEP,
            "dynsim": "right-hand side with motors, references, friction and all energy integrals, in a compiled loop",
            "pinocchio": "bodies and rotor inertia only; ABA in its own native loop (abaInParallel, one thread); "
            "constraintDynamics and lcaba from Python with 2 x 3 rows and no friction, less the cost of a Python call: "
            "the time of ABA called from Python less the time of ABA in the native loop",
            "mujoco": "bodies, rotor inertia and damping, no motors; mj_step in mujoco.rollout (one thread)",
        },
        "right_hand_side": sizes,
        "job": jobs,
        "variants": elbows,
        "snake": snakes,
        "sweeps": swept,
        "precision": exact,
        "unavailable": missing,
    }


def _why_no_mujoco() -> str:
    """Return why MuJoCo cannot take part, or an empty text."""
    try:
        import mujoco
    except ImportError:
        return "mujoco is not installed (pip install 'dynsim[bench]')"
    if int(mujoco.__version__.split(".")[0]) < 4:
        return f"mujoco {mujoco.__version__}: its dcmotor takes no position and velocity set-points before 4.0"
    return ""


def _why_no_pinocchio() -> str:
    """Return why Pinocchio cannot take part, or an empty text."""
    if importlib.util.find_spec("pinocchio") is None:
        return "pinocchio is not installed (pip install 'dynsim[bench]'; it has no wheels for Windows)"
    return ""


def machine() -> dict[str, Any]:
    """Return the processor, its number of cores, and the system."""
    model = platform.processor() or platform.machine()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    return {"cpu": model, "cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}"}


def versions() -> dict[str, str]:
    """Return the versions of dynsim, with its commit, of Python and of the other programs."""
    known = {"dynsim": __version__, "commit": commit(), "python": platform.python_version()}
    for package in ("numba", "numpy", "pin", "mujoco"):
        try:
            known[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            known[package] = "not installed"
    return known
