"""Atomic writing of files, marking of incomplete sets of files, and locks of folders.

A file is written beside its target under a name that no other process has, and renamed when it is complete. So devices,
pipes and sockets are refused. While files that belong together are exchanged, a file ``INCOMPLETE`` marks their folder.
"""

from __future__ import annotations

import json
import os
import re
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from dynsim.errors import RecordError

try:
    import fcntl
except ImportError:  # not on Windows: then no two processes should write to one folder at the same time
    fcntl = None  # type: ignore[assignment]

INCOMPLETE = "INCOMPLETE"
"""Name of the file that marks a folder while files that belong together are being exchanged in it."""
_MARK = (
    "Files of this folder are being exchanged, or a run died while it exchanged them: they may be of different runs."
)
_TEMPORARY = re.compile(r"\.dynsim-[0-9a-f]{16}\.tmp")
_LEFT_BEHIND = 60.0
"""An unlocked temporary file older than this [s] was left by a process that died; younger ones may not be locked
yet."""
_STREAM = re.compile(r"/dev/(stdin|stdout|stderr|fd/.*)|/proc/.*")
"""Names of open descriptors of a process: they may be files, but cannot be replaced."""
_NAME_LENGTH = 120
"""Of a file name made from a text [characters]; file systems end at 255 bytes."""


def check_writable(folder: Path, names: Iterable[str] = ()) -> None:
    """Find out before a long simulation whether its files, by name, can be written to a folder; creates nothing.

    Raises
    ------
    RecordError
        A file is in the way, or there is no permission.
    """
    try:
        existing = folder.absolute()
        while not existing.exists():
            if existing.is_symlink():
                raise RecordError(f"cannot write to {folder}: {existing} is a link to nothing")
            existing = existing.parent
        mark = folder / INCOMPLETE
        blocked = [name for name in names if (folder / name).exists() and not (folder / name).is_file()]
        if blocked or (mark.exists() and not mark.is_file()):
            raise RecordError(f"cannot write to {folder}: {(*blocked, INCOMPLETE)[0]} there is in the way; remove it")
    except FileNotFoundError as error:  # only absolute() raises that
        raise RecordError("the working directory is no longer there; change to another folder") from error
    except (OSError, ValueError) as error:
        raise RecordError(f"cannot write to {folder}: {_reason(error)}") from error
    if not existing.is_dir():
        raise RecordError(f"cannot write to {folder}: {existing} is a file, not a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise RecordError(f"cannot write to {folder}: no permission to write in {existing}")


@contextmanager
def held_folder(folder: Path) -> Iterator[None]:
    """Make a folder, if need be; within, no other process holds it. File systems without locks, and Windows, let it.

    Raises
    ------
    RecordError
        Another process holds it, or it cannot be made.
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
                f"{folder}: another process is at work there; wait until it ends, or give another --out"
            ) from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(descriptor)


def discard(folder: Path, patterns: Iterable[str]) -> None:
    """Delete the files of a folder that match, if there are any; what cannot be deleted stays."""
    for pattern in patterns:
        for path in folder.glob(pattern):
            with suppress(OSError):
                path.unlink()


def file_name(text: object) -> str:
    """A name for a file or folder made of a text from anywhere: one that cannot lead to another folder."""
    name = "".join(c if c.isprintable() and c not in '/\\:*?"<>|' else "_" for c in str(text))
    return name.strip(". ")[:_NAME_LENGTH] or "unnamed"


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[BinaryIO]:
    """A stream whose content becomes the file ``path`` when the block ends well.

    A link at ``path`` is kept and the file it names replaced. A new file gets the mode that the umask asks for, a
    replaced one keeps its own.

    Parameters
    ----------
    durable : wait until the content is on the disk, so that a power cut, too, leaves the old file or the new one

    Raises
    ------
    RecordError
        ``path`` is no file, or cannot be written (no space, no permission); an older file there is left as it was.
    """
    with _Draft(path) as draft:
        yield draft.stream
        draft.complete(durable)
        draft.publish()


def replace_together(folder: Path, contents: Mapping[str, bytes | memoryview]) -> None:
    """Write files, by name, that belong together: all of them or none.

    All are complete on disk before the first is renamed, and while they are renamed the folder holds a file
    ``INCOMPLETE`` that names them: :func:`check_complete` refuses them if the process dies in between.

    Raises
    ------
    RecordError
        A file cannot be written; older ones are left as they were, unless the message says that they are marked.
    """
    places = {os.path.realpath(folder / name) for name in contents}
    if len(places) < len(contents):
        raise RecordError(f"cannot write to {folder}: two of {', '.join(contents)} are links to one file")
    with ExitStack() as open_drafts:
        drafts = [open_drafts.enter_context(_Draft(folder / name)) for name in contents]
        for draft, content in zip(drafts, contents.values(), strict=True):
            with draft.one_line_errors():
                draft.stream.write(content)
                draft.complete(durable=True)
        with _marked(folder, contents) as published:
            for draft in drafts:
                with draft.one_line_errors():
                    draft.publish()
                published.append(draft.path)


def check_complete(path: Path) -> None:
    """Refuse a file that may be of another run than those beside it, see :func:`replace_together`.

    Raises
    ------
    RecordError
        The folder is marked, and the mark names the file.
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
            f"{path}: may be of another run than the files beside it: {mark} says that a run died, or is at work, "
            "while it exchanged them; run it again, or delete that mark to take the files as they are"
        )


