"""The command line: ``dynsim run``, ``compare``, ``check``, ``list``, ``plot``, ``bench``, ``schema``, ``hw`` …"""

import os
import sys


def main() -> None:
    """Entry point of ``dynsim``."""
    # Before numpy: dynsim's matrices are small, and threads that wait for work take a tenth of a run's processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from dynsim.system import interruption

    with interruption.heeded() as received:
        try:
            # Before the other commands are there: what workers load takes longest of all before the first run.
            if sys.argv[1:2] == ["sweep"]:
                from dynsim.cli.workers import begin_workers

                begin_workers(sys.argv[2:])
            from dynsim.cli.entry import main
        except KeyboardInterrupt:
            sys.exit(interruption.exit_code(received))
        main(received)


__all__ = ["main"]
