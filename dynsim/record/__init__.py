"""What a run leaves behind: the record, in memory and as a file. It knows nothing of the engine that made it."""

from dynsim.record.content import FORMAT, TIME, Event, Signal
from dynsim.record.record import Record

__all__ = ["FORMAT", "TIME", "Event", "Record", "Signal"]
