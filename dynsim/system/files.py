"""Functions that write files atomically, mark incomplete sets of files, and lock folders.

A file is written next to its target under a name that no other process uses, and renamed when it is complete. Devices,
pipes and sockets are therefore rejected as targets. While a set of files that belong together is being replaced, a file
``INCOMPLETE`` marks their folder.
"""

from __future__ import annotations

import json
import os
import re
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from dynsim.errors import RecordError

try:
    import fcntl
except ImportError:  # Windows has no fcntl; there, two processes should not write to the same folder at the same time
    fcntl = None  # type: ignore[assignment]

INCOMPLETE = "INCOMPLETE"
"""Name of the file that marks a folder while files that belong together are being replaced in it."""
_MARK = (
    "Files of this folder are being exchanged, or a run died while it exchanged them: they may be of different runs."
)
_LEFT_BEHIND = 86_400.0
"""Age [s] from which a temporary file was left by a dead process: a living one writes to its file more often."""
_STREAM = re.compile(r"/dev/(stdin|stdout|stderr|fd/.*)|/proc/.*")
"""Paths that stand for open descriptors of a process: they may refer to a file, but cannot be replaced."""
_NAME_LENGTH = 120
"""Maximum length of a file name that is made from a text [characters]; file systems allow 255 bytes."""


