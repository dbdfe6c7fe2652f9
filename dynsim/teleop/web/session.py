"""A live drive: the simulation in the thread that asks for it, the server in another, frames in between."""

from __future__ import annotations

import json
import threading
import time as clock
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any, Protocol

import numpy as np

from dynsim.draw.page import page
from dynsim.errors import DynsimError, SimulationStopped
from dynsim.record.quaternion import rotated
from dynsim.record.scene import WORLD
from dynsim.system import interruption
from dynsim.teleop.driven import NO_REQUEST, Driven, Order, Shown
from dynsim.teleop.web.helm import DRIVING, Helm
from dynsim.teleop.web.pace import Pace
from dynsim.teleop.web.server import FRAMES, Server


@dataclass
class Account:
    """How a drive went.

    Attributes
    ----------
    late : lateness of each tick [s]; lost : wall time that the simulation did not follow [s]
    ended : why it ended
    stop : what ended the simulation by itself, None otherwise
    """

    late: list[float] = field(default_factory=list)
    lost: float = 0.0
    ended: str = ""
    stop: SimulationStopped | None = None


WAIT = 1e-3
"""Between two looks whether a follower is ready [s]."""
NOT_READY = "the robot is not ready yet"


class Follower(Protocol):
    """What goes where the simulation does; the simulation waits for it."""

    @property
    def begun(self) -> bool:
        """It is where the simulation begins."""

    @property
    def ready(self) -> bool:
        """It is near enough for another tick."""

    @property
    def steady(self) -> bool:
        """The robot may change its mode now, and the drive may end."""

    def hear(self) -> None:
        """There was a tick."""


