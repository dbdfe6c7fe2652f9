"""States of the parts of a simulation that are Python objects, for its snapshots."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar


class Stateful:
    """Object whose state is the attributes in ``SAVED``: deep copies of them, and the states of stateful ones."""

    SAVED: ClassVar[tuple[str, ...]] = ()

    def saved_state(self) -> dict[str, Any]:
        """Return the state."""
        values = {name: getattr(self, name) for name in self.SAVED}
        return {
            name: value.saved_state() if isinstance(value, Stateful) else deepcopy(value)
            for name, value in values.items()
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a result of :meth:`saved_state` of this object."""
        for name in self.SAVED:
            if isinstance(part := getattr(self, name), Stateful):
                part.restore(state[name])
            else:
                setattr(self, name, deepcopy(state[name]))
