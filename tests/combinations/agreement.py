"""Agreement of the runs of one scene, within the errors of the methods.

Most runs agree within the errors that their tolerances or steps imply for stable motion. If not, both are repeated with
a tenth of the tolerance or half the step: the change is the method's error, even if the motion multiplies errors. If
both errors are small and the results differ, the motion is not unique, which a warning must report, or one is wrong.
Steps that are far too long do not show their error at half their length: an unstable loop grows, with both, much more
slowly than it should. Therefore time stepping is repeated with a quarter of the step too before a difference is
reported. If this changes it by a multiple of the change by half the step, shorter steps may change it as much again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from combinations.running import Run
from combinations.sentences import GROWTH_PER_PERIOD, NOT_UNIQUE, SHARED, UNSTABLE
from dynsim import simulate
from dynsim.errors import DynsimError, SimulationStopped
from dynsim.record import Record

Array = NDArray[np.float64]

# Errors of stable motion: in units of rtol, as a share for time stepping, and in steps.
ADAPTIVE_SHARE, STEPPED_SHARE, STEPS = 300.0, 0.01, 2.0
# Difference of the two solvers, which solve the same equations.
SOLVERS = 2e-8
# Factor for tolerances slightly above a run's tolerances; 2 - ABOVE is slightly below. Both change local errors as much
# as rounding does.
ABOVE = 1.0 + 1e-9
# Parts of the step of time stepping beyond its half, and how much more they change at first order. Circuits that are
# faster than the step may need a tenth of it before anything shows.
FINER = ((0.25, 1.5), (0.1, 1.8))
# Factor on errors estimated by a finer run: an estimate is not a bound.
SURE = 10.0
# Samples by which an impact may be early or late.
JUMPS = 3
ENERGIES = ("energy_electrical", "heat_joule", "heat_friction", "loss_impact", "energy_kinetic", "energy_potential")
# The split of forces changes the motion a little if elbows slide, or bodies land on several points.
SPLIT_SHARE = 0.03


@dataclass(frozen=True)
class Measure:
    """A quantity by which runs are compared, over their common samples.

    ``values`` : (T, k); ``size`` : (k,) reference for relative differences
    """

    name: str
    values: Array
    size: Array


def disagreements(scenario: Mapping[str, Any], runs: Mapping[str, Run]) -> Iterator[tuple[str, str]]:
    """Yield kind and sentence for each pair of runs that differ more than allowed."""
    usable = {name: run for name, run in runs.items() if _is_usable(run)}
    yield from _ends(runs)
    yield from _solvers(usable)
    plain = {name: run for name, run in usable.items() if "/" not in name and name != "auto"}
    if len(plain) < 2:
        return
    first = next((name for name in ("radau5", "dopri5") if name in plain), next(iter(plain)))
    for name, run in plain.items():
        if name != first:
            yield from _pair(first, plain[first], name, run)


def _is_usable(run: Run) -> bool:
    record = run.record
    return record is not None and run.resolved is not None and "vdot" in record and len(record) > 1


def _ends(runs: Mapping[str, Run]) -> Iterator[tuple[str, str]]:
    """Yield methods whose integration fails although other methods finish the scene."""
    plain = {name: run for name, run in runs.items() if "/" not in name}
    stopped = {name: run for name, run in plain.items() if isinstance(run.error, SimulationStopped)}
    finished = [name for name, run in plain.items() if run.error is None]
    for name, run in stopped.items():
        if finished and not isinstance(run.error, type(None)):
            error = run.error
            assert isinstance(error, SimulationStopped)
            if error.kind in ("not_finite", "not_projected") and UNSTABLE not in str(error):
                yield "ends", f"{name} stops ({error.kind}) where {', '.join(finished)} go on: {str(error)[:200]}"


def _solvers(runs: Mapping[str, Run]) -> Iterator[tuple[str, str]]:
    for name, run in runs.items():
        method, _, solver = name.partition("/")
        if solver != "m_star" or method not in runs:
            continue
        a, b = _measures(runs[method].record), _measures(run.record)
        worst, text = _widest(runs[method].record, a, run.record, b, _of_solvers(run))
        if worst > 1.0:
            # Tiny changes of the tolerance show how much rounding may change each run until each time. If it changes
            # the steps, because nothing moves and errors are rounding, the runs differ by these errors.
            parts = (ABOVE, 2.0 - ABOVE) if _steps(run) == _steps(runs[method]) else (0.1,)
            errors = [_own_error(own, part) for own in (runs[method], run) for part in parts]
            allowed = _grown(_of_solvers(run), errors)
            worst, text = _widest(runs[method].record, a, run.record, b, allowed)
            warned = any(part in warning for warning in run.warnings for part in NOT_UNIQUE)
            if worst > 1.0 and not warned:
                yield "solvers", f"{name} and {method}: {text}, though rounding changes either by less"


def _steps(run: Run) -> tuple[int, int]:
    assert run.record is not None
    return run.record.summary["steps"], run.record.summary["steps_rejected"]


def _of_rounding(run: Run, time: Array) -> Array:
    """Return the share by which rounding changes a run with a sampled loop that is unstable, until each time, (T,)."""
    match = re.search(GROWTH_PER_PERIOD, " ".join(run.warnings))
    if match is None or run.resolved is None:
        return np.zeros(len(time))
    ticks = time / run.resolved.resolved["controller"]["sample_time_s"]
    return np.asarray(np.finfo(float).eps * np.minimum(float(match[1]) ** np.minimum(ticks, 1e3), 1e18))


def _of_solvers(run: Run) -> Any:
    """Return the allowed difference of the solvers: rounding, and its effect on the steps that tolerances choose."""
    assert run.resolved is not None
    share = SOLVERS + 0.03 * run.resolved.integrator.rtol

    def allowed(measure: Measure, time: Array) -> Array:
        grown = SURE * _of_rounding(run, time)[:, None] * measure.size
        return np.asarray(SOLVERS + share * measure.size + grown)

    return allowed


def _pair(first: str, run: Run, other: str, second: Run) -> Iterator[tuple[str, str]]:
    a, b = _measures(run.record), _measures(second.record)
    allowed = _promised(run, second)
    worst, text = _widest(run.record, a, second.record, b, allowed)
    if worst <= 1.0:
        return
    if any(part in warning for warning in (*run.warnings, *second.warnings) for part in NOT_UNIQUE):
        return
    stepped = "time_stepping" in other
    errors = [_own_error(run, 0.1), _own_error(second, 0.5 if stepped else 0.1)]
    worst, text = _widest(run.record, a, second.record, b, _grown(allowed, errors))
    for part, first_order in FINER if stepped else ():
        if worst > 1.0:
            errors[2:] = [_still_growing(errors[1], _own_error(second, part), first_order)]
            worst, text = _widest(run.record, a, second.record, b, _grown(allowed, errors))
    if worst > 1.0 and (exact := (_with_exact_encoders(run), _with_exact_encoders(second))) != (run, second):
        # An encoder may read the next of its steps: the same scene must agree without them.
        yield from _pair(first, exact[0], other, exact[1])
    elif worst > 1.0:
        yield "methods", f"{first} and {other}: {text}, though finer steps change either by less"


def _with_exact_encoders(run: Run) -> Run:
    """Return the run of the same scenario with encoders that do not round; the same run if they do not anyway."""
    assert run.resolved is not None
    config = run.resolved.config
    encoders = config.sensors.encoders if config.sensors is not None else None
    if encoders is None or max(encoders.resolution_deg, encoders.resolution_m) == 0.0:
        return run
    exact = encoders.model_copy(update={"resolution_deg": 0.0, "resolution_m": 0.0})
    return _repeated(run, sensors=config.sensors.model_copy(update={"encoders": exact}))


def _repeated(run: Run, **update: Any) -> Run:
    """Return a run of the same scenario with other parts of its configuration."""
    assert run.resolved is not None
    scenario = replace(run.resolved, config=run.resolved.config.model_copy(update=update))
    try:
        return replace(run, resolved=scenario, record=simulate(scenario), error=None)
    except SimulationStopped as stop:
        return replace(run, resolved=scenario, record=stop.record, error=stop)
    except DynsimError as error:
        return replace(run, resolved=scenario, record=None, error=error)


def _grown(allowed: Any, errors: Sequence[dict[str, tuple[Array, Array]]]) -> Any:
    """Return the limit, increased by the changes until each time of runs that were repeated with other options."""

    def grown(measure: Measure, time: Array) -> Array:
        own = np.zeros(len(time))
        for error in errors:
            # If a run cannot be repeated, its error is unknown.
            own = own + (np.interp(time, *error[measure.name]) if measure.name in error else np.inf)
        return np.asarray(allowed(measure, time) + SURE * own[:, None] * measure.size)

    return grown


def _still_growing(
    half: dict[str, tuple[Array, Array]], finer: dict[str, tuple[Array, Array]], first_order: float
) -> dict[str, tuple[Array, Array]]:
    """Return the changes by a finer step, times the share by which they exceed those of first order.

    At first order they are ``first_order`` times those by half of the step, which are the estimate already.
    """
    grown = {}
    for name, (time, change) in finer.items():
        before = np.interp(time, *half[name]) if name in half else change
        grown[name] = time, change * np.maximum(change / (first_order * np.maximum(before, 1e-12)) - 1.0, 0.0)
    return grown


def _energies(record: Record) -> list[str]:
    return [name for name in ENERGIES if name in record]


def _measures(record: Record | None) -> list[Measure]:
    """Return positions, relative to their motion, and energies, relative to the largest energy."""
    assert record is not None
    q = record["q"]
    moved = np.abs(q - q[:1]).max(axis=0, initial=0.0)
    # Errors of joints that barely move depend on the errors of their neighbours.
    measures = [Measure("q", q, np.maximum(moved, max(0.1 * float(moved.max(initial=0.0)), 1e-4)))]
    named = _energies(record)
    parts = [record[name] - (record[name][0] if name == "energy_potential" else 0.0) for name in named]
    energies = np.stack(parts, axis=1)
    size = float(np.abs(energies).max(initial=0.0))
    measures.append(Measure("energy", energies, np.full(len(parts), max(size, 1e-9))))
    return measures


def _promised(run: Run, other: Run) -> Any:
    """Return the limit of each measure without repeated runs."""
    share, step = 0.0, 0.0
    speed = 0.0
    for own in (run, other):
        assert own.resolved is not None
        assert own.record is not None
        options = own.resolved.integrator
        if options.method == "time_stepping":
            step = float(own.record.summary["time_stepping"]["step_s"])
            share += STEPPED_SHARE
            speed = float(np.abs(own.record["v"]).max(initial=0.0))
        else:
            share += ADAPTIVE_SHARE * options.rtol

    if any(SHARED in warning for own in (run, other) for warning in own.warnings):
        share += SPLIT_SHARE

    def allowed(measure: Measure, time: Array) -> Array:
        # Landings may be early or late by a step.
        late = STEPS * step * speed if measure.name == "q" else 2.0 * STEPPED_SHARE * measure.size * (step > 0.0)
        grown = SURE * sum(_of_rounding(own, time) for own in (run, other))[:, None] * measure.size
        return np.asarray(share * measure.size + late + 1e-8 + grown)

    return allowed


def _widest(
    first: Record | None, a: list[Measure], second: Record | None, b: list[Measure], allowed: Any
) -> tuple[float, str]:
    """Return the largest difference relative to its limit, over the common samples, and a sentence about it."""
    assert first is not None
    assert second is not None
    worst, text = 0.0, ""
    _, i, j = np.intersect1d(first.time.round(9), second.time.round(9), return_indices=True)
    # The last part of a stopped run is not compared.
    keep = first.time[i] <= min(first.time[-1], second.time[-1]) * (1.0 if first.complete and second.complete else 0.95)
    i, j = i[keep], j[keep]
    if not len(i):
        return worst, text
    for own, other in zip(a, b, strict=True):
        off = _apart(own.values[i], other.values[j], own.name == "energy")
        # A run that diverges must not set the scale.
        size = np.minimum(own.size, other.size)
        limit = np.broadcast_to(allowed(Measure(own.name, own.values, size), first.time[i]), off.shape)
        share = off / limit
        if share.max() > worst:
            worst = float(share.max())
            # The beginning of a difference is more useful than its maximum.
            t = int((share.max(axis=1) > min(1.0, 0.999 * worst)).argmax())
            k = int(share[t].argmax())
            name = first.labels["q"][k] if own.name == "q" else _energies(first)[k]
            text = (
                f"{own.name} {name} at t = {first.time[i[t]]:.6g} s is {own.values[i[t], k]:.8g} and "
                f"{other.values[j[t], k]:.8g}, {off[t, k]:.3g} apart (allowed {limit[t, k]:.3g})"
            )
    return worst, text


def _apart(a: Array, b: Array, jumps: bool) -> Array:
    """Return distances of values at samples; for values that jump, distances from the other run's range nearby."""
    if not jumps:
        return np.asarray(np.abs(a - b))
    around = [b[np.clip(np.arange(len(b)) + shift, 0, len(b) - 1)] for shift in range(-JUMPS, JUMPS + 1)]
    return np.asarray(np.maximum(np.maximum(a - np.max(around, axis=0), np.min(around, axis=0) - a), 0.0))


def _own_error(run: Run, part: float) -> dict[str, tuple[Array, Array]]:
    """Return times and the relative change of each measure until then if a run is repeated with other options."""
    assert run.resolved is not None
    options: dict[str, float] = {}
    if run.resolved.integrator.method == "time_stepping":
        assert run.record is not None
        options["step_s"] = part * float(run.record.summary["time_stepping"]["step_s"])
    else:
        options["rtol"] = max(part * run.resolved.integrator.rtol, 1e-13)
        options["atol"] = max(part * run.resolved.integrator.absolute_tolerance, 1e-16)
    finer = _repeated(run, integrator=run.resolved.integrator.model_copy(update=options)).record
    if finer is None or len(finer) < 2 or run.record is None:
        return {}
    errors = {}
    _, i, j = np.intersect1d(run.record.time.round(9), finer.time.round(9), return_indices=True)
    for own, other in zip(_measures(run.record), _measures(finer), strict=True):
        off = (np.abs(own.values[i] - other.values[j]) / np.minimum(own.size, other.size)).max(axis=1)
        errors[own.name] = run.record.time[i], np.maximum.accumulate(off)
    return errors
