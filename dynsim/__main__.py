"""Entry point of ``python -m dynsim``."""

from dynsim.cli import main

main()
