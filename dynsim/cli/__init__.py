"""The command line: ``dynsim run``, ``compare``, ``check``, ``list``, ``plot``, ``bench``, ``schema``, ``hw`` …"""

import atexit
import gc
import os
import sys


def main() -> None:
    """Entry point of ``dynsim``."""
    # Before numpy: dynsim's matrices are small, and threads that wait for work take a tenth of a run's processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Imports stay: to look for garbage in them as often as by default, and at the end, takes a third of `dynsim check`.
    gc.set_threshold(200_000)
    atexit.register(gc.freeze)
    from dynsim.system import interruption

    with interruption.handled() as received:
        try:
            from dynsim.cli.entry import main
        except KeyboardInterrupt:
            sys.exit(interruption.exit_code(received))
        main(received)


__all__ = ["main"]
