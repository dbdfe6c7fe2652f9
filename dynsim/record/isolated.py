"""Reading of record files in a separate process with limits of processor time and memory.

The HDF5 library can loop endlessly on a file that was made to do so, and Python handles no signal meanwhile. Nothing
within one process can stop it. A child process has its own limits, and the parent can end it at any time.
"""

from __future__ import annotations

import math
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from dynsim.errors import RecordError

if TYPE_CHECKING:
    from dynsim.record.content import Content

# Limits of processor time [s], memory and data [bytes] for files up to this size; they grow with larger ones.
SIZE, TIME_S, MEMORY, DATA = 100_000_000, 8, 2_000_000_000, 900_000_000

# Program of the child. The first message lists the folders in which Python searches for dynsim. The parent ends the
# child at Ctrl-C, which reaches both.
START = """
import pickle, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
sys.path[:], path, limits = pickle.load(sys.stdin.buffer)
from dynsim.record import isolated
from dynsim.record.reader import decode
isolated.serve(decode, path, limits, sys.stdout.buffer)
"""


def search_path() -> list[str]:
    """Return the folders in which a child process searches for modules, with the working directory last.

    So a ``json.py`` in the working directory does not replace the standard module. The folder of this dynsim precedes
    all folders that contain another one: a checkout in the working directory, an installed dynsim.
    """
    here = ("", os.curdir, os.getcwd() if os.path.isdir(os.curdir) else "")
    path = sorted((folder for folder in sys.path if isinstance(folder, str)), key=lambda folder: folder in here)
    with_dynsim = (number for number, folder in enumerate(path) if os.path.isdir(os.path.join(folder, "dynsim")))
    path.insert(next(with_dynsim, len(path)), str(Path(__file__).parents[2]))
    return path


def scale(size: int) -> float:
    """Return the factor by which the limits grow for a file of this size [bytes]."""
    return max(1.0, size / SIZE)


def data_limit(size: int) -> int:
    """Return the number of bytes that a file of this size may expand to."""
    return int(DATA * scale(size))


def read(path: Path) -> Content:
    """Read a record file in a child process.

    Parameters
    ----------
    path : Path
        HDF5 file.

    Raises
    ------
    RecordError
        If the content is invalid, the HDF5 library crashes, or a limit is exceeded: 8 s of processor time and 2 GB of
        memory for files up to 100 MB, more for larger ones in proportion.
    """
    factor = scale(path.stat().st_size)
    limits = math.ceil(TIME_S * factor), int(MEMORY * factor)
    # A linear algebra library with many threads would reserve more memory than the limit.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    try:
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", START], env=environment,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except OSError as error:
        raise RecordError(f"{path}: no process can be started to read it ({error.strerror})") from error
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        with process.stdin as stream:
            pickle.dump((search_path(), str(path), limits), stream)
        answer = _received(process.stdout)
    except (OSError, EOFError, pickle.UnpicklingError):
        raise RecordError(f"{path}: {_death(process.wait(), limits)}") from None
    finally:
        process.kill()
        process.stdout.close()
        process.wait()
    if isinstance(answer, str):
        raise RecordError(answer)
    content: Content = answer
    return content


def _received(stream: IO[bytes]) -> Any:
    """Return the object that the child sent: its pickle, and the arrays behind it."""
    header, sizes = pickle.load(stream)
    buffers = [bytearray(size) for size in sizes]
    for buffer in buffers:
        view = memoryview(buffer)
        while view:
            if not (count := stream.readinto(view)):  # type: ignore[attr-defined]
                raise EOFError
            view = view[count:]
    return pickle.loads(header, buffers=buffers)


def _death(code: int, limits: Sequence[int]) -> str:
    """Return why the child with this return code ended without an answer."""
    name = signal.Signals(-code).name if code < 0 else ""
    if name == "SIGXCPU":
        return f"reading it took more than {limits[0]} s of processor time; it is damaged"
    if name in ("SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGABRT"):
        return f"the HDF5 library crashed on it ({name}); it is damaged"
    return f"its reader was ended by {name}" if name else f"its reader ended with code {code}"


def serve(decode: Callable[[Path], Content], path: str, limits: tuple[int, int], stream: IO[bytes]) -> None:
    """Read a record file in the child process, and send its content or the text of the error."""
    time_s, memory = limits
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (time_s, time_s + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    except (ImportError, ValueError, OSError):
        pass  # Windows has no such limits; other systems not all of them
    buffers: list[pickle.PickleBuffer] = []
    try:
        header = pickle.dumps(decode(Path(path)), protocol=5, buffer_callback=buffers.append)
    except RecordError as error:
        header = pickle.dumps(str(error))
    except MemoryError:
        buffers.clear()
        header = pickle.dumps(f"{path}: not enough memory to read it")
    arrays = [buffer.raw() for buffer in buffers]
    pickle.dump((header, [array.nbytes for array in arrays]), stream)
    for array in arrays:
        stream.write(array)
    stream.flush()
