"""Many scenes, each run by all its methods and checked; results by factor and level.

    PYTHONPATH=.:tests python -m combinations --seed 7 --count 1000 --jobs 2 --journal study.jsonl --keep failing

draws new scenes; ``--cover pairs`` (or ``triples``) instead runs scenes that contain every pair (triple). ``--repeat
N`` prints the scene of a number and runs it again. A journal stores completed scenes, and the study resumes from it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from combinations.covering import draw, pairs, refused_share, triples
from combinations.factors import FACTORS
from combinations.running import Run, faults, runs
from combinations.scenes import Scene, scene
from dynsim.engine import Progress
from dynsim.errors import SimulationInterrupted
from dynsim.studies.processes import WorkerInterrupted, WorkerLost, run_in_processes
from dynsim.system.files import write_json

# Every THOROUGH-th scene is checked completely, including all results of its record.
THOROUGH = 10


@dataclass(frozen=True)
class Outcome:
    """Result of a scene.

    Attributes
    ----------
    number, seed : int
        Number and seed with which it was drawn.
    levels : dict
        Levels of all factors.
    status : dict
        Status of each run, see :attr:`combinations.running.Run.status`.
    problems : list
        Kind and text of each problem.
    said : dict
        Texts of stops and refusals of each run.
    solves, given_up : int
        Contact problems of its runs with time stepping, and the number of problems given up.
    wall_s : float
        Wall time of all its runs [s].
    """

    number: int
    seed: int
    levels: dict[str, str]
    status: dict[str, str] = field(default_factory=dict)
    problems: list[tuple[str, str]] = field(default_factory=list)
    said: dict[str, str] = field(default_factory=dict)
    solves: int = 0
    given_up: int = 0
    wall_s: float = 0.0

    @property
    def failed(self) -> bool:
        return bool(self.problems)


def assignment(cover: str, seed: int, number: int) -> dict[str, str]:
    """Return the levels of a scene by its number, from a cover or drawn."""
    if cover == "none":
        return draw(seed, number)
    return {"pairs": pairs, "triples": triples}[cover](seed)[number]


def look_at(
    levels: Mapping[str, str],
    seed: int,
    number: int,
    folder: Path,
    *,
    thorough: bool | None = None,
    takes: Callable[[Scene, str, str], bool] = lambda drawn, method, manner: True,
    change: Callable[[dict[str, Any]], None] = lambda settings: None,
) -> Outcome:
    """Run a scene by all its methods, or by the methods that ``takes`` accepts, and check everything.

    ``change`` has sections of the scene to change.

    Raises
    ------
    SimulationInterrupted
    """
    began = time.monotonic()
    drawn = scene(levels, seed + number, folder, change)
    done = runs(drawn, partial(takes, drawn))
    problems = faults(drawn, done, thorough=number % THOROUGH == 0 if thorough is None else thorough)
    problems += _checked(drawn, done)
    stepped = [own.record.summary.get("time_stepping", {}) for own in done.values() if own.record is not None]
    return Outcome(
        number,
        seed,
        dict(levels),
        {name: own.status for name, own in done.items()},
        problems,
        {name: " ".join(str(own.error).split()) for name, own in done.items() if own.error is not None},
        sum(counts.get("contact_solves", 0) for counts in stepped),
        sum(counts.get("capped_solves", 0) for counts in stepped),
        time.monotonic() - began,
    )


def _checked(drawn: Scene, done: Mapping[str, Run]) -> list[tuple[str, str]]:
    """Return the problems that :mod:`combinations.checks` finds in the records."""
    from combinations import checks

    said: list[tuple[str, str]] = []
    for name, own in done.items():
        said += [(problem.kind, f"{name}: {problem.detail}") for problem in checks.problems(own.scenario, own)]
    if not done:
        return said
    first = next(iter(done.values()))
    return said + [(problem.kind, problem.detail) for problem in checks.compare(first.scenario, done)]


class _Work:
    """:func:`look_at` as a task for processes, each with a separate folder."""

    def __init__(self, cover: str, seed: int, keep: Path | None) -> None:
        self._cover, self._seed, self._keep = cover, seed, keep

    def __call__(self, number: int, look: Progress) -> Outcome:
        levels = assignment(self._cover, self._seed, number)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            try:
                outcome = look_at(levels, self._seed, number, folder)
            except SimulationInterrupted:
                raise
            except Exception as error:  # fault of the harness itself: continue with the other scenes
                problem = ("harness", f"{type(error).__name__}: {error}")
                outcome = Outcome(number, self._seed, levels, {}, [problem])
            if outcome.failed and self._keep is not None:
                keep(outcome, folder, self._keep / f"{self._cover}_{self._seed}_{number}")
        return outcome


def keep(outcome: Outcome, folder: Path, target: Path) -> None:
    """Copy the files of a scene, and write its problems."""
    shutil.copytree(folder, target, dirs_exist_ok=True)
    lines = [f"{kind}: {text}" for kind, text in outcome.problems]
    (target / "problems.txt").write_text("\n".join(lines) + "\n", "utf-8")


def table(outcomes: Sequence[Outcome]) -> str:
    """Return levels with their scenes, how their runs ended, and how many scenes have problems."""
    lines = [
        f"{'factor':<12}{'level':<15}{'scenes':>7}{'runs':>6}{'finished':>10}{'stopped':>9}{'refused':>9}{'failing':>9}"
    ]
    for factor, levels in FACTORS.items():
        for level in levels:
            own = [outcome for outcome in outcomes if outcome.levels[factor] == level]
            if own:
                lines.append(f"{factor:<12}{level:<15}{_row(own)}")
    by_method = sorted({name for outcome in outcomes for name in outcome.status})
    for name in by_method:
        count = Counter(outcome.status[name] for outcome in outcomes if name in outcome.status)
        lines.append(f"{'method':<12}{name:<20}{', '.join(f'{status} {n}' for status, n in count.most_common())}")
    lines.append(f"{'all':<27}{_row(outcomes)}")
    return "\n".join(lines)


def _row(own: Sequence[Outcome]) -> str:
    ended = Counter(status for outcome in own for status in outcome.status.values())
    stopped = ended.total() - ended["finished"] - ended["refused"]
    failing = sum(outcome.failed for outcome in own)
    return f"{len(own):>7}{ended.total():>6}{ended['finished']:>10}{stopped:>9}{ended['refused']:>9}{failing:>9}"


def account(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the numbers of a study: scenes, runs, stops by kind, problems by kind with the first scene of each."""
    ended = Counter(status for outcome in outcomes for status in outcome.status.values())
    kinds = Counter(kind for outcome in outcomes for kind in {kind for kind, _ in outcome.problems})
    return {
        "scenes": len(outcomes),
        "runs": ended.total(),
        "by_status": dict(ended.most_common()),
        "refused_pairs_share": refused_share(),
        "failing": sum(outcome.failed for outcome in outcomes),
        "contact_problems": sum(outcome.solves for outcome in outcomes),
        "given_up": sum(outcome.given_up for outcome in outcomes),
        "problems": {
            kind: {
                "scenes": count,
                "first": next(
                    {"number": outcome.number, "says": text}
                    for outcome in outcomes
                    for own, text in outcome.problems
                    if own == kind
                ),
            }
            for kind, count in kinds.most_common()
        },
        "wall_s": sum(outcome.wall_s for outcome in outcomes),
    }


