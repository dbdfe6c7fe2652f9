"""Signals wait where raising for them would crash the process."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from llvmlite.binding import ExecutionEngine

from dynsim.system import interruption


@pytest.fixture(autouse=True)
def interruptible():
    """Background processes of a shell ignore the signal, and what is ignored stays so."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def _raw_object_cache_getbuffer() -> str:
    """Named as llvmlite's: what LLVM calls when it wants compiled code from the cache."""
    return deeper()


def deeper() -> str:
    signal.raise_signal(signal.SIGINT)
    return "went on"


def test_a_signal_within_a_callback_of_the_compiler_waits():
    """Raised there, it is lost, and LLVM goes on without the code that it has asked for: a segmentation fault."""
    with interruption.heeded() as received:
        assert _raw_object_cache_getbuffer() == "went on"
        assert received == [signal.SIGINT]
        with pytest.raises(KeyboardInterrupt):
            interruption.check()


def test_elsewhere_it_does_not():
    with interruption.heeded(), pytest.raises(KeyboardInterrupt):
        deeper()


def test_the_compiler_has_these_callbacks():
    assert interruption._OF_THE_COMPILER
    assert all(hasattr(ExecutionEngine, name) for name in interruption._OF_THE_COMPILER)


EARLY = """
import signal
from multiprocessing import forkserver
from pathlib import Path
from dynsim.studies.processes import begin_early

begin_early("json")
status = Path(f"/proc/{forkserver._forkserver._forkserver_pid}/status").read_text()
blocked = int(next(line for line in status.splitlines() if line.startswith("SigBlk")).split()[1], 16)
print(bool(blocked >> (signal.SIGINT - 1) & 1))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only there processes begin early")
def test_ctrl_c_does_not_reach_a_process_that_is_begun_early() -> None:
    """Python's resource tracker, started on the way, lets SIGINT through again for whoever starts it."""
    done = subprocess.run([sys.executable, "-c", EARLY], capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["True"], done.stderr
