"""Timing of several things that take turns."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Timed:
    """Something to time: ``call(count)`` does the work at least ``count`` times and returns how many times."""

    name: str
    call: Callable[[int], int]


def one_by_one(call: Callable[[], Any]) -> Callable[[int], int]:
    """For a call that does the work once."""

    def repeat(count: int) -> int:
        for _ in range(count):
            call()
        return count

    return repeat


def in_batches(call: Callable[[], Any], batch: int) -> Callable[[int], int]:
    """For a call that does the work ``batch`` times."""

    def repeat(count: int) -> int:
        calls = max(1, round(count / batch))
        for _ in range(calls):
            call()
        return calls * batch

    return repeat


def take_turns(timed: list[Timed], rounds: int, share: float) -> dict[str, list[float]]:
    """Seconds per unit of work of every contender, one sample per round, the contenders interleaved.

    CPU time of this thread, in which all of them run: what other processes take does not count.
    """
    counts = {}
    for contender in timed:
        contender.call(1)  # warm caches, and a first guess of the cost
        started = time.thread_time()
        done = contender.call(1)
        cost = (time.thread_time() - started) / done
        # A Python loop or a compiled loop of one is mostly overhead: measure again with a fair number.
        count = max(1, min(int(0.2 * share / cost), 10_000))
        started = time.thread_time()
        done = contender.call(count)
        counts[contender.name] = max(1, int(share * done / (time.thread_time() - started)))
    samples: dict[str, list[float]] = {contender.name: [] for contender in timed}
    for k in range(rounds):
        for contender in timed:
            # A contender that takes far longer than a sample should gets fewer of them.
            if k >= 3 and sum(samples[contender.name]) * counts[contender.name] > 4.0 * rounds * share:
                continue
            started = time.thread_time()
            done = contender.call(counts[contender.name])
            samples[contender.name].append((time.thread_time() - started) / done)
    return samples
