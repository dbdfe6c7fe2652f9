"""Clocks that are set, and slow or dead disks, of processes that tests start; blocked pipes."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

WORLDS = {
    # The wall clock is set by hours, every 50 readings on average.
    "clock": """
import random, time
real, draw, shift = time.time, random.Random(3), [0.0]
def jumping():
    if draw.random() < 0.02:
        shift[0] = draw.uniform(-3e4, 3e4)
    return real() + shift[0]
time.time = jumping
""",
    # The disk needs a second to store anything.
    "slow disk": """
import os, time
real = os.fsync
def slow(descriptor):
    time.sleep(1.0)
    real(descriptor)
os.fsync = slow
""",
    # The disk stores nothing during the motion.
    "dead disk": """
import os, threading, time
real = os.fsync
def never(descriptor):
    if threading.current_thread() is not threading.main_thread():
        time.sleep(1e6)
    real(descriptor)
os.fsync = never
""",
}


def disturb(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each Python process that is started from now on the clock or disk of this name."""
    (folder / name).mkdir()
    (folder / name / "sitecustomize.py").write_text(WORLDS[name], encoding="utf-8")
    path = [str(folder / name), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path).rstrip(os.pathsep))


def fill(reader: int) -> None:
    """Fill a pipe, so that the next write to it waits."""
    writer = os.open(f"/proc/self/fd/{reader}", os.O_WRONLY | os.O_NONBLOCK)
    try:
        while True:
            os.write(writer, b"x")
    except BlockingIOError:
        os.close(writer)


def press_until_it_ends(process: subprocess.Popen[str] | subprocess.Popen[bytes]) -> int:
    """Press Ctrl-C, and again if the program was still busy with the robot; return the exit code."""
    for _ in range(10):
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        end = time.monotonic() + 3.0
        while time.monotonic() < end and process.poll() is None:
            time.sleep(0.02)
    return process.wait(0.1)
