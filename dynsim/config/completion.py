"""Shell completion of scenario and variant names; it runs at every press of Tab and imports no large packages."""

from __future__ import annotations

from pathlib import Path

import typer

from dynsim.errors import ScenarioError
from dynsim.system.shipped import shipped_scenario, shipped_scenarios


def scenarios(incomplete: str) -> list[str]:
    """Return names of shipped scenarios and paths of YAML files that start with ``incomplete``."""
    from glob import escape

    folder, separator, _ = incomplete.rpartition("/")
    files = sorted(Path(folder + separator).glob(f"{escape(incomplete.removeprefix(folder + separator))}*.yaml"))
    names = [path.stem for path in shipped_scenarios()]
    return [name for name in names if name.startswith(incomplete)] + [str(path) for path in files]


def variants(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the variants of the scenario on the command line whose names start with ``incomplete``."""
    # Imported here because the command line loads this module at every start.
    from dynsim.system.inputs import YamlMapping, is_file, parse_yaml, read_text

    # As long as the option has no value, the arguments before it have not been parsed.
    path = Path(ctx.params.get("scenario") or next(iter(ctx.args), ""))
    try:
        path = path if is_file(path, ScenarioError) else shipped_scenario(path) or path
        data = parse_yaml(read_text(path, ScenarioError), ScenarioError, str(path))
    except ScenarioError:
        return []
    names = data.get("variants") if isinstance(data, YamlMapping) else None
    return [name for name in names if name.startswith(incomplete)] if isinstance(names, YamlMapping) else []
