"""Command line ``dynsim``: one module for each command or group of commands; this file is the entry point."""

import atexit
import gc
import os
import sys


def main() -> None:
    """Run the command-line program ``dynsim``."""
    # Set this before numpy is imported: matrices are small, and idle threads would use a tenth of the processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Imported objects are never freed; garbage collection with the default settings, including a collection at exit,
    # would take a third of the run time of `dynsim check`.
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
