"""A child process that runs fuzz cases and judges how each ends.

A case consists of damaged inputs and the dynsim commands that read them. The parent (:mod:`fuzz.campaign`) notices when
the child crashes. The child reads lines ``kind seed index`` and answers each with one line of JSON. Commands run in the
child, through the entry point of the console script.

A command must succeed, or refuse with one line that begins with ``error:`` (and indented continuation lines), exit code
2 or 3 and all files unchanged. Exceptions: ``hw replay`` may end with 1 to 4 and may write files in any case; a command
may save a partial result that it marks incomplete; a simulation beyond its limit of processor time must stop on Ctrl-C,
or by itself if it makes no progress. ``check`` and ``hw check`` must
not change files even if they succeed. No temporary file remains; no signal of a run is infinite.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import typer
from support.messages import says

from fuzz import broken
from fuzz.case import SHIPPED, Draft, draw, put
from fuzz.inputs.sweep import forget_commit
from fuzz.readings import Unreadable, loaded

OK, REFUSED, INTERRUPTED = "ok", "refused", "interrupted"
FAILURES = TRACEBACK, HANG, CRASH, LOSS, MESSAGE, FILES, NUMBERS, LARGE = (
    "traceback", "hang", "crash", "silent loss", "unclear error", "files changed", "not finite", "memory",
)  # fmt: skip
# Errors of commands that have written tables with the reasons.
EXPLAINED = ("sweep table", "no plan")
READY = "ready"
# Memory of a worker in addition to its memory after all imports [bytes].
MEMORY = 4 << 30
# Maximum resident memory of a case [MB].
RESIDENT = 2000.0
# Maximum processor time of a command [s]. A simulation may take longer because of its input (stiff motors, for
# example); then it must stop on Ctrl-C. Without progress of the simulated time it must end by itself.
CPU_LIMIT, SIMULATION_LIMIT, STALLED_LIMIT = 10.0, 20.0, 70.0
SIMULATING = ("run", "compare", "sweep", "plan")
# Original stderr: file descriptor 2 is redirected while a case runs.
LOG = os.dup(2)


@dataclass
class Outcome:
    """Outcome of a case: one of the words above; for failures description and place, equal for equal causes."""

    outcome: str
    what: str = ""
    place: str = ""
    detail: str = ""
    # The content of the input was compared with dynsim's objects.
    compared: bool = False
    # A simulation, a plan or a replay succeeded.
    ran: bool = False
    cpu_s: float = 0.0
    memory_MB: float = 0.0


def run_case(case: Draft, folder: Path, limit: float) -> Outcome:
    """Run all commands of a case in ``folder``; the first failure counts."""
    used, children = sum(os.times()[:4]), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the largest resident memory
    ended = _run_case(case, folder, limit)
    ended.cpu_s = sum(os.times()[:4]) - used
    largest = int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text(encoding="ascii"))[0])
    grown = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    ended.memory_MB = 1.024e-3 * max(largest, grown if grown > children else 0)
    if ended.memory_MB > RESIDENT and ended.outcome not in FAILURES:
        ended.outcome, ended.what = LARGE, f"more than {RESIDENT:g} MB"
    return ended


def _run_case(case: Draft, folder: Path, limit: float) -> Outcome:
    for name, data in case.files.items():
        put(folder / name, data)
    # Some scenarios refer to them.
    for name in ("robots", "data"):
        shutil.copytree(SHIPPED / name, folder / name)
    ended, ran = Outcome(OK), False
    for command in case.commands:
        before = _snapshot(folder)
        ended = _run_command(command, folder, limit)
        ran = ran or (ended.outcome == OK and (command[0] in SIMULATING or command[:2] == ["hw", "replay"]))
        if ended.outcome in FAILURES:
            return ended
        after = _snapshot(folder)
        replays = command[:2] in (["hw", "replay"], ["hw", "compare"], ["hw", "recover"])
        reads_only = (
            (ended.outcome == REFUSED and not replays and not any(says(ended.detail, phrase) for phrase in EXPLAINED))
            or command[0] == "check"
            or (command[0] == "hw" and not replays)
        )
        if reads_only and not says(ended.detail, "incomplete") and before != after:
            changed = sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
            return Outcome(
                FILES, f"{' '.join(command[:2])} changed {', '.join(changed)[:200]}", command[0], ended.detail
            )
        if left := [name for name in after if name not in before and ".tmp" in name]:
            return Outcome(FILES, f"{command[0]} left {left[0]}", command[0], ended.detail)
        if ended.outcome != OK:
            break
        if command[0] == "run" and (wrong := _not_finite(folder / "out" / "record.h5")):
            return Outcome(NUMBERS, f"{wrong} is not finite", command[0], ended.detail)
    ended.ran = ran
    if case.losses is not None:
        lost = _losses(case, folder, limit)
        if lost.outcome in FAILURES:
            return lost
        ended.compared = lost.compared
        ended.ran = ran or (lost.compared and case.simulates)
        if not case.commands and not lost.compared:
            ended.outcome = REFUSED
    return ended


def _not_finite(path: Path) -> str:
    """Return the first signal of a successful run with a value that is not finite, except signals that may have one."""
    import numpy as np

    record = loaded(path)
    return next((name for name in record if np.isinf(record[name]).any()), "")


def _run_command(command: list[str], folder: Path, limit: float) -> Outcome:
    from dynsim.cli import main

    argv, sys.argv = sys.argv, ["dynsim", *command]
    code: Any = 0
    used, simulating = sum(os.times()[:4]), command[0] in SIMULATING
    with _quiet(folder, limit, SIMULATION_LIMIT if simulating else CPU_LIMIT, simulating) as said:
        warnings.simplefilter("default")
        try:
            main()
        except SystemExit as stop:
            code = stop.code
        except KeyboardInterrupt:
            code = 130
        except BaseException as error:
            return _traceback(error)
        finally:
            sys.argv = argv
    if said.rang_at:
        if (
            simulating
            and not said.stalled
            and code == 130
            and (command[0] != "run" or says(said.errors, "interrupted"))
        ):
            return Outcome(INTERRUPTED, detail=said.errors)
        return Outcome(HANG, f"{command[0]} takes more than {said.rang}", _place(said.rang_at), said.errors[-500:])
    if (spent := sum(os.times()[:4]) - used) > CPU_LIMIT and not simulating:
        return Outcome(HANG, f"{command[0]} takes more than {CPU_LIMIT:g} s of processor time", detail=f"{spent:.1f} s")
    return _judge(command, 0 if code is None else code, said.output, said.errors)


# Exit codes of commands that differ from 2 and 3.
CODES = {"hw replay": (1, 2, 3, 4), "hw compare": (2, 3, 5)}


def _judge(command: list[str], code: Any, out: str, err: str) -> Outcome:
    """Check exit code and output of a command against the rules."""
    lines = err.splitlines()
    errors = [line for line in lines if line.startswith("error:")]
    if code == 2 and lines[:1] and lines[0].startswith("Usage: ") and "Error" in err:
        # The command line itself is wrong: the message of its parser is in a frame.
        return Outcome(REFUSED, detail=err[-2000:])
    verdict = Outcome(OK if code == 0 else REFUSED, detail=err[-2000:])
    wrong = ""
    if "Traceback (most recent call last)" in out + err:
        return Outcome(TRACEBACK, "a traceback was printed", _last_place(err), err[-2000:])
    if strange := sorted({sign for sign in out + err if _is_control(sign)}):
        wrong = f"control characters {strange!r} reach the terminal"
    elif code == 0 and errors:
        wrong = "an error with exit code 0"
    elif code != 0 and code not in CODES.get(" ".join(command[:2]), (2, 3)):
        wrong = f"exit code {code!r}"
    elif code != 0 and len(errors) != 1:
        wrong = f"{len(errors)} lines of error:"
    elif code != 0 and (loose := _loose(lines, after=errors[0])):
        wrong = f"the error goes on in a line of its own: {loose[0][:60]!r}"
    elif code != 0 and errors[0].removeprefix("error:").strip() == "":
        wrong = "an error that says nothing"
    if not wrong:
        return verdict
    # Quoted text differs from case to case; the cause does not.
    return Outcome(
        MESSAGE,
        wrong.partition(":")[0] if wrong.startswith("the error") else wrong,
        command[0],
        f"{wrong}\n{err[-2000:]}",
    )


def _is_control(sign: str) -> bool:
    return (ord(sign) < 32 and sign not in "\n\t") or 127 <= ord(sign) < 160


# Lines of a sweep about runs that failed.
FAILED_RUN = re.compile(r"run \d+ failed: |… and \d+ more")


def _loose(lines: list[str], after: str) -> list[str]:
    """Return lines other than the error, its continuation, warnings and the note about a saved part."""
    loose = []
    warned = False
    for line in lines:
        if line == after or line.startswith(" ") or not line.strip():
            continue
        if says(line, "saved part") or FAILED_RUN.match(line):
            continue
        warned = warned or "Warning: " in line or line.startswith("warning: ")
        if not warned:
            loose.append(line)
    return loose


def _losses(case: Draft, folder: Path, limit: float) -> Outcome:
    from dynsim.errors import DynsimError

    assert case.losses is not None
    with _quiet(folder, limit, SIMULATION_LIMIT) as said:
        warnings.simplefilter("ignore")
        try:
            lost = case.losses()
        except (DynsimError, MemoryError, KeyboardInterrupt, Unreadable):
            return Outcome(OK) if not said.rang_at else _late(said)
        except BaseException as error:
            return _traceback(error)
    if said.rang_at:
        return _late(said)
    return Outcome(LOSS, _class_of(lost[0]), "", "; ".join(lost)[:500]) if lost else Outcome(OK, compared=True)


def _late(said: _Said) -> Outcome:
    assert said.rang_at is not None
    return Outcome(HANG, f"reading takes more than {said.rang}", _place(said.rang_at))


def _class_of(loss: str) -> str:
    """Return the loss without its numbers and names, so that equal losses are counted together."""
    words = [word for word in loss.split() if not any(sign.isdigit() or sign in "'\".,:=/" for sign in word)]
    return " ".join(words)[:70] or loss[:70]


def _traceback(error: BaseException) -> Outcome:
    stack = traceback.extract_tb(error.__traceback__)
    text = "".join(traceback.format_exception(error, limit=-6))
    return Outcome(TRACEBACK, type(error).__name__, _place(stack), text[-1500:])


def _place(stack: traceback.StackSummary) -> str:
    """Return the innermost function of dynsim on a stack, and where it ended if elsewhere."""
    ours = [
        frame
        for frame in stack
        if f"{os.sep}dynsim{os.sep}" in frame.filename and "site-packages" not in frame.filename
    ]
    inner = stack[-1] if stack else None
    location = f"{_short(ours[-1].filename)}:{ours[-1].name}" if ours else "outside of dynsim"
    if inner is not None and (not ours or inner is not ours[-1]):
        location += f" → {_short(inner.filename)}:{inner.name}"
    return location


def _short(filename: str) -> str:
    return "/".join(Path(filename).parts[-2:])


def _last_place(text: str) -> str:
    places = [line.strip() for line in text.splitlines() if line.lstrip().startswith("File ")]
    return places[-1] if places else ""


def _snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@dataclass
class _Said:
    """Output of Python and of compiled libraries, and the stack when the time was up."""

    output: str = ""
    errors: str = ""
    rang_at: traceback.StackSummary | None = None
    rang: str = ""
    stalled: bool = False


@contextlib.contextmanager
def _quiet(folder: Path, limit: float, cpu_limit: float, simulating: bool = False) -> Iterator[_Said]:
    """Work in ``folder``, capture all output, and raise Ctrl-C after ``limit`` [s] or ``cpu_limit`` [s]."""
    said, out, err = _Said(), io.StringIO(), io.StringIO()
    before = Path.cwd()
    os.chdir(folder)
    try:
        with (
            tempfile.TemporaryFile() as native,
            _into(native.fileno()),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            try:
                with _alarm(limit, cpu_limit, simulating, said):
                    yield said
            finally:
                native.seek(0)
                said.output, said.errors = out.getvalue(), err.getvalue() + native.read().decode("utf-8", "replace")
    finally:
        os.chdir(before)


@contextlib.contextmanager
def _into(target: int) -> Iterator[None]:
    """Redirect file descriptors 1 and 2, which compiled libraries use directly, to ``target``."""
    kept = {number: os.dup(number) for number in (1, 2)}
    for number in kept:
        os.dup2(target, number)
    try:
        yield
    finally:
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)


@contextlib.contextmanager
def _alarm(limit: float, cpu_limit: float, simulating: bool, said: _Said) -> Iterator[None]:
    """Raise Ctrl-C after ``limit`` [s] or ``cpu_limit`` [s of processor time]; a stalled simulation gets more of both.

    If even that is not handled, log the stack and end the process.
    """
    begun = time.process_time()

    def ring(number: int, frame: Any) -> None:
        spent = time.process_time() - begun
        said.stalled = simulating and time.process_time() - max(begun, PROGRESS[1]) > 0.5 * cpu_limit
        if said.stalled and spent < STALLED_LIMIT:
            return
        said.rang_at = said.rang_at or traceback.extract_stack(frame)
        said.rang = said.rang or (f"{limit:g} s" if number == signal.SIGALRM else f"{cpu_limit:g} s of processor time")
        raise KeyboardInterrupt

    for number, timer, after in (
        (signal.SIGALRM, signal.ITIMER_REAL, limit),
        (signal.SIGPROF, signal.ITIMER_PROF, cpu_limit),
    ):
        signal.signal(number, ring)
        # Repeat every two seconds, in case the first signal was swallowed.
        signal.setitimer(timer, after, 2.0)
    last = 1.5 * limit + 1.0
    faulthandler.dump_traceback_later(last + (10.0 * STALLED_LIMIT if simulating else 0.0), exit=True, file=LOG)
    try:
        yield
    finally:
        for timer in (signal.ITIMER_REAL, signal.ITIMER_PROF):
            signal.setitimer(timer, 0.0)
        faulthandler.cancel_dump_traceback_later()


# Simulated time of the present run [s], and processor time at which it advanced last [s].
PROGRESS = [0.0, 0.0]


def _watch_progress() -> None:
    """Follow the simulated time of runs, independently of dynsim's own limit."""
    from dynsim.engine.stopping import WallWatch
    from dynsim.integrators.run import TIME

    spend = WallWatch.spend

    def watched(self: Any, run: Any) -> None:
        if run.clock[TIME] != PROGRESS[0]:
            PROGRESS[:] = run.clock[TIME], time.process_time()
        spend(self, run)

    WallWatch.spend = watched  # type: ignore[method-assign]


