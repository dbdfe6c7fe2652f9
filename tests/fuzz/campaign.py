"""Fuzz campaign: cases run in worker processes; a dead or hung worker is a failure of its case."""

from __future__ import annotations

import itertools
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from fuzz.case import KINDS, draw
from fuzz.worker import CRASH, FAILURES, HANG, INTERRUPTED, LOSS, OK, READY, REFUSED, Outcome

SEED = 8
# Time after which a command counts as hung [s]: well above dynsim's limit for reading a damaged record, even on a busy
# machine.
LIMIT = 90.0
ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Result:
    """Outcome of one case."""

    kind: str
    seed: int
    index: int
    case: str
    ended: Outcome
    seconds: float

    @property
    def failed(self) -> bool:
        return self.ended.outcome in FAILURES

    @property
    def cause(self) -> tuple[str, str, str, str]:
        """Key that is equal for failures with the same cause, as far as this can be determined."""
        return self.kind, self.ended.outcome, self.ended.what, self.ended.place

    def __str__(self) -> str:
        ended = self.ended
        return (
            f"{ended.outcome}: {ended.what} at {ended.place or '-'}\n  {self.kind}: {self.case[:200]}\n"
            f"  repeat: PYTHONPATH=.:tests python -m fuzz --seed {self.seed} --repeat {self.kind} {self.index}\n"
            + "".join(f"  | {line}\n" for line in ended.detail.strip().splitlines()[-8:])
        )


def read(journal: Path) -> list[Result]:
    """Return the results in a journal, one in each line; the last result of a case counts."""
    rows = map(json.loads, journal.read_text(encoding="utf-8").splitlines())
    results = [Result(**{**row, "ended": Outcome(**row["ended"])}) for row in rows]
    return list({(result.seed, result.kind, result.index): result for result in results}.values())


