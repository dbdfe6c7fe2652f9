"""The log of a replay must not keep the robot from being stopped."""

from pathlib import Path

import pytest

from dynsim.hardware.replay.run_log import RunLog


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_ends_the_file_and_not_the_run():
    with RunLog(Path("/dev/full")) as log:
        for text in ("enter", "\x1b[31mgone\ud800"):
            log.write(1.0, "FAULT", text)
    assert [line.split(maxsplit=2)[-1] for line in log.lines] == [
        "enter", "could not be written on: No space left on device", r"\x1b[31mgone\ud800",
    ]  # fmt: skip
