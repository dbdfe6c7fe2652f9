"""Postponement of signals in callbacks of the compiler, where an exception would crash the process."""

from __future__ import annotations

import signal

import pytest
from llvmlite.binding import ExecutionEngine

from dynsim.system import interruption


@pytest.fixture(autouse=True)
def interruptible():
    """Python's handler of SIGINT, which background processes of a shell and their children ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def _raw_object_cache_getbuffer() -> str:
    """Has the name of llvmlite's function that LLVM calls for compiled code from the cache."""
    return deeper()


def deeper() -> str:
    signal.raise_signal(signal.SIGINT)
    return "went on"


def test_a_signal_within_a_callback_of_the_compiler_waits():
    """Raised there, it is lost, and LLVM goes on without the code that it has asked for: a segmentation fault."""
    with interruption.handled() as received:
        assert _raw_object_cache_getbuffer() == "went on"
        assert received == [signal.SIGINT]
        with pytest.raises(KeyboardInterrupt):
            interruption.check()


def test_elsewhere_it_does_not():
    with interruption.handled(), pytest.raises(KeyboardInterrupt):
        deeper()


def test_the_compiler_has_these_callbacks():
    assert interruption._OF_THE_COMPILER
    assert all(hasattr(ExecutionEngine, name) for name in interruption._OF_THE_COMPILER)
