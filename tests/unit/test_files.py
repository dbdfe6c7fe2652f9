"""Writing files: devices stay devices, links stay links, and groups of files are written all or none."""

import os
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from support.messages import check_message, raises

from dynsim.errors import RecordError
from dynsim.system import files
from dynsim.system.files import (
    INCOMPLETE,
    check_complete,
    check_writable,
    file_name,
    replace_together,
    replacing,
    write_text,
)

posix = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="POSIX")
PAIR = {"a.txt": b"new a", "b.txt": b"new b"}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@posix
@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "link"])
def test_what_is_no_file_is_refused_and_left(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    if kind == "pipe":
        os.mkfifo(kind)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(kind)
    else:
        Path(kind).symlink_to("/dev/null" if kind == "device" else "/dev/stdout")
    before = os.stat(kind)
    with raises(RecordError, kind):
        write_text(Path(kind), "x")
    assert os.path.samestat(os.stat(kind), before)
    assert os.listdir() == [kind]


@posix
@pytest.mark.parametrize("name", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"])
def test_standard_output_is_refused_also_where_it_is_a_file(tmp_path: Path, name: str):
    code = f"from pathlib import Path; from dynsim.system.files import write_text; write_text(Path({name!r}), 'x')"
    with (tmp_path / "output").open("wb") as output:
        ended = subprocess.run([sys.executable, "-c", code], stdout=output, stderr=subprocess.PIPE, timeout=60)
    check_message(ended.stderr.decode().splitlines()[-1], name)
    assert contents(tmp_path) == {"output": b""}


def test_a_folder_as_file_is_one_line(tmp_path: Path):
    (tmp_path / "folder").mkdir()
    with raises(RecordError, str(tmp_path / "folder")):
        write_text(tmp_path / "folder", "x")
    assert list(tmp_path.iterdir()) == [tmp_path / "folder"]


def test_a_link_is_kept_and_the_file_it_names_replaced(tmp_path: Path):
    (tmp_path / "there").mkdir()
    target = tmp_path / "there" / "file"
    target.write_text("old")
    (tmp_path / "one").symlink_to("there/file")
    (tmp_path / "two").symlink_to("one")
    (tmp_path / "dangling").symlink_to("there/new")
    for name in ("two", "dangling"):
        write_text(tmp_path / name, name)
        assert (tmp_path / name).is_symlink()
    assert contents(tmp_path / "there") == {"file": b"two", "new": b"dangling"}
    (tmp_path / "ring").symlink_to("ring")
    with raises(RecordError, "ring"):
        write_text(tmp_path / "ring", "x")


def test_no_link_in_the_way_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # Even one that has guessed the temporary name.
    monkeypatch.setattr(files.os, "urandom", bytes)
    (tmp_path / "victim").write_text("precious")
    for link in (".dynsim-0000000000000000.tmp", "file.tmp"):
        (tmp_path / link).symlink_to("victim")
    with raises(RecordError, "file", "File exists"):
        write_text(tmp_path / "file", "x")
    assert (tmp_path / "victim").read_text() == "precious"
    assert not (tmp_path / "file").exists()


@posix
def test_modes_follow_the_umask_and_those_of_existing_files_are_kept(tmp_path: Path):
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "new", "x")
        (tmp_path / "old").write_text("x")
        (tmp_path / "old").chmod(0o604)
        write_text(tmp_path / "old", "y")
        replace_together(tmp_path, PAIR)
    finally:
        os.umask(before)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert modes == {"new": 0o640, "old": 0o604, "a.txt": 0o640, "b.txt": 0o640}


def test_writers_of_the_same_file_do_not_share_a_temporary_name(tmp_path: Path):
    with replacing(tmp_path / "file") as first, replacing(tmp_path / "file") as other:
        first.write(b"one")
        other.write(b"other")
        assert len(list(tmp_path.iterdir())) == 2
    assert contents(tmp_path) == {"file": b"one"}


@posix
def test_what_dead_runs_left_is_removed_and_what_living_ones_write_is_not(tmp_path: Path):
    code = (
        "import os, signal, sys; from pathlib import Path; from dynsim.system.files import replacing\n"
        "with replacing(Path('file')): os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False, timeout=60)
    (left,) = tmp_path.iterdir()
    (tmp_path / "own.tmp").touch()
    with replacing(tmp_path / "file") as stream:
        (living,) = {*tmp_path.iterdir()} - {left, tmp_path / "own.tmp"}
        assert stream.writable()
        for path in (left, tmp_path / "own.tmp"):
            os.utime(path, (0, 0))
        write_text(tmp_path / "other", "x")
        assert living.exists()
    assert not left.exists()
    assert {path.name for path in tmp_path.iterdir()} == {"file", "other", "own.tmp"}


def test_several_files_come_all_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    old = {"a.txt": b"old a", "b.txt": b"old b"}
    replace_together(tmp_path, old)
    assert contents(tmp_path) == old
    calls = []

    def full(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) == 2:
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(files.os, "fsync", full)
        with raises(RecordError, "b.txt", "No space left on device"):
            replace_together(tmp_path, PAIR)
    assert contents(tmp_path) == old
    replace_together(tmp_path, PAIR)
    assert contents(tmp_path) == PAIR


KILLED = """
import os, signal, sys
from pathlib import Path
from dynsim.system import files

renames, replace = [], os.replace
def dying(source, target):
    if len(renames) == int(sys.argv[1]):
        os.kill(os.getpid(), signal.SIGKILL)
    renames.append(target)
    replace(source, target)
os.replace = dying
files.replace_together(Path("."), {"a.txt": b"new a", "b.txt": b"new b"})
"""


@posix
@pytest.mark.parametrize("renamed", [0, 1])
def test_a_run_killed_while_it_exchanges_files_leaves_a_mark_that_readers_heed(tmp_path: Path, renamed: int):
    replace_together(tmp_path, {"a.txt": b"old a", "b.txt": b"old b", "c.txt": b"c"})
    died = subprocess.run([sys.executable, "-c", KILLED, str(renamed)], cwd=tmp_path, check=False, timeout=60)
    assert died.returncode == -signal.SIGKILL
    for name in PAIR:
        with raises(RecordError, name, INCOMPLETE):
            check_complete(tmp_path / name)
    check_complete(tmp_path / "c.txt")
    # Of the two only one came again: the other is still in doubt.
    replace_together(tmp_path, {"a.txt": b"newer a"})
    check_complete(tmp_path / "a.txt")
    with raises(RecordError, "b.txt", INCOMPLETE):
        check_complete(tmp_path / "b.txt")
    replace_together(tmp_path, PAIR)
    check_complete(tmp_path / "b.txt")
    assert not (tmp_path / INCOMPLETE).exists()


def test_a_rename_that_fails_is_marked_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    replace_together(tmp_path, {"a.txt": b"old a", "b.txt": b"old b"})
    replace = os.replace

    def refuse(name: str):
        def rename(source: Path, target: Path) -> None:
            if target.name == name:
                raise PermissionError(1, "Operation not permitted")
            replace(source, target)

        return rename

    with monkeypatch.context() as patched:
        patched.setattr(files.os, "replace", refuse("a.txt"))
        with raises(RecordError, "a.txt", "Operation not permitted"):
            replace_together(tmp_path, PAIR)
    check_complete(tmp_path / "a.txt")
    with monkeypatch.context() as patched:
        patched.setattr(files.os, "replace", refuse("b.txt"))
        with raises(RecordError, "b.txt", "a.txt", INCOMPLETE):
            replace_together(tmp_path, PAIR)
    with raises(RecordError, "a.txt", INCOMPLETE):
        check_complete(tmp_path / "a.txt")


@posix
def test_two_runs_that_save_to_one_folder_do_not_mix(tmp_path: Path):
    code = (
        "import sys; from pathlib import Path; from dynsim.system.files import replace_together\n"
        "for _ in range(40): replace_together(Path('.'), dict.fromkeys('abc', sys.argv[1].encode()))"
    )
    children = [subprocess.Popen([sys.executable, "-c", code, who], cwd=tmp_path) for who in ("one", "two")]
    try:
        assert [child.wait(120) for child in children] == [0, 0]
    finally:
        for child in children:
            child.kill()
            child.wait()
    saved = contents(tmp_path)
    assert set(saved) == {"a", "b", "c"}
    assert len(set(saved.values())) == 1


def test_what_is_called_like_the_mark_but_is_none_stays(tmp_path: Path):
    (tmp_path / INCOMPLETE).write_text("a list of what I have still to do")
    with raises(RecordError, INCOMPLETE):
        replace_together(tmp_path, PAIR)
    assert contents(tmp_path) == {INCOMPLETE: b"a list of what I have still to do"}


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("two_elbows", "two_elbows"),
        ("../../x", "_.._x"),
        ("/etc/passwd", "_etc_passwd"),
        ("..", "unnamed"),
        ("", "unnamed"),
        ("a\0b\x1b[0m\n", "a_b_[0m_"),
        ("x" * 300, "x" * 120),
        (["no", "text"], "['no', 'text']"),
    ],
)
def test_no_text_makes_a_name_that_leads_elsewhere(text: object, name: str):
    assert file_name(text) == name


