"""The log of a replay must not keep the robot from being stopped."""

from dynsim.hardware.replay.run_log import RunLog
from dynsim.hardware.replay.stream import Background


def test_lines_reach_the_file_while_the_run_goes_on_and_no_terminal_obeys_them(tmp_path):
    log = RunLog(tmp_path / "replay.log")
    background = Background([log], interval=60.0)
    log.wake = background.wake
    for text in ("enter", "\x1b[31mgone\ud800"):
        log.write(1.0, "FAULT", text)
    assert background.close() == {}
    written = (tmp_path / "replay.log").read_text(encoding="utf-8").splitlines()
    assert written == log.lines
    assert [line.split(maxsplit=2)[-1] for line in written] == ["enter", r"\x1b[31mgone\ud800"]


def test_a_full_disk_ends_the_file_and_not_the_run(tmp_path, monkeypatch):
    log = RunLog(tmp_path / "replay.log")
    asked = []

    def full(data):
        asked.append(data)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(log._file, "append", full)
    background = Background([log], interval=0.001)
    log.write(1.0, "REPLAY", "one")
    while log.failure is None:
        background.wake()
    log.write(2.0, "FAULT", "two")
    assert background.close() == {"log": log.failure}
    assert len(asked) == 1
    assert len(log.lines) == 2
