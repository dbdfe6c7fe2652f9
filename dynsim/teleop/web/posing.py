"""Live start posture: browsers change it, and the calling thread computes its gaps, torques and scenario keys."""

from __future__ import annotations

import queue
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dynsim.errors import DynsimError
from dynsim.system import interruption
from dynsim.teleop.posture import StartPosture
from dynsim.teleop.web.live import live_page
from dynsim.teleop.web.pilot import Refused, finite, parse_object
from dynsim.teleop.web.server import PageServer, _Client

PATIENCE = 0.1
"""Interval between checks for Ctrl-C and closed browsers [s]."""
VALUE_MAX = 1e6
"""Largest magnitude of a number in a message [deg or m]."""


def parse_change(text: str | bytes) -> dict[str, Any]:
    """Parse a message of the page, a mapping with the action ``do`` and its arguments.

    Raises
    ------
    Refused
        If the message is not valid.
    """
    message = parse_object(text)
    action = message.get("do")
    if not isinstance(action, str) or action not in _ACTIONS:
        raise Refused(f"do: must be one of {', '.join(_ACTIONS)}")
    kinds = _ACTIONS[action]
    if set(message) != {"do", *kinds}:
        raise Refused(f"{action}: requires the keys {', '.join(kinds) or 'do'}")
    for key, kind in kinds.items():
        if not _KINDS[kind](message[key]):
            raise Refused(f"{key}: must be a {kind}")
    return message


def _is_number(value: Any) -> bool:
    return finite(value) and abs(value) <= VALUE_MAX


# Checks of the arguments of actions, by kind.
_KINDS: dict[str, Callable[[Any], bool]] = {
    "name": lambda value: isinstance(value, str),
    "flag": lambda value: isinstance(value, bool),
    "number": _is_number,
    "point": lambda value: isinstance(value, list) and len(value) == 3 and all(map(_is_number, value)),
}
# Arguments of each action of the page.
_ACTIONS: dict[str, dict[str, str]] = {
    "set": {"name": "name", "value": "number"},
    "reach": {"target": "point", "braces": "flag", "orientation": "flag"},
    "snap": {"name": "name", "hand": "flag"},
    "brace": {"body": "name", "surface": "name"},
    "undo": {},
    "redo": {},
    "reset": {},
    "check": {},
}


@dataclass(eq=False, kw_only=True)
class PostureServer(PageServer):
    """Server of a posture, which every client may change; ``changed`` receives the parsed messages."""

    changed: Callable[[Mapping[str, Any]], None]

    async def _receive(self, client: _Client, message: str | bytes) -> None:
        self.changed(parse_change(message))


class LivePosture:
    """Start posture that browsers can change from :meth:`open` to :meth:`close`.

    Parameters
    ----------
    posture : StartPosture
        Posture to change.
    name : str
        Name that the page shows.
    """

    def __init__(self, posture: StartPosture, name: str) -> None:
        self.posture, self.name = posture, name
        self._changes: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._still = posture.still()
        self.server = PostureServer(hello=posture.hello(), page=self._page, changed=self._changes.put)

    def open(self, port: int = 0) -> str:
        """Compute the first frame, start the server and return the address to open in a browser."""
        frame = self.posture.frame()
        self.server.start(port)
        self.server.show(frame)
        return self.server.address

    def close(self) -> None:
        """Close the connections, and stop the server and its thread."""
        self.server.stop("the command has ended")

    def run(self, *, until_closed: bool = False) -> None:
        """Execute the changes of the browsers until Ctrl-C, or until the last browser disconnects if ``until_closed``.

        Raises
        ------
        KeyboardInterrupt
            After Ctrl-C.
        DynsimError
            If the server fails.
        """
        while not (until_closed and self.server.had_clients and not self.server.clients):
            interruption.check()
            if self.server.failure is not None:
                raise DynsimError(f"the server failed: {self.server.failure!r}")
            try:
                change = self._changes.get(timeout=PATIENCE)
            except queue.Empty:
                continue
            self._execute(change)
            # Execute everything that has arrived before the page is updated.
            while not self._changes.empty():
                self._execute(self._changes.get())
            self.server.show(self._frame())

    def _frame(self) -> dict[str, Any]:
        """Return the frame of the posture; undo a change after which it cannot be computed."""
        try:
            return self.posture.frame()
        except DynsimError as error:
            self.posture.undo()
            self.posture.note = f"undone: {error}"
            return self.posture.frame()

    def _execute(self, change: Mapping[str, Any]) -> None:
        """Execute one change; an error becomes a note on the page."""
        posture = self.posture
        posture.note = ""
        try:
            match change["do"]:
                case "set":
                    posture.set(change["name"], change["value"])
                case "reach":
                    posture.reach(
                        change["target"], keep_braces=change["braces"], keep_orientation=change["orientation"]
                    )
                case "snap":
                    posture.snap(change["name"], keep_hand=change["hand"])
                case "brace":
                    posture.add_brace(change["body"], change["surface"])
                case action:
                    getattr(posture, action)()
        except (DynsimError, ArithmeticError, np.linalg.LinAlgError) as error:
            posture.note = str(error)

    def _page(self, socket: str) -> str:
        return live_page("pose", self.name, self._still, socket)