class Session:
    """A drive that is open to browsers from :meth:`open` to :meth:`close`.

    Parameters
    ----------
    driven : the simulation
    name : shown in the page
    follower : for whom it waits before each tick; what is lost by that counts as behind real time
    """

    def __init__(self, driven: Driven, name: str, follower: Follower | None = None) -> None:
        self.driven, self.name = driven, name
        self._follower = follower
        self._shown = -1.0
        self._over = threading.Event()
        self._ended, self._at_once = "", False
        self._asked = NO_REQUEST
        self.helm = Helm(driven.axes, clock.monotonic)
        hello = {
            "axes": [{"name": a.name, "group": a.group, "unit": a.unit, "limit": a.limit} for a in driven.axes],
            "modes": list(driven.modes),
            "gripper": driven.has_gripper,
            "period": driven.period,
        }
        self.server = Server(self.helm, hello, len(driven.axes), driven.modes, self._page, self.end)
        self.account = Account()
        self._scene = driven.still().scene

    def open(self, port: int = 0) -> str:
        """Listen, and give the address to open in a browser."""
        self.server.start(port)
        return self.server.address

    def close(self) -> None:
        """Tell the browsers why it is over, and stop listening; nothing is left running."""
        self.server.stop(self.account.ended)

    def run(self, *, until_closed: bool = False) -> Account:
        """Drive until the pilot ends it, Ctrl-C, the longest time, or with ``until_closed`` nobody is left.

        Signals are heeded between ticks only, so that each one is driven and written down, or neither.
        """
        driven, account = self.driven, self.account
        pace = Pace(driven.period, clock.monotonic, self._over.wait)
        try:
            while True:
                interruption.heed()
                interruption.check()
                self._wait_for_follower(pace, until_closed)
                pace.next()
                interruption.keep()
                if self._is_over(until_closed):
                    break
                order, state, count = self.helm.order()
                driven.tick(self._followed(order, state))
                if self._follower is not None:
                    self._follower.hear()
                account.late.append(pace.late)
                account.lost = pace.lost
                self._show(state, count, pace)
        except KeyboardInterrupt:
            interruption.answered()
            account.ended = "interrupted"
        except SimulationStopped as stop:
            account.ended, account.stop = str(stop), stop
        interruption.keep()
        return account

    def end(self, why: str = "ended by the pilot", *, at_once: bool = False) -> None:
        """Let the drive be over before its next tick, or once its follower is steady; from any thread."""
        self._ended = self._ended or why
        self._at_once = self._at_once or at_once
        self._over.set()

    def _followed(self, order: Order, state: str) -> Order:
        """An order of which the follower can do all: a request waits for it, for as long as the key is held."""
        if self._follower is None:
            return order
        if self._over.is_set() or state != DRIVING:
            self._asked = NO_REQUEST
            return order if not self._over.is_set() else Order((0.0,) * len(order.velocity), closed=order.closed)
        self._asked = order.request if order.request != NO_REQUEST else self._asked
        request = self._asked if self._follower.steady else NO_REQUEST
        self._asked = NO_REQUEST if request == self._asked else self._asked
        return replace(order, request=request)

    def _is_over(self, until_closed: bool) -> bool:
        if until_closed and self.server.came and not self.server.clients:
            self.end("the last browser was closed")
        if self.driven.finished or (self._over.is_set() and self._may_end()):
            self.account.ended = self._ended or "the longest time is over"
        elif self.server.failure is not None:
            raise DynsimError(f"the server ended: {self.server.failure!r}")
        else:
            return False
        return True

    def _may_end(self) -> bool:
        return self._at_once or self._follower is None or self._follower.steady or self.driven.ticks == 0

    def _wait_for_follower(self, pace: Pace, until_closed: bool) -> None:
        """Whoever holds the key when a robot has come to its start must let it go first."""
        follower = self._follower
        while follower is not None and not follower.ready and not self._is_over(until_closed):
            if not follower.begun:
                self.helm.disarm()
                self._show(NOT_READY, self.helm.order()[2], pace)
            # Not on the event: it is set where a drive goes on until its follower is steady.
            clock.sleep(WAIT)

    def _show(self, state: str, count: int, pace: Pace) -> None:
        now = clock.monotonic()
        if now - self._shown >= 1.0 / FRAMES and self.server.clients:
            self._shown = now
            self.server.show(self._frame(state, count, pace))

    def _frame(self, state: str, count: int, pace: Pace) -> dict[str, Any]:
        shown = self.driven.shown()
        return {
            "time": round(shown.time, 4),
            "poses": np.round(shown.poses, 5).ravel().tolist(),
            "hand": np.round(shown.hand, 4).tolist(),
            "hindrance": shown.hindrance,
            "state": state,
            "n": count,
            "late": round(1e3 * pace.late, 1),
            "lost": round(pace.lost, 2),
            "contacts": self._contacts(shown),
            **shown.extra,
        }

    def _contacts(self, shown: Shown) -> dict[str, Any]:
        """Forces as the page takes them: the normal, and what is left beside it."""
        scene, found = self._scene, dict[str, Any]()
        if scene is None:
            return found
        for point in scene.contacts:
            touch, surface = shown.touching.get(point.name), scene.surface(point.surface)
            if touch is None or surface is None:
                continue
            at = np.array(point.position)
            if point.body != WORLD:
                place, turn = shown.poses[point.body, :3], shown.poses[point.body, 3:]
                at = place + rotated(turn, at)
            normal = surface.normal(at)
            found[point.name] = {
                "force": round(touch.force, 3),
                "normal": np.round(normal, 5).tolist(),
                "tangent": np.round(touch.vector - touch.force * normal, 3).tolist(),
                "mode": touch.mode,
            }
        return found

    def _page(self, socket: str) -> str:
        own = resources.files("dynsim.teleop.web").joinpath("page")
        style = own.joinpath("drive.css").read_text(encoding="utf-8")
        program = own.joinpath("drive.js").read_text(encoding="utf-8")
        given = f"const DRIVE = {json.dumps({'socket': socket, 'style': style})};"
        return page({self.name: self.driven.still()}, scripts=[f"{given}\n{program}"], connect=socket)
