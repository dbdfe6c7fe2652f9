"""Fixtures of all tests: seeded random examples, and records that are simulated once per session."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import pytest
from hypothesis import settings

# Each worker has a core: threads of numpy's libraries would wait for each other, longer than small matrices take.
# Set before anything loads numpy, and for the workers and their child processes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from support import programs

from dynsim.engine import simulate
from dynsim.record import Record
from dynsim.scenario import load_scenario

# The same examples in every run; compiling kernels is not a slow example.
settings.register_profile("seeded", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("seeded")


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> None:
    programs.compile_share(len(session.items))


@cache
def _simulated(name: str, variant: str | None) -> Record:
    return simulate(load_scenario(name, variant))


@pytest.fixture(scope="session")
def simulated() -> Callable[[str, str | None], Record]:
    """Record of a shipped scenario and variant, simulated once per session."""
    return _simulated


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium of the system; Playwright drives it and downloads nothing."""
    executable = shutil.which("chromium")
    if executable is None:
        pytest.skip("no chromium here: apt-get install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright here: pip install playwright")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(
            executable_path=executable, args=["--no-sandbox", "--enable-unsafe-swiftshader"], timeout=180_000
        )
        yield started
        started.close()


@pytest.fixture
def hang_ups() -> Iterator[None]:
    """Restore the default SIGHUP handling, also for child processes: ``nohup`` would let them ignore it."""
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, inherited)
