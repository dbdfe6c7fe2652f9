"""dynsim: dynamic simulator of braced hyper-redundant manipulators.

>>> import dynsim
>>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows")
>>> record = dynsim.simulate(scenario)
>>> round(record.summary["electrical_energy_J"], 1), record["q"].shape, record.units["q"]
(219.7, (2001, 10), 'rad')
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dynsim._version import __version__
from dynsim.errors import DynsimError

if TYPE_CHECKING:
    from dynsim.compile.bracing import Brace
    from dynsim.compile.model import Model
    from dynsim.draw import film
    from dynsim.draw import page as view
    from dynsim.draw.figures import figure
    from dynsim.engine import check, simulate
    from dynsim.engine.simulation import Simulation, State
    from dynsim.planner.answer import BracePlan, plan_braces
    from dynsim.record import Record
    from dynsim.scenario import Scenario, build_model, load_scenario
    from dynsim.studies.batch import simulate_batch
    from dynsim.studies.compare import compare

__all__ = [
    "Brace",
    "BracePlan",
    "DynsimError",
    "Model",
    "Record",
    "Scenario",
    "Simulation",
    "State",
    "__version__",
    "build_model",
    "check",
    "compare",
    "figure",
    "film",
    "load_scenario",
    "plan_braces",
    "simulate",
    "simulate_batch",
    "view",
]

# These modules are imported on first use: importing numba and pydantic takes a second and is not needed for
# `dynsim --help`.
_HOME = {
    "Brace": "dynsim.compile.bracing",
    "BracePlan": "dynsim.planner.answer",
    "Model": "dynsim.compile.model",
    "Record": "dynsim.record",
    "Scenario": "dynsim.scenario",
    "Simulation": "dynsim.engine.simulation",
    "State": "dynsim.engine.simulation",
    "build_model": "dynsim.scenario",
    "check": "dynsim.engine",
    "compare": "dynsim.studies.compare",
    "figure": "dynsim.draw.figures",
    "load_scenario": "dynsim.scenario",
    "plan_braces": "dynsim.planner.answer",
    "simulate": "dynsim.engine",
    "simulate_batch": "dynsim.studies.batch",
}


# Public names that refer to modules.
_MODULES = {"film": "dynsim.draw.film", "view": "dynsim.draw.page"}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    if name in _MODULES:
        return importlib.import_module(_MODULES[name])
    raise AttributeError(f"module 'dynsim' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
