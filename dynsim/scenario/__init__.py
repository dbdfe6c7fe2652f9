"""Scenarios: reading YAML files (``reading``), validation (``schema``), and building the objects (``build``)."""

from dynsim.scenario.build import build_model as build_model
from dynsim.scenario.build import require_scenario as require_scenario
from dynsim.scenario.reading import ScenarioFile as ScenarioFile
from dynsim.scenario.reading import find_scenario as find_scenario
from dynsim.scenario.reading import json_schema as json_schema
from dynsim.scenario.reading import load_scenario as load_scenario
from dynsim.scenario.reading import parse_override as parse_override
from dynsim.scenario.reading import read_scenario as read_scenario
from dynsim.scenario.reading import scenario_from_resolved as scenario_from_resolved
from dynsim.scenario.reading import to_yaml as to_yaml
from dynsim.scenario.reading import variant_names as variant_names
from dynsim.scenario.schema import Scenario as Scenario
from dynsim.scenario.schema import ScenarioConfig as ScenarioConfig
from dynsim.system.shipped import SHIPPED as SHIPPED
from dynsim.system.shipped import shipped_scenarios as shipped_scenarios