def write_text(path: Path, text: str) -> Path:
    """Write a text file, see :func:`replacing`.

    Raises
    ------
    RecordError
        The file cannot be written; an older one is left as it was.
    """
    with replacing(path) as stream:
        stream.write(text.encode("utf-8"))
    return path


def write_json(path: Path, data: Any) -> Path:
    """Write JSON, see :func:`write_text`."""
    return write_text(path, json_text(data))


def json_text(data: Any) -> str:
    """JSON as dynsim writes it."""
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"


class _Draft:
    """Content on its way to ``path``, in a temporary file beside it; errors within its ``with`` name the path."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> _Draft:
        with self.one_line_errors():
            existing = self._existing()
            # The name is nobody else's: made anew or not at all, and a link that lies there is not followed.
            self._temporary = self._target.with_name(f".dynsim-{os.urandom(8).hex()}.tmp")
            try:
                self.stream: BinaryIO = self._temporary.open("x+b")
                self._take_over(existing)
            except FileExistsError:  # somebody else's
                raise
            except BaseException:
                self._discard()
                raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: object) -> None:
        """Close, and remove the temporary file if it was not published."""
        self._discard()
        if isinstance(error, (OSError, UnicodeEncodeError)):
            with self.one_line_errors():
                raise error

    @contextmanager
    def one_line_errors(self) -> Iterator[None]:
        """OSError as RecordError."""
        try:
            yield
        except (OSError, UnicodeEncodeError) as error:
            raise RecordError(f"cannot write {self.path}: {_reason(error)}; nothing was changed there") from error

    def _discard(self) -> None:
        # A signal may have come before the stream was known.
        with suppress(OSError, AttributeError):
            self.stream.close()
        with suppress(OSError):
            self._temporary.unlink()

    def _existing(self) -> os.stat_result | None:
        """Find out what is at the path, and which file is to be replaced."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            existing: os.stat_result | None = os.stat(self.path)
        except FileNotFoundError:
            existing = None
        if existing is not None and stat.S_ISDIR(existing.st_mode):
            raise IsADirectoryError(0, "is a folder, not a file")
        names = [os.fspath(self.path), *([os.readlink(self.path)] if self.path.is_symlink() else ())]
        if (existing is not None and not stat.S_ISREG(existing.st_mode)) or any(map(_STREAM.fullmatch, names)):
            raise OSError(0, "is a device, pipe or socket; write to a file and copy it there")
        self._target = Path(os.path.realpath(self.path))
        if existing is not None and not os.access(self._target, os.W_OK):
            raise PermissionError(0, "the file may not be written")
        _remove_left_behind(self._target.parent)
        return existing

    def _take_over(self, existing: os.stat_result | None) -> None:
        """Hold the temporary file, and give it owner and mode of the one that it replaces."""
        descriptor = self.stream.fileno()
        lock(descriptor, wait=False)
        if existing is not None and hasattr(os, "fchmod"):
            with suppress(OSError):  # only root may give files away; then they are ours, as after any replacement
                if (existing.st_uid, existing.st_gid) != (os.geteuid(), os.getegid()):
                    os.fchown(descriptor, existing.st_uid, existing.st_gid)
            with suppress(OSError):  # a file system without modes
                os.fchmod(descriptor, stat.S_IMODE(existing.st_mode))

    def complete(self, durable: bool) -> None:
        """All content is there: hand it to the system, and let the disk have it."""
        self.stream.flush()
        if durable:
            os.fsync(self.stream.fileno())

    def publish(self) -> None:
        """Let the content be what the path holds."""
        if not hasattr(os, "fchmod"):
            self.stream.close()  # Windows renames no open file
        os.replace(self._temporary, self._target)


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


