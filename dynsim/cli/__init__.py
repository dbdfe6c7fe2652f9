"""The command line: ``dynsim run``, ``compare``, ``check``, ``list``, ``plot``, ``bench``, ``schema``, ``hw`` …"""

import os
import sys


def main() -> None:
    """Entry point of ``dynsim``."""
    # Before numpy: dynsim's matrices are small, and threads that wait for work take a tenth of a run's processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Before the other commands are there: what workers load takes longer than anything else before the first run.
    if sys.argv[1:2] == ["sweep"]:
        from dynsim.cli.workers import begin_workers

        begin_workers(sys.argv[2:])
    from dynsim.cli.entry import main

    main()


__all__ = ["main"]
