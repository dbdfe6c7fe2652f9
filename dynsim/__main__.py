"""``python -m dynsim``."""

from dynsim.cli import main

main()