def lock(descriptor: int, *, wait: bool) -> bool:
    """Hold a file until it is closed; False if somebody else does."""
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
    """Remove temporary files of runs that died."""
    if fcntl is None:
        return
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if not _TEMPORARY.fullmatch(entry.name):
                continue
            with suppress(OSError):
                if time.time() - entry.stat(follow_symlinks=False).st_mtime < _LEFT_BEHIND:
                    continue
                descriptor = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
                try:
                    if lock(descriptor, wait=False):
                        os.unlink(entry.path)
                finally:
                    os.close(descriptor)


@contextmanager
def _marked(folder: Path, names: Mapping[str, object]) -> Iterator[list[Path]]:
    """Mark the folder as incomplete with respect to the files named; yields a list for those that are exchanged.

    The mark goes when the block ends well, or before it has exchanged anything. One process at a time; others wait.
    Mark and renames are not waited for: file systems with a journal keep their order, and an empty mark names all.
    """
    mark = folder / INCOMPLETE
    published: list[Path] = []
    try:
        stream, before = _open_mark(mark)
    except OSError as error:
        raise RecordError(f"cannot write {mark}: {_reason(error)}; nothing was changed there") from error
    with stream:
        try:
            _rewrite_mark(stream, before | set(names))
            yield published
        except BaseException as error:
            if not published:
                with suppress(OSError):
                    _remove_mark(mark, stream, before)
            if isinstance(error, OSError):
                raise RecordError(f"cannot write {mark}: {_reason(error)}; nothing was changed there") from error
            if published and isinstance(error, RecordError):
                done = ", ".join(path.name for path in published)
                raise RecordError(f"{error}; {done} came before, so {folder} is marked {INCOMPLETE}") from error
            raise
        try:
            _remove_mark(mark, stream, before - set(names))
        except OSError as error:
            raise RecordError(f"{mark}: cannot be removed ({_reason(error)}); the files beside it are whole") from error


def _remove_mark(mark: Path, stream: BinaryIO, left: set[str]) -> None:
    """Remove the mark, unless there are files that others left when they died."""
    if left:
        _rewrite_mark(stream, left)
        return
    if fcntl is None:
        stream.close()  # Windows removes no open file
    mark.unlink()


def _open_mark(mark: Path) -> tuple[BinaryIO, set[str]]:
    """The mark, held by this process, and the names it had."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    while True:
        stream = os.fdopen(os.open(mark, flags | getattr(os, "O_NONBLOCK", 0), 0o666), "r+b", buffering=0)
        try:
            lock(stream.fileno(), wait=True)
            status = os.fstat(stream.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise OSError(0, "is in the way; it is no file")
            with suppress(FileNotFoundError):
                if os.path.samestat(status, os.lstat(mark)):
                    text = stream.read().decode("utf-8", errors="replace")
                    if text and not text.startswith(_MARK):
                        raise OSError(0, "is in the way: no mark of dynsim; move it")
                    return stream, _marked_names(text) or set()
            # Another process has removed it meanwhile: it was done.
            stream.close()
        except BaseException:
            stream.close()
            raise


def _rewrite_mark(stream: BinaryIO, names: set[str]) -> None:
    stream.seek(0)
    stream.truncate()
    stream.write("\n".join([_MARK, *sorted(names), ""]).encode("utf-8"))


def _marked_names(text: str) -> set[str] | None:
    """Files that a mark names; None when it does not say, which means all."""
    return set(text.splitlines()[1:]) or None
