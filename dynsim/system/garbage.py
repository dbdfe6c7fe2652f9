"""How often Python looks for garbage: as it does by default takes a tenth of a run, and 0.2 s when a command ends."""

from __future__ import annotations

import gc

# New objects after which a process looks for it. What it imports stays.
_NEW_OBJECTS = 200_000


def look_rarely() -> None:
    """For processes of dynsim's own, as they begin."""
    gc.set_threshold(_NEW_OBJECTS)


def keep_all() -> None:
    """What there is now is no garbage, or nobody minds: it is not looked through again, not even at the end."""
    gc.freeze()