def test_a_folder_that_cannot_be_written_is_found_without_making_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    check_writable(tmp_path / "new" / "deep")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with raises(RecordError, str(tmp_path / "file"), str(tmp_path / "file" / "deep")):
        check_writable(tmp_path / "file" / "deep")
    with raises(RecordError, "x" * 300):
        check_writable(tmp_path / ("x" * 300) / "deep")
    # Root may write everywhere, so the answer is given here.
    monkeypatch.setattr("os.access", lambda *_: False)
    with raises(RecordError, str(tmp_path / "new"), str(tmp_path)):
        check_writable(tmp_path / "new")


def test_what_is_in_the_way_is_found_before_a_simulation(tmp_path: Path):
    (tmp_path / "gone").symlink_to(tmp_path / "unmounted" / "disk")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("gone", "loop"):
        with raises(RecordError, str(tmp_path / name), str(tmp_path / name / "out")):
            check_writable(tmp_path / name / "out")
    (tmp_path / "summary.json").mkdir()
    check_writable(tmp_path)
    with raises(RecordError, "summary.json"):
        check_writable(tmp_path, ["record.h5", "summary.json"])
    (tmp_path / "INCOMPLETE").mkdir()
    with raises(RecordError, INCOMPLETE):
        check_writable(tmp_path)


def test_two_files_of_a_run_cannot_be_one(tmp_path: Path):
    (tmp_path / "a").symlink_to(tmp_path / "one")
    (tmp_path / "b").symlink_to(tmp_path / "one")
    with raises(RecordError, "a, b"):
        replace_together(tmp_path, {"a": b"1", "b": b"2"})
    assert not (tmp_path / "one").exists()
