"""The command line ``dynsim``: one module for each command or group of commands; here its entry point."""

import atexit
import gc
import os
import sys


def main() -> None:
    """Entry point of ``dynsim``."""
    # Before numpy is imported: dynsim's matrices are small, and idle threads take a tenth of a run's processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Imported objects stay: garbage collection at its default rate, and at the end, takes a third of `dynsim check`.
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
