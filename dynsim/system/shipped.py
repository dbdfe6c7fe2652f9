"""Folder and names of the scenario files shipped with dynsim; this module imports no other module of dynsim."""

from __future__ import annotations

from pathlib import Path

_CHECKOUT = Path(__file__).resolve().parents[2] / "scenarios"
SHIPPED = _CHECKOUT if _CHECKOUT.is_dir() else Path(__file__).resolve().parents[1] / "shipped_scenarios"


def shipped_scenarios() -> list[Path]:
    """Return the paths of the scenario files shipped with dynsim."""
    return sorted(SHIPPED.glob("*.yaml"))


def shipped_scenario(path: Path) -> Path | None:
    """Return the shipped scenario file for a name or for ``scenarios/NAME``; None if no such file is shipped."""
    if path.parent not in (Path(), Path("scenarios")):
        return None
    files = {file.name: file for file in shipped_scenarios()}
    return files.get(path.name) or files.get(f"{path.name}.yaml")
