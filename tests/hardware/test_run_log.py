"""Log of a run written by a thread: control characters, a full disk, a blocked output, no thread to be had."""

import threading

import pytest

from dynsim.hardware.replay.output import Background, GrowingFile, RunLog


def opened(folder):
    """A log and its file."""
    log = RunLog()
    return log, GrowingFile("log", folder / "replay.log", log.pending)


def test_lines_reach_the_file_while_the_run_goes_on_and_no_terminal_obeys_them(tmp_path):
    log, file = opened(tmp_path)
    background = Background([file], interval=60.0)
    log.wake = background.wake
    for text in ("enter", "\x1b[31mgone\ud800"):
        log.write(1.0, "FAULT", text)
    assert background.close() == {}
    written = (tmp_path / "replay.log").read_text(encoding="utf-8").splitlines()
    assert written == log.lines
    assert [line.split(maxsplit=2)[-1] for line in written] == ["enter", r"\x1b[31mgone\ud800"]


def test_a_full_disk_ends_the_file_and_not_the_run(tmp_path, monkeypatch):
    log, file = opened(tmp_path)
    asked = []

    def full(data):
        asked.append(data)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(file, "append", full)
    background = Background([file], interval=0.001)
    log.write(1.0, "REPLAY", "one")
    while file.failure is None:
        background.wake()
    log.write(2.0, "FAULT", "two")
    assert background.close() == {"log": file.failure}
    assert len(asked) == 1
    assert len(log.lines) == 2


class Stuck:
    """An outlet that never comes back, as a disk that is gone or a terminal that is held."""

    name = "stuck"
    failure: Exception | None = None

    def __init__(self) -> None:
        self.entered, self.freed = threading.Event(), threading.Event()

    def pump(self) -> None:
        self.entered.set()
        self.freed.wait(60.0)

    def close(self) -> None:
        self.freed.wait(60.0)


def test_an_outlet_that_does_not_come_back_is_named_and_not_waited_for(tmp_path):
    stuck, (log, file) = Stuck(), opened(tmp_path)
    background = Background([file, stuck], interval=0.001)
    log.wake = background.wake
    assert stuck.entered.wait(60.0)
    log.write(1.0, "REPLAY", "one")  # waits for nobody
    failures = background.close(patience=0.01)
    assert set(failures) == {"stuck"}
    assert isinstance(failures["stuck"], TimeoutError)
    stuck.freed.set()
    background._thread.join(60.0)
    assert (tmp_path / "replay.log").read_text(encoding="utf-8").splitlines() == log.lines


def test_where_the_system_gives_no_thread_the_outlets_are_closed(tmp_path, monkeypatch):
    def none_left(_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", none_left)
    _, file = opened(tmp_path)
    with pytest.raises(RuntimeError):
        Background([file], interval=0.001)
    assert file._stream.closed
