"""A child process that runs fuzz cases and judges how each ends.

A case consists of damaged inputs and the dynsim commands that read them. The parent (:mod:`fuzz.campaign`) notices when
the child crashes. The child reads lines ``kind seed index`` and answers each with one line of JSON. Commands run in the
child, through the entry point of the console script.

A command must succeed, or refuse with one line that begins with ``error:`` (and indented continuation lines), exit code
2 or 3 and all files unchanged. Exceptions: ``hw replay`` may end with 1 to 4 and may write files in any case; a command
may save a partial result that it marks incomplete; a run beyond its time limit must stop on Ctrl-C. ``check`` and other
``hw`` commands must not change files even if they succeed. No temporary file remains; no signal of a run is infinite.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import io
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from support.messages import says

from fuzz import broken
from fuzz.case import SHIPPED, Draft, draw, put
from fuzz.inputs.sweep import forget_commit
from fuzz.readings import Unreadable

OK, REFUSED, INTERRUPTED = "ok", "refused", "interrupted"
TRACEBACK, HANG, CRASH, LOSS, MESSAGE, FILES, NUMBERS = (
    "traceback",
    "hang",
    "crash",
    "silent loss",
    "unclear error",
    "files changed",
    "not finite",
)
FAILURES = (TRACEBACK, HANG, CRASH, LOSS, MESSAGE, FILES, NUMBERS)
READY = "ready"
# Memory of a worker in addition to its memory after all imports [bytes].
MEMORY = 4 << 30
# A simulation may take long because of its input (stiff motors, for example). It must then stop on Ctrl-C [s].
SIMULATION_LIMIT = 20.0
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


def run_case(case: Draft, folder: Path, limit: float) -> Outcome:
    """Run all commands of a case in ``folder``; the first failure counts."""
    for name, data in case.files.items():
        put(folder / name, data)
    # Some scenarios refer to it.
    shutil.copytree(SHIPPED / "robots", folder / "robots")
    ended = Outcome(OK)
    for command in case.commands:
        before = _snapshot(folder)
        ended = _run_command(command, folder, SIMULATION_LIMIT if command[0] == "run" else limit)
        if ended.outcome in FAILURES:
            return ended
        after = _snapshot(folder)
        replays = command[:2] == ["hw", "replay"]
        reads_only = (
            (ended.outcome != OK and not replays) or command[0] == "check" or (command[0] == "hw" and not replays)
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
    if case.losses is not None:
        lost = _losses(case, folder, limit)
        if lost.outcome in FAILURES:
            return lost
        ended.compared = lost.compared
    return ended


def _not_finite(path: Path) -> str:
    """Return the first signal of a successful run with a value that is not finite, except signals that may have one."""
    import numpy as np

    from dynsim.record import Record

    record = Record.load(path)
    return next((name for name in record if np.isinf(record[name]).any()), "")


def _run_command(command: list[str], folder: Path, limit: float) -> Outcome:
    from dynsim.cli import main

    argv, sys.argv = sys.argv, ["dynsim", *command]
    code: Any = 0
    with _quiet(folder, limit) as said:
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
        if command[0] == "run" and code == 130 and says(said.errors, "interrupted"):
            return Outcome(INTERRUPTED, detail=said.errors)
        return Outcome(HANG, f"{command[0]} takes more than {limit:g} s", _place(said.rang_at), said.errors[-500:])
    return _judge(command, 0 if code is None else code, said.output, said.errors)


def _judge(command: list[str], code: Any, out: str, err: str) -> Outcome:
    """Check exit code and output of a command against the rules."""
    lines = err.splitlines()
    errors = [line for line in lines if line.startswith("error:")]
    verdict = Outcome(OK if code == 0 else REFUSED, detail=err[-2000:])
    wrong = ""
    if "Traceback (most recent call last)" in out + err:
        return Outcome(TRACEBACK, "a traceback was printed", _last_place(err), err[-2000:])
    if strange := sorted({sign for sign in out + err if _is_control(sign)}):
        wrong = f"control characters {strange!r} reach the terminal"
    elif code == 0 and errors:
        wrong = "an error with exit code 0"
    elif code != 0 and code not in ((1, 2, 3, 4) if command[:2] == ["hw", "replay"] else (2, 3)):
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


def _loose(lines: list[str], after: str) -> list[str]:
    """Return lines other than the error, its continuation, warnings and the note about a saved part."""
    loose = []
    warned = False
    for line in lines:
        if line == after or line.startswith(" ") or says(line, "saved part") or not line.strip():
            continue
        warned = warned or "Warning: " in line or line.startswith("warning: ")
        if not warned:
            loose.append(line)
    return loose


def _losses(case: Draft, folder: Path, limit: float) -> Outcome:
    from dynsim.errors import DynsimError

    assert case.losses is not None
    with _quiet(folder, limit) as said:
        warnings.simplefilter("ignore")
        try:
            lost = case.losses()
        except (DynsimError, MemoryError, KeyboardInterrupt, Unreadable):
            return Outcome(OK) if not said.rang_at else _late(said, limit)
        except BaseException as error:
            return _traceback(error)
    if said.rang_at:
        return _late(said, limit)
    return Outcome(LOSS, _class_of(lost[0]), "", "; ".join(lost)[:500]) if lost else Outcome(OK, compared=True)


def _late(said: _Said, limit: float) -> Outcome:
    assert said.rang_at is not None
    return Outcome(HANG, f"reading takes more than {limit:g} s", _place(said.rang_at))


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


@contextlib.contextmanager
def _quiet(folder: Path, limit: float) -> Iterator[_Said]:
    """Work in ``folder``, capture all output, and raise Ctrl-C after ``limit`` [s]."""
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
                with _alarm(limit, said):
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
def _alarm(limit: float, said: _Said) -> Iterator[None]:
    """Raise Ctrl-C after ``limit`` [s]; if even that is not handled, log the stack and end the process."""

    def ring(number: int, frame: Any) -> None:
        said.rang_at = said.rang_at or traceback.extract_stack(frame)
        raise KeyboardInterrupt

    signal.signal(signal.SIGALRM, ring)
    # Repeat every two seconds, in case the first signal was swallowed.
    signal.setitimer(signal.ITIMER_REAL, limit, 2.0)
    faulthandler.dump_traceback_later(1.5 * limit + 1.0, exit=True, file=LOG)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        faulthandler.cancel_dump_traceback_later()


def _load_everything(records: Path) -> None:
    """Load libraries and compiled kernels for all cases, before memory is limited and the clock runs."""
    import pinocchio  # noqa: F401

    from dynsim.engine import simulate
    from dynsim.scenario import load_scenario

    forget_commit()
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
