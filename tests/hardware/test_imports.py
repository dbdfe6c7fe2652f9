"""Modules that imports must not load: serial and servo modules by the commands, simulation by replay and ports."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        # `dynsim run` mounts the commands: no serial port, no servo.
        ("dynsim.cli.entry", ("serial", "dynamixel_sdk", "dynsim.hardware.ports", "numba", "matplotlib", "logging")),
        ("dynsim.cli.hardware", ("serial", "dynamixel_sdk", "dynsim.hardware.ports", "numba", "matplotlib")),
        # Replaying knows nothing of how a record was made, nor of what is on the bus.
        (
            "dynsim.hardware.replay.session",
            ("numba", "dynsim.dynamics", "dynsim.model", "dynsim.scenario", "matplotlib", "dynsim.hardware.virtual"),
        ),
        ("dynsim.hardware.ports", ("numba", "dynsim.dynamics", "dynsim.model", "dynsim.scenario", "matplotlib")),
    ],
)
def test_imports_stay_in_their_layer(module: str, absent: tuple[str, ...]) -> None:
    code = f"import {module}, sys; print([name for name in {absent!r} if name in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert answer.stdout.strip() == "[]"
