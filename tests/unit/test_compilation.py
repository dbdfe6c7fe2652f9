"""Messages about kernel compilation: in the log, on a terminal, and from worker processes."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from support.messages import check_message, lines_with

from dynsim.engine import compilation
from dynsim.jit import kernel as jit

log = logging.getLogger("dynsim.test")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for kernels."""
    kernels = tmp_path / "kernels"
    kernels.mkdir()
    for module in (jit, compilation):
        monkeypatch.setattr(module, "cache_folder", lambda: kernels)
    return kernels


def _double() -> int:
    """3 doubled, by a kernel that is not loaded yet."""

    @jit.kernel
    def double(x):  # type: ignore[no-untyped-def]
        return 2 * x

    return int(double(3))


def test_the_log_says_what_why_and_how_long(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "dynsim")
    for _ in range(2):
        with compilation.kernels_logged(log, "arms by radau5"):
            assert _double() == 6
    first, done, loaded = [entry.getMessage() for entry in caplog.records]
    check_message(first, "arms by radau5", "dynsim", "numba", "numpy", phrase="takes")
    check_message(done, re.compile(r" \d+\.\d s"))
    check_message(loaded, re.compile(r" \d+\.\d s"))
    # Again, with a time of this kind to go by; that of another kind says nothing, nor does a file that is damaged.
    lost = folder / "other.kernel"
    for content, names in (
        ('{"wheels": 43, "arms by radau5": 2}', ["43 s"]),
        ('{"arms by radau5": 43}', []),
        ('["wheels"]', []),
        ("43", []),
        ("", []),
    ):
        caplog.clear()
        (folder.parent / compilation.LAST).write_text(content)
        for kernel in folder.glob("*.kernel"):
            kernel.rename(lost)
        with compilation.kernels_logged(log, "wheels", loads=False):
            _double()
        check_message(caplog.records[0].getMessage(), *names, phrase="" if names else "takes")
    known = json.loads((folder.parent / compilation.LAST).read_text())
    assert known.keys() == {"wheels"}
    caplog.clear()
    for kernel in folder.glob("*.kernel"):
        kernel.rename(lost)
    (folder.parent / compilation.LAST).write_text('{"": 43}')
    with compilation.kernels_logged(log, loads=False):
        _double()
    check_message(caplog.records[0].getMessage(), "dynsim", "43 s")
    caplog.clear()
    with compilation.kernels_logged(log, loads=False):
        _double()
    assert not caplog.records
    assert not list(folder.glob(f"*{compilation.MARK}"))


@pytest.mark.parametrize("shown", [True, False])
def test_a_terminal_says_what_is_compiled(folder: Path, monkeypatch: pytest.MonkeyPatch, shown: bool) -> None:
    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(compilation, "_on_terminal", shown)
    with compilation.kernels_logged(log):
        _double()
    text = terminal.getvalue()
    if shown:
        assert lines_with(text, "dynsim", "numba", "numpy", phrase="takes")
        assert text.endswith(" s\n")
    else:
        assert not text


def test_a_display_sees_what_other_processes_compile(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mark of a living process of the group; those of dead ones and of other groups are no compilation."""
    monkeypatch.setattr(compilation, "_on_terminal", True)
    monkeypatch.setattr(compilation, "LOOK_S", 0.01)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as worker:
        seen, over = threading.Event(), threading.Event()
        compiled: list[compilation.Compilation] = []

        def show(now: compilation.Compilation | None) -> None:
            if now is None:
                over.set()
            else:
                compiled.append(now)
                seen.set()

        mark = folder / f"{worker.pid}{compilation.MARK}"
        content = [os.getpgrp(), "compiling the kernels for wheels", 1.0, None]
        with compilation.watched(show):
            (folder / f"999999999{compilation.MARK}").write_text(json.dumps(content))
            (folder / f"{os.getpid()}{compilation.MARK}").write_text(json.dumps([os.getpgrp() + 1, *content[1:]]))
            assert compilation.under_way() is None
            mark.write_text(json.dumps(content))
            assert seen.wait(20)
            mark.unlink()
            assert over.wait(20)
        worker.communicate(b"\n")
    assert compiled[0].text == "compiling the kernels for wheels"
    assert compiled[0].elapsed > 1.0