def check_writable(folder: Path, names: Iterable[str] = ()) -> None:
    """Check, before a long simulation, that the files ``names`` can be written to a folder; do not create anything.

    Raises
    ------
    RecordError
        If something else exists at a path that is needed, or a permission is missing.
    """
    try:
        existing = folder.absolute()
        while not existing.exists():
            if existing.is_symlink():
                raise RecordError(f"cannot write to {folder}: {existing} is a broken link")
            existing = existing.parent
        mark = folder / INCOMPLETE
        blocked = [name for name in names if (folder / name).exists() and not (folder / name).is_file()]
        if blocked or (mark.exists() and not mark.is_file()):
            raise RecordError(f"cannot write to {folder}: {(*blocked, INCOMPLETE)[0]} in it is not a file; remove it")
    except FileNotFoundError as error:  # only absolute() raises that
        raise RecordError("the working directory no longer exists; change to another folder") from error
    except (OSError, ValueError) as error:
        raise RecordError(f"cannot write to {folder}: {_reason(error)}") from error
    if not existing.is_dir():
        raise RecordError(f"cannot write to {folder}: {existing} is a file, not a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise RecordError(f"cannot write to {folder}: no permission to write in {existing}")


@contextmanager
def held_folder(folder: Path) -> Iterator[None]:
    """Create a folder if needed, and lock it during the block if the file system and operating system support locks.

    Raises
    ------
    RecordError
        If another process has locked the folder, or the folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = None if fcntl is None else os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise RecordError(f"cannot write to {folder}: {_reason(error)}") from error
    if descriptor is None:
        yield
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RecordError(
                f"{folder}: another process is using this folder; wait until it ends, or choose another --out"
            ) from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(descriptor)


def discard(folder: Path, patterns: Iterable[str]) -> None:
    """Delete all files in a folder that match one of the patterns; skip files that cannot be deleted."""
    for pattern in patterns:
        for path in folder.glob(pattern):
            with suppress(OSError):
                path.unlink()


def file_name(text: object) -> str:
    """Return a safe name for a file or folder, made from any text; the name cannot point to another folder."""
    name = "".join(c if c.isprintable() and c not in '/\\:*?"<>|' else "_" for c in str(text))
    return name.strip(". ")[:_NAME_LENGTH] or "unnamed"


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[BinaryIO]:
    """Provide a stream whose content replaces the file ``path`` if the block ends without an exception.

    If ``path`` is a link, the link is kept and its target is replaced. A new file gets the permissions set by the
    umask; a replaced file keeps its permissions.

    Parameters
    ----------
    path : Path
        File to write.
    durable : bool, optional
        Wait until the content is on the disk, so that either the old or the new file exists even after a power failure.

    Raises
    ------
    RecordError
        If ``path`` is not a regular file or cannot be written (no space, no permission). An existing file is not
        changed then.
    """
    with _draft(path) as draft:
        yield draft.stream
        draft.complete(durable)
        draft.publish()


def replace_together(folder: Path, contents: Mapping[str, bytes | memoryview]) -> None:
    """Write a set of files that belong together, either all of them or none; ``contents`` maps names to contents.

    All files are complete on disk before the first one is renamed. While they are being renamed, a file ``INCOMPLETE``
    in the folder lists them, so that :func:`check_complete` rejects them if the process dies in the meantime.

    Raises
    ------
    RecordError
        If a file cannot be written. Existing files are not changed, unless the message says that the folder is marked.
    """
    places = {os.path.realpath(folder / name) for name in contents}
    if len(places) < len(contents):
        raise RecordError(f"cannot write to {folder}: two of {', '.join(contents)} are links to the same file")
    with ExitStack() as open_drafts:
        drafts = [open_drafts.enter_context(_draft(folder / name)) for name in contents]
        for draft, content in zip(drafts, contents.values(), strict=True):
            with _one_line_errors(draft.path):
                draft.stream.write(content)
                draft.complete(durable=True)
        with _marked(folder, contents) as published:
            for draft in drafts:
                with _one_line_errors(draft.path):
                    draft.publish()
                published.append(draft.path)


def check_complete(path: Path) -> None:
    """Reject a file that may not belong to the same run as other files in its folder, see :func:`replace_together`.

    Raises
    ------
    RecordError
        If the folder is marked as incomplete and the mark lists the file.
    """
    mark = path.parent / INCOMPLETE
    try:
        if not mark.is_file():
            return
        names = _marked_names(mark.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        names = None
    if names is None or path.name in names:
        raise RecordError(
            f"{path}: may belong to a different run than the other files in its folder: {mark} shows that a run is "
            "replacing them or died while doing so; run it again, or delete this mark to use the files as they are"
        )


def write_text(path: Path, text: str) -> Path:
    """Write a text file atomically, see :func:`replacing`.

    Raises
    ------
    RecordError
        If the file cannot be written. An existing file is not changed then.
    """
    with replacing(path) as stream:
        stream.write(text.encode("utf-8"))
    return path


def write_json(path: Path, data: Any) -> Path:
    """Write data to a JSON file, see :func:`write_text`."""
    return write_text(path, json_text(data))


def json_text(data: Any) -> str:
    """Return data as JSON text, in the layout of all JSON files that dynsim writes."""
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"


@contextmanager
def _one_line_errors(path: Path) -> Iterator[None]:
    """Convert OSError to RecordError."""
    try:
        yield
    except (OSError, UnicodeEncodeError) as error:
        raise RecordError(f"cannot write {path}: {_reason(error)}; nothing was changed there") from error


@dataclass(frozen=True)
class _Draft:
    """Draft of the file ``path``: a temporary file that is renamed to ``target`` when it is complete."""

    path: Path
    target: Path
    temporary: Path
    stream: BinaryIO

    def complete(self, durable: bool) -> None:
        """Flush the complete content to the operating system and, if ``durable``, to the disk."""
        self.stream.flush()
        if durable:
            os.fsync(self.stream.fileno())

    def publish(self) -> None:
        """Replace the file at the path with the new content."""
        if not hasattr(os, "fchmod"):
            self.stream.close()  # Windows cannot rename an open file
        os.replace(self.temporary, self.target)


@contextmanager
def _draft(path: Path) -> Iterator[_Draft]:
    """Provide a temporary file next to a file; errors name the file. It is removed unless the block publishes it."""
    with _one_line_errors(path):
        existing = _existing(path)
        target = Path(os.path.realpath(path))
        if existing is not None and not os.access(target, os.W_OK):
            raise PermissionError(0, "the file is write-protected")
        _remove_left_behind(target.parent)
        # Only this process uses the name: the file must not exist, and a link of that name is not followed.
        temporary = target.with_name(f".dynsim-{os.urandom(8).hex()}.tmp")
        stream = temporary.open("x+b")
        try:
            if existing is not None:
                _take_over(stream.fileno(), existing)
            yield _Draft(path, target, temporary, stream)
        finally:
            with suppress(OSError):
                stream.close()
            with suppress(OSError):
                temporary.unlink()


def _existing(path: Path) -> os.stat_result | None:
    """Return the status of the existing file at a path; raise OSError if it is not a regular file."""
    if "\0" in os.fspath(path):
        raise OSError(0, "is not a path: it contains a null character")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        existing: os.stat_result | None = os.stat(path)
    except FileNotFoundError:
        existing = None
    if existing is not None and stat.S_ISDIR(existing.st_mode):
        raise IsADirectoryError(0, "is a folder, not a file")
    names = [os.fspath(path), *([os.readlink(path)] if path.is_symlink() else ())]
    if (existing is not None and not stat.S_ISREG(existing.st_mode)) or any(map(_STREAM.fullmatch, names)):
        raise OSError(0, "is a device, pipe or socket; write to a file and copy it there")
    return existing


def _take_over(descriptor: int, existing: os.stat_result) -> None:
    """Give a file owner and mode of the file that it replaces."""
    if hasattr(os, "fchmod"):
        with suppress(OSError):  # only root may change the owner; otherwise the file remains ours
            if (existing.st_uid, existing.st_gid) != (os.geteuid(), os.getegid()):
                os.fchown(descriptor, existing.st_uid, existing.st_gid)
        with suppress(OSError):  # a file system without modes
            os.fchmod(descriptor, stat.S_IMODE(existing.st_mode))


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


def lock(descriptor: int, *, wait: bool) -> bool:
    """Lock a file until it is closed; return False if another process has locked it."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return wait
    return True


def _remove_left_behind(folder: Path) -> None:
    """Remove temporary files that were left behind by processes that died."""
    for path in folder.glob(".dynsim-*.tmp"):
        with suppress(OSError):
            if time.time() - path.lstat().st_mtime > _LEFT_BEHIND:
                path.unlink()


@contextmanager
def _marked(folder: Path, names: Mapping[str, object]) -> Iterator[list[Path]]:
    """Mark a folder as incomplete because of the files ``names``; yield a list to which replaced files are added.

    The mark is removed if the block succeeds, or if it fails before it has replaced a file. Only one process at a time
    can hold the mark; other processes wait. The mark and the renamed files are not synced to the disk, because
    journaling file systems preserve their order. An empty mark covers all files.
    """
    mark = folder / INCOMPLETE
    published: list[Path] = []
    with _one_line_errors(mark):
        stream, before = _open_mark(mark)
    with stream:
        try:
            with _one_line_errors(mark):
                _rewrite_mark(stream, before | set(names))
            yield published
        except BaseException as error:
            if not published:
                with suppress(OSError):
                    _remove_mark(mark, stream, before)
            elif isinstance(error, RecordError):
                done = ", ".join(path.name for path in published)
                raise RecordError(f"{error}; {done} already replaced, so {folder} is marked {INCOMPLETE}") from error
            raise
        try:
            _remove_mark(mark, stream, before - set(names))
        except OSError as error:
            raise RecordError(f"{mark}: cannot be removed ({_reason(error)}); the other files are complete") from error


def _remove_mark(mark: Path, stream: BinaryIO, left: set[str]) -> None:
    """Remove the mark, unless it still lists files that other processes were replacing when they died."""
    if left:
        _rewrite_mark(stream, left)
        return
    if fcntl is None:
        stream.close()  # Windows cannot remove an open file
    mark.unlink()


def _open_mark(mark: Path) -> tuple[BinaryIO, set[str]]:
    """Open the mark and lock it for this process; return its stream and the names that it lists."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    while True:
        stream = os.fdopen(os.open(mark, flags | getattr(os, "O_NONBLOCK", 0), 0o666), "r+b", buffering=0)
        try:
            lock(stream.fileno(), wait=True)
            status = os.fstat(stream.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise OSError(0, "this path is not a regular file; remove it")
            with suppress(FileNotFoundError):
                if os.path.samestat(status, os.lstat(mark)):
                    text = stream.read().decode("utf-8", errors="replace")
                    if text and not text.startswith(_MARK):
                        raise OSError(0, "the existing file was not written by dynsim; move it")
                    return stream, _marked_names(text) or set()
            # Another process has finished and removed the mark in the meantime; try again.
            stream.close()
        except BaseException:
            stream.close()
            raise


def _rewrite_mark(stream: BinaryIO, names: set[str]) -> None:
    stream.seek(0)
    stream.truncate()
    stream.write("\n".join([_MARK, *sorted(names), ""]).encode("utf-8"))


def _marked_names(text: str) -> set[str] | None:
    """Return the files that a mark lists; None if it lists no files, in which case it covers all files."""
    return set(text.splitlines()[1:]) or None
