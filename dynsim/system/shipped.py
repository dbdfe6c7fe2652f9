"""Folder and names of the scenario files that come with dynsim; imports nothing else of dynsim."""

from __future__ import annotations

from pathlib import Path

_CHECKOUT = Path(__file__).resolve().parents[2] / "scenarios"
SHIPPED = _CHECKOUT if _CHECKOUT.is_dir() else Path(__file__).resolve().parents[1] / "shipped_scenarios"


def shipped_scenarios() -> list[Path]:
    """Return the scenario files that come with dynsim."""
    return sorted(SHIPPED.glob("*.yaml"))


def shipped_scenario(path: Path) -> Path | None:
    """Return the shipped file for a name without a folder (or in ``scenarios``), or None."""
    if path.parent not in (Path(), Path("scenarios")):
        return None
    files = {file.name: file for file in shipped_scenarios()}
    return files.get(path.name) or files.get(f"{path.name}.yaml")
