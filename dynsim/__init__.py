"""dynsim: dynamic simulator of braced hyper-redundant manipulators."""

from dynsim._version import __version__

__all__ = ["__version__"]