def study(
    cover: str, seed: int, numbers: Sequence[int], jobs: int, kept: Path | None, take: Callable[[Outcome], None]
) -> list[Outcome]:
    """Run scenes by their numbers, in processes; ``take`` gets each outcome as it arrives."""
    outcomes: list[Outcome] = []

    def take_late(number: int, result: Callable[[], Outcome | None]) -> None:
        try:
            outcome = result()
        except (WorkerInterrupted, SimulationInterrupted):
            return
        except WorkerLost as lost:
            problem = (type(lost).__name__, "its process was lost")
            outcome = Outcome(number, seed, assignment(cover, seed, number), {}, [problem])
        if outcome is not None:
            outcomes.append(outcome)
            take(outcome)

    run_in_processes(_Work(cover, seed, kept), numbers, jobs, take_late)
    return sorted(outcomes, key=lambda outcome: outcome.number)


def _noted(journal: Path | None, seed: int) -> list[Outcome]:
    """Return the entries of a journal for a seed; a killed process may have left an unfinished line."""
    outcomes: list[Outcome] = []
    if journal is not None and journal.exists():
        for line in journal.read_text("utf-8").splitlines():
            with suppress(ValueError, TypeError):
                outcome = Outcome(**json.loads(line))
                if outcome.seed == seed:
                    outcomes.append(outcome)
    return outcomes


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m combinations", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=100, help="scenes")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--numbers", type=int, nargs="*", help="these scenes instead")
    parser.add_argument("--cover", choices=("none", "pairs", "triples"), default="none", help="instead of fresh scenes")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--journal", type=Path, help="file with a line for each scene; those that have one are not run")
    parser.add_argument("--keep", type=Path, help="folder for failing scenes, with their files")
    parser.add_argument("--out", type=Path, help="file for the numbers")
    parser.add_argument("--repeat", type=int, metavar="NUMBER", help="print this scene and run it again")
    return parser.parse_args()


def main() -> int:
    """Run scenes and print their results; return 1 if any fails."""
    options = _options()
    if options.repeat is not None:
        return _repeat(options)
    wanted: Sequence[int] = range(options.first, options.first + options.count)
    if options.cover != "none":
        whole = len({"pairs": pairs, "triples": triples}[options.cover](options.seed))
        wanted = range(options.first, min(options.first + options.count, whole))
    if options.numbers is not None:
        wanted = options.numbers
    earlier = [outcome for outcome in _noted(options.journal, options.seed) if outcome.number in wanted]
    left = sorted(set(wanted) - {outcome.number for outcome in earlier})

    def take(outcome: Outcome) -> None:
        if options.journal is not None:
            with options.journal.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(asdict(outcome)) + "\n")
        for kind, text in outcome.problems:
            print(f"{outcome.number}: {kind}: {text}", flush=True)

    done = study(options.cover, options.seed, left, options.jobs, options.keep, take)
    outcomes = sorted([*earlier, *done], key=lambda outcome: outcome.number)
    if not outcomes:
        print("nothing was done")
        return 1
    result = account(outcomes)
    print(table(outcomes))
    print(json.dumps(result, indent=2, ensure_ascii=False))
    if options.out is not None:
        write_json(options.out, {"seed": options.seed, "cover": options.cover, **result})
    return 1 if result["failing"] else 0


def _repeat(options: argparse.Namespace) -> int:
    levels = assignment(options.cover, options.seed, options.repeat)
    folder = options.keep or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    outcome = look_at(levels, options.seed, options.repeat, folder, thorough=True)
    print(scene(levels, options.seed + options.repeat, folder).text())
    print(outcome.status)
    for kind, text in outcome.problems:
        print(f"{kind}: {text}")
    return 1 if outcome.failed else 0


if __name__ == "__main__":
    # Imported under its module name, because other processes look it up there.
    from combinations import study as module

    raise SystemExit(module.main())
