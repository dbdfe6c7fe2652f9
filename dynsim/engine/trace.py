"""Sampling of a stepped simulation: blocks of sample times for the kernels, and the samples to keep."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dynsim.integrators import run as ki

Array = NDArray[np.float64]
Rows = tuple[Array, Array, Array]

# Rows of the buffer that kernels write samples to before it is emptied.
BLOCK = 256


def even_times(start: float, end: float, rate: float, first: int = 0, count: int | None = None) -> Array:
    """Return evenly spaced sample times [s], including the end.

    Parameters
    ----------
    start : float
        First time of all samples [s].
    end : float
        End [s]; if infinite, ``count`` is required.
    rate : float
        Sampling rate [1/s].
    first : int, optional
        Index of the first sample to return.
    count : int, optional
        Number of samples; default: up to the end.
    """
    if not math.isfinite(end):
        assert count is not None
        return _times(start, rate, np.arange(first, first + count))
    last = math.floor((end - start) * rate * (1.0 + 1e-12))
    stop = last + 2 if count is None else first + count
    # Rounding must not put a sample after the end, where it would never be taken.
    times = np.minimum(_times(start, rate, np.arange(first, min(stop, last + 1))), end)
    apart = end - (start + last / rate) > 1e-9 * (end - start)
    return np.append(times, end) if apart and first <= last + 1 < stop else times


def _times(start: float, rate: float, numbers: NDArray[np.int64]) -> Array:
    """Return the times [s] of samples by number.

    After a start from a sample of another run, they are exactly the times of that run. This matters because a load may
    jump at such a time, and 0.35 + 0.05 is less than 0.4 in floating-point arithmetic.
    """
    before = round(start * rate)
    if abs(start * rate - before) > 1e-9:
        return start + numbers / rate
    times = (before + numbers) / rate
    times[numbers == 0] = start
    return times


class Trace:
    """Times, states and outputs of samples; a shallow copy is a snapshot, because values are replaced.

    Parameters
    ----------
    start : float
        First sample time [s].
    end : float
        Last sample time [s]; a sample is taken there whatever the rate is.
    rate : float
        Sampling rate [1/s].
    keep : int or None
        Number of last samples to keep; None for all, 0 for none.
    times : (T,) ndarray, optional
        Times of all samples if known in advance [s].
    block : int, optional
        Rows of the buffer.
    """

    def __init__(
        self, start: float, end: float, rate: float, keep: int | None, times: Array | None = None, block: int = BLOCK
    ) -> None:
        self._size = block
        self._start, self._end, self._rate, self._keep, self._times = start, end, rate, keep, times
        self._rows: tuple[Rows, ...] = ()
        self._next = 0

    def end_at(self, end: float, run: ki.Run) -> None:
        """End the samples, including those of the run's buffer, with a sample at a time [s]."""
        self._end, self._times = end, None
        if self._keep != 0:
            taken = int(run.count[ki.SAMPLE])
            room = len(run.sample_time) - taken
            times = even_times(self._start, self._end, self._rate, self._next + taken, room)
            run.sample_time[taken:] = np.inf
            run.sample_time[taken : taken + len(times)] = times

    def taken(self, run: ki.Run) -> Rows:
        """Return the contents of the run's buffer."""
        rows = int(run.count[ki.SAMPLE])
        return run.sample_time[:rows], run.sample[:rows], run.output[:rows]

    def move(self, run: ki.Run, until: float = -np.inf) -> Array:
        """Keep the buffer's contents and return the next sample times [s], at least up to the first after ``until``."""
        times, states, outputs = self.taken(run)
        if len(times):
            self._rows = (*self._rows, (times.copy(), states.copy(), outputs.copy()))
            kept = sum(len(times) for times, _, _ in self._rows)
            while self._keep is not None and kept - len(self._rows[0][0]) >= self._keep:
                kept -= len(self._rows[0][0])
                self._rows = self._rows[1:]
        self._next += len(times)
        return self._block(until)

    def rows(self, run: ki.Run) -> Rows:
        """Return all kept samples, including the run's buffer."""
        times, states, outputs = self.taken(run)
        # The buffer of an ended run does not change any more; it need not be copied.
        if self._rows or run.count[ki.STATUS] == ki.RUNNING:
            parts = zip(*self._rows, (times, states, outputs), strict=True)
            times, states, outputs = (np.concatenate(part) for part in parts)
        first = 0 if self._keep is None else max(len(times) - self._keep, 0)
        return times[first:], states[first:], outputs[first:]

    def last_output(self) -> Array | None:
        """Return the outputs of the last kept sample, or None if no sample is kept."""
        return self._rows[-1][2][-1] if self._rows else None

    def _block(self, until: float) -> Array:
        """Return the next sample times [s]; infinite times are never reached."""
        if self._keep == 0:
            return np.full(1, np.inf)
        first, count = self._next, self._size
        if self._times is not None:
            more = int(np.searchsorted(self._times, until, side="right")) - first
            times = self._times[first : first + max(count, more + 1)].copy()
        else:
            if math.isfinite(until):
                count = max(count, int((until - self._start) * self._rate) + 2 - first)
            times = even_times(self._start, self._end, self._rate, first, count)
        # After the last sample the buffer must not limit the steps.
        return np.append(times, np.inf) if len(times) < count else times
