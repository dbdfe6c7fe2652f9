"""All variants of a scenario side by side."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, Protocol

from dynsim.engine import SIMULATION, simulate
from dynsim.errors import ScenarioError
from dynsim.files import write_json, write_text
from dynsim.record import Record
from dynsim.scenario import load_scenario, variant_names


class VariantProgress(Protocol):
    """A :class:`dynsim.engine.Progress` that also gets the variant's name."""

    def __call__(self, variant: str, time: float, stage: str = SIMULATION) -> None: ...


def compare(
    path: str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    jobs: int = 1,
    progress: VariantProgress | None = None,
    finished: Callable[[str, Record], None] | None = None,
) -> dict[str, Record]:
    """Simulate every variant of a scenario.

    Parameters
    ----------
    path : scenario file or name of a shipped one
    overrides : values by dotted key, for all variants
    jobs : processes; one runs the variants here, one after the other
    progress : see :class:`VariantProgress` (with several processes it is called only at a variant's end)
    finished : called with variant and record as soon as a variant is done, so that it can be saved

    Returns
    -------
    dict of Record by variant, in the order of the file

    Raises
    ------
    ScenarioError
        The file has no variants, or one of them is not valid; all are checked before the first runs.
    SimulationStopped, SimulationInterrupted
        From the first variant that stops.
    """
    names = variant_names(path)
    if not names:
        raise ScenarioError(f"{path}: has no variants to compare; use `dynsim run`")
    scenarios = {name: load_scenario(path, name, overrides) for name in names}
    records = {}
    if jobs > 1:
        # Spawned, not forked: the parent may hold threads and an open progress display.
        with ProcessPoolExecutor(min(jobs, len(names)), mp_context=get_context("spawn")) as pool:
            futures = {name: pool.submit(simulate, scenario) for name, scenario in scenarios.items()}
            try:
                for name, future in futures.items():
                    records[name] = future.result()
                    if progress is not None:
                        progress(name, scenarios[name].duration_s)
                    if finished is not None:
                        finished(name, records[name])
            except BaseException:
                # Ctrl-C or a stopped variant: nobody waits for the others.
                pool.shutdown(wait=False, cancel_futures=True)
                for process in active_children():
                    process.terminate()
                raise
        return records
    for name, scenario in scenarios.items():
        records[name] = simulate(scenario, None if progress is None else partial(progress, name))
        if finished is not None:
            finished(name, records[name])
    return records


def save_comparison(records: Mapping[str, Record], folder: Path) -> None:
    """Write ``comparison.json`` and ``comparison.csv``."""
    summaries = {name: record.summary for name, record in records.items()}
    write_json(folder / "comparison.json", {"variants": summaries})
    columns = ["variant"] + [key for key, value in next(iter(summaries.values())).items() if _is_scalar(value)]
    columns = list(dict.fromkeys(columns))
    contacts = list(dict.fromkeys(c["name"] for s in summaries.values() for c in s.get("contacts", ())))
    contact_keys = ("normal_force_min_N", "normal_force_mean_N", "normal_force_max_N", "pulling_fraction")
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*columns, *(f"{name}.{key}" for name in contacts for key in contact_keys)])
    for name, summary in summaries.items():
        by_name = {c["name"]: c for c in summary.get("contacts", ())}
        row = [name if key == "variant" else summary[key] for key in columns]
        row += [by_name.get(contact, {}).get(key, "") for contact in contacts for key in contact_keys]
        writer.writerow(row)
    write_text(folder / "comparison.csv", stream.getvalue())


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, (int, float, str))
