"""The command line: ``dynsim run``, ``compare``, ``check``, ``list``, ``plot``, ``bench``, ``schema``, ``hw`` …"""

from dynsim.cli.entry import main

__all__ = ["main"]
