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

# Program of the child. The first message lists the folders in which Python searches for dynsim.
START = """
import pickle, signal, sys
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_DFL)
sys.path[:], path, limits = pickle.load(sys.stdin.buffer)
from dynsim.record import isolated
from dynsim.record.reader import decode
isolated.serve(decode, path, limits, sys.stdout.buffer)
"""


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
    folders = [folder for folder in sys.path if isinstance(folder, str)]
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
            pickle.dump((folders, str(path), limits), stream)
        answer = _received(process.stdout)
    except (OSError, EOFError):
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
    if code < 0 and signal.Signals(-code).name == "SIGXCPU":
        return f"reading it took more than {limits[0]} s of processor time; it is damaged"
    if code < 0:
        return f"the HDF5 library crashed on it ({signal.Signals(-code).name}); it is damaged"
    return f"its reader ended with code {code}"


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
    answer: Content | str
    try:
        answer = decode(Path(path))
    except RecordError as error:
        answer = str(error)
    except MemoryError:
        answer = f"{path}: reading it takes more than {memory / 1e9:.3g} GB of memory"
    buffers: list[pickle.PickleBuffer] = []
    header = pickle.dumps(answer, protocol=5, buffer_callback=buffers.append)
    arrays = [buffer.raw() for buffer in buffers]
    pickle.dump((header, [array.nbytes for array in arrays]), stream)
    for array in arrays:
        stream.write(array)
    stream.flush()
