"""10 s jobs of all variants, glued and on a real floor, and with next to no inductance, by two methods."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from dynsim.engine.dynamics import prepare
from dynsim.integrators.driver import advance
from dynsim.scenario import read_scenario
from dynsim.studies.bench.programs import SCENARIO

FLOOR = f"{SCENARIO}_floor"
SMALL_INDUCTANCE = 1e-5  # [H]
METHODS = ("dopri5", "radau5")
_INDUCTANCE = "plant.link.motor.inductance_H"

GLUED, REAL, SMALL = "glued", "real floor", f"glued, L = {SMALL_INDUCTANCE:g} H"


def measure(rounds: int) -> list[dict[str, Any]]:
    """Least CPU seconds of each variant by each method, taking turns."""
    cases = [(GLUED, SCENARIO, {}), (REAL, FLOOR, {}), (SMALL, SCENARIO, {_INDUCTANCE: SMALL_INDUCTANCE})]
    rows = []
    for name, scenario, overrides in cases:
        file = read_scenario(scenario)
        for variant in file.variants:
            if name == SMALL and variant != file.variants[0]:
                continue
            samples: dict[str, list[float]] = {method: [] for method in METHODS}
            for _ in range(rounds):
                for method in METHODS:
                    # An explicit method follows the motors' own rates: minutes.
                    if not (name == SMALL and method == "dopri5"):
                        samples[method].append(_seconds(file, variant, {**overrides, "integrator.method": method}))
            rows += [
                {"contacts": name, "variant": variant, "method": method, "cpu_minimum_s": min(values)}
                for method, values in samples.items()
                if values
            ]
    return rows


def _seconds(file: Any, variant: str, overrides: dict[str, Any]) -> float:
    prepared = prepare(file.load(variant, overrides))
    advance(prepared.system, prepared.workspace, prepared.run, 0)
    started = time.thread_time()
    advance(prepared.system, prepared.workspace, prepared.run, np.iinfo(np.int64).max)
    return time.thread_time() - started
