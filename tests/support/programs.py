"""Programs that the default tests share, compiled in advance: half of them by each of two workers.

Otherwise each worker would compile most of them, at the same time as the other worker.
"""

from __future__ import annotations

import os
from contextlib import suppress

from dynsim.engine import simulate
from dynsim.scenario import load_scenario

# Scenarios and variants with the programs of CONTRIBUTING.md. The programs of a worker have most parts in common.
SHARES: tuple[tuple[tuple[str, str | None], ...], ...] = (
    (("block_on_slope", None), ("elbow_comparison_links", None), ("elbow_comparison", "no_elbow")),
    (("falling_arm", None), ("snake_positioning_dynamic", "x"), ("single_pendulum", None)),
)
# With fewer tests than this nothing is compiled in advance: they may need few programs.
MANY = 1000


def compile_share(tests: int) -> None:
    """Compile the share of this process, if it is a pytest worker of several and there are many tests."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "").removeprefix("gw")
    if tests < MANY or not worker or int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) < len(SHARES):
        return
    for name, variant in SHARES[int(worker)] if int(worker) < len(SHARES) else ():
        # Errors are left to the tests.
        with suppress(Exception):
            simulate(load_scenario(name, variant, {"duration_s": 0.01, "metrics.settle_s": 0.0}))