class Worker:
    """A child process and its current case."""

    def __init__(self, records: Path, folder: Path, limit: float, broken: bool) -> None:
        self._records = records
        self._arguments = ["--records", str(records), "--folder", str(folder), "--limit", str(limit)]
        self._arguments += ["--broken"] if broken else []
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        self._process: subprocess.Popen[str] | None = None

    def run(self, kind: str, seed: int, index: int) -> Result:
        """Run one case and return its outcome; restart the child if needed."""
        process = self._process or self._start()
        started = time.monotonic()
        line = ""
        try:
            process.stdin.write(f"{kind} {seed} {index}\n")  # type: ignore[union-attr]
            process.stdin.flush()  # type: ignore[union-attr]
            line = process.stdout.readline()  # type: ignore[union-attr]
        except BrokenPipeError:
            pass
        seconds = time.monotonic() - started
        if not line.endswith("\n"):
            return Result(
                kind, seed, index, draw(kind, seed, index, self._records).what, self._post_mortem(process), seconds
            )
        answer = json.loads(line)
        case = answer.pop("case")
        return Result(kind, seed, index, case, Outcome(**answer), seconds)

    def close(self) -> None:
        """End the child, whatever its state."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None
        self._log.close()

    def _start(self) -> subprocess.Popen[str]:
        self._log.seek(0)
        self._log.truncate()
        paths = [str(ROOT), str(ROOT / "tests"), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
        process = subprocess.Popen(
            [sys.executable, "-m", "fuzz.worker", *self._arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            env=environment,
        )
        self._process = process
        if process.stdout.readline().strip() != READY:  # type: ignore[union-attr]
            raise RuntimeError(f"a worker does not start: {self._read_log()[-2000:]}")
        return process

    def _post_mortem(self, process: subprocess.Popen[str]) -> Outcome:
        process.kill()
        process.communicate()
        self._process = None
        log = self._read_log()
        # The main thread, which started first, is the last in the list of threads.
        main_thread = log.rpartition("(most recent call first)")[2]
        places = [line.strip() for line in main_thread.splitlines() if line.lstrip().startswith("File ")]
        ours = next((line for line in places if f"{os.sep}dynsim{os.sep}" in line and "site-packages" not in line), "")
        # 'File "…/dynsim/record.py", line 144 in load' → 'dynsim/record.py:load'
        location = (
            ":".join(ours.partition(f"{ROOT}{os.sep}")[2].replace('"', "").split(", line ")[:1] + ours.split()[-1:])
            if ours
            else ""
        )
        if "Timeout (" in log:
            return Outcome(HANG, "heeds no Ctrl-C", location, log[-1500:])
        code = process.returncode
        if code == 130:
            # Ctrl-C in the compiler, which can only be ended with its process.
            return Outcome(INTERRUPTED, detail=log[-1500:])
        end = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return Outcome(CRASH, f"the process ended: {end}", location, log[-1500:])

    def _read_log(self) -> str:
        self._log.seek(0)
        return self._log.read().decode("utf-8", "replace")


def run(
    cases: Iterable[tuple[str, int]],
    *,
    records: Path,
    seed: int = SEED,
    jobs: int = 1,
    limit: float = LIMIT,
    broken: bool = False,
    report: Callable[[Result], None] = lambda result: None,
) -> list[Result]:
    """Run cases (kind, index) in ``jobs`` workers; ``report`` receives each result as it arrives."""
    todo: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()
    for case in cases:
        todo.put(case)

    def work(folder: Path) -> list[Result]:
        worker, results = Worker(records, folder, limit, broken), []
        try:
            while True:
                try:
                    kind, index = todo.get_nowait()
                except queue.Empty:
                    return results
                results.append(worker.run(kind, seed, index))
                report(results[-1])
        finally:
            worker.close()

    with tempfile.TemporaryDirectory(prefix="fuzz-") as base, ThreadPoolExecutor(jobs) as pool:
        results = [result for batch in pool.map(work, [Path(base, str(k)) for k in range(jobs)]) for result in batch]
    order = list(KINDS)
    return sorted(results, key=lambda result: (order.index(result.kind), result.index))


def spread(count: int) -> list[tuple[str, int]]:
    """Return ``count`` cases, of every kind in proportion to its weight."""
    cases = (
        (name, turn * kind.weight + k)
        for turn in itertools.count()
        for name, kind in KINDS.items()
        for k in range(kind.weight)
    )
    return list(itertools.islice(cases, count))


def table(results: list[Result]) -> str:
    """Return a table of kinds: outcomes, second readings, accepted inputs that ran, processor time and memory."""
    columns = (OK, REFUSED, INTERRUPTED, *FAILURES)
    heads = ("inputs", "compared", "run", *columns, "mean s", "most s", "most MB")
    lines = [f"{'kind':<14}" + "".join(f"{head.replace(' ', '_'):>14}" for head in heads)]
    for kind in (*dict.fromkeys(result.kind for result in results), "all"):
        own = [result for result in results if kind in ("all", result.kind)]
        counts = Counter(result.ended.outcome for result in own)
        row = [len(own), sum(result.ended.compared or result.ended.outcome == LOSS for result in own)]
        row += [sum(result.ended.ran and result.ended.outcome == OK for result in own)]
        row += [counts[name] for name in columns]
        times = [result.ended.cpu_s for result in own]
        numbers = [
            f"{sum(times) / len(own):.2f}",
            f"{max(times):.1f}",
            f"{max(result.ended.memory_MB for result in own):.0f}",
        ]
        lines.append(f"{kind:<14}" + "".join(f"{text:>14}" for text in (*row, *numbers)))
    slowest = max(results, key=lambda result: result.ended.cpu_s)
    biggest = max(results, key=lambda result: result.ended.memory_MB)
    lines.append(
        f"slowest: {slowest.kind} {slowest.index}, {slowest.ended.cpu_s:.1f} s of processor time; "
        f"largest: {biggest.kind} {biggest.index}, {biggest.ended.memory_MB:.0f} MB"
    )
    return "\n".join(lines)


def failures(results: list[Result]) -> str:
    """Return failures grouped by cause: their number, and the first of each group."""
    causes: dict[tuple[str, str, str, str], list[Result]] = {}
    for result in results:
        if result.failed:
            causes.setdefault(result.cause, []).append(result)
    order = list(KINDS)
    ordered = sorted(causes.values(), key=lambda same: (order.index(same[0].kind), -len(same)))
    return "\n".join(f"{len(same)} × {same[0]}" for same in ordered)