def _know_records(folder: Path) -> None:
    """Make this process read the valid records like its own, without a child process for each."""
    from dynsim.record import reader

    for path in folder.rglob("*.h5"):
        reader._written.add(path.read_bytes()[-65:-1].decode("ascii"))


def _load_everything(records: Path) -> None:
    """Load libraries and compiled kernels for all cases, before memory is limited and the clock runs."""
    import pinocchio  # noqa: F401

    from dynsim.engine import simulate
    from dynsim.scenario import load_scenario

    forget_commit()
    # Made from the signatures of all commands at every call, which takes as long as a short run.
    typer.main.get_command = cache(typer.main.get_command)
    _watch_progress()
    _know_records(records)
    for name in ("single_pendulum", "elbow_comparison", "snake_positioning"):
        simulate(load_scenario(name, None, {"duration_s": 0.01, "metrics.settle_s": 0}))


def bound_memory() -> None:
    """Limit memory, so that no input can exhaust the machine."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=Path, required=True, help="folder of the sound records")
    parser.add_argument("--folder", type=Path, required=True, help="empty folder to work in")
    parser.add_argument("--limit", type=float, required=True, help="of a command [s]")
    parser.add_argument("--broken", action="store_true", help="break the loaders first, see fuzz.broken")
    options = parser.parse_args()
    # Answers go to a copy of stdout, so that the output of a case cannot come between them.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    faulthandler.enable(LOG)
    _load_everything(options.records)
    if options.broken:
        broken.install()
    bound_memory()
    with contextlib.suppress(BrokenPipeError):
        print(READY, file=answers, flush=True)
        for line in sys.stdin:
            kind, seed, index = line.split()
            case = draw(kind, int(seed), int(index), options.records)
            # A separate name for every case, so that nothing read before can be mistaken for it.
            folder = options.folder / f"{kind}-{index}"
            folder.mkdir(parents=True)
            ended = run_case(case, folder, options.limit)
            print(json.dumps({**asdict(ended), "case": case.what}), file=answers, flush=True)
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
