"""Scenarios: reading YAML files (``reading``), validation (``schema``), and building the objects (``build``)."""

from dynsim.scenario.build import build_model, require_scenario
from dynsim.scenario.reading import (
    ScenarioFile,
    SetOptions,
    find_scenario,
    json_schema,
    load_scenario,
    parse_override,
    read_scenario,
    scenario_from_resolved,
    to_yaml,
    variant_names,
)
from dynsim.scenario.schema import Scenario, ScenarioConfig
from dynsim.system.shipped import SHIPPED, shipped_scenarios

__all__ = [
    "SHIPPED",
    "Scenario",
    "ScenarioConfig",
    "ScenarioFile",
    "SetOptions",
    "build_model",
    "find_scenario",
    "json_schema",
    "load_scenario",
    "parse_override",
    "read_scenario",
    "require_scenario",
    "scenario_from_resolved",
    "shipped_scenarios",
    "to_yaml",
    "variant_names",
]
