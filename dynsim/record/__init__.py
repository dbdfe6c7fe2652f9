"""Records: signals, events and scene of a run, in memory and as a file, independent of the engine that created them."""

from dynsim.record.content import FORMAT, TIME, Event, Signal
from dynsim.record.record import Record

__all__ = ["FORMAT", "TIME", "Event", "Record", "Signal"]
