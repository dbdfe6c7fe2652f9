"""Live drive: the simulation runs in real time in the calling thread, and the server runs in another thread."""

from __future__ import annotations

import json
import threading
import time as clock
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from typing import Any, Protocol

import numpy as np

from dynsim.draw.geometry.robot import reaction_name
from dynsim.draw.page import page
from dynsim.dynamics import tables as ka
from dynsim.errors import DynsimError, SimulationStopped
from dynsim.record import Record
from dynsim.record.scene import WORLD
from dynsim.snake.description import NO_REQUEST
from dynsim.system import interruption
from dynsim.teleop.snake import Command, LiveFrame, Session
from dynsim.teleop.web.pilot import DRIVING, Deadman
from dynsim.teleop.web.server import FRAMES, Server

WAIT = 1e-3
"""Interval between checks whether a follower is ready [s]."""
NOT_READY = "the robot is not ready yet"


class RealTimeClock:
    """Clock that waits for the next tick.

    After a late tick, at most one tick follows without a pause. A larger delay is not made up, so that simulated time
    falls behind wall time. Therefore a motion exceeds the commanded speed for at most one tick, and commands do not
    take effect in bursts.

    Parameters
    ----------
    period : float
        Time between ticks [s].
    now : callable
        Monotonic clock [s].
    wait : callable
        Function that waits for a given time [s].

    Attributes
    ----------
    late : float
        Lateness of the last tick [s].
    lost : float
        Wall time by which the simulation has fallen behind [s].
    """

    def __init__(self, period: float, now: Callable[[], float], wait: Callable[[float], object]) -> None:
        self._period, self._now, self._wait = period, now, wait
        self._due: float | None = None
        self.late = self.lost = 0.0

    def next(self) -> None:
        """Wait until the next tick is due."""
        now = self._now()
        if self._due is None:
            self._due = now
        if now < self._due:
            self._wait(self._due - now)
            now = self._now()
        self.late = max(now - self._due, 0.0)
        beyond = max(self.late - self._period, 0.0)
        self.lost += beyond
        self._due += self._period + beyond


@dataclass
class DriveReport:
    """Report on the timing and the end of a drive.

    Attributes
    ----------
    late : list of float
        Lateness of each tick [s].
    lost : float
        Wall time by which the simulation has fallen behind [s].
    ended : str
        Reason why the drive ended.
    stop : SimulationStopped or None
        Error that ended the simulation, if any.
    """

    late: list[float] = field(default_factory=list)
    lost: float = 0.0
    ended: str = ""
    stop: SimulationStopped | None = None


class Follower(Protocol):
    """Interface of a robot that follows the simulation and for which the simulation waits."""

    @property
    def begun(self) -> bool:
        """True if the follower has reached the initial posture of the simulation."""

    @property
    def ready(self) -> bool:
        """True if the follower is close enough to the simulation for another tick."""

    def report_pilot(self) -> None:
        """Report that a browser is connected; the follower is at rest, without torque, until then."""

    @property
    def steady(self) -> bool:
        """True if the robot may change its mode now, and the drive may end."""

    def after_tick(self) -> None:
        """Send the state of the simulation to the robot after a tick."""


class LiveDrive:
    """Drive of a session, which browsers can access from :meth:`open` to :meth:`close`.

    Parameters
    ----------
    session : Session
        Simulation to drive.
    name : str
        Name that the page shows.
    follower : Follower, optional
        Robot for which the simulation waits before each tick; the wait counts as time behind real time.
    """

    def __init__(self, session: Session, name: str, follower: Follower | None = None) -> None:
        self.session, self.name = session, name
        self._follower = follower
        self._framed_at = -1.0
        self._over = threading.Event()
        self._ended, self._at_once = "", False
        self._requested = NO_REQUEST
        self.deadman = Deadman(session.axes, clock.monotonic)
        self._clock = RealTimeClock(session.period, clock.monotonic, self._over.wait)
        hello = {
            "axes": [asdict(axis) for axis in session.axes],
            "modes": list(session.modes),
            "gripper": session.has_gripper,
            "period": session.period,
        }
        self.server = Server(
            deadman=self.deadman,
            hello=hello,
            axes=len(session.axes),
            modes=session.modes,
            page=self._page,
            end=self.end,
        )
        self.report = DriveReport()

    def open(self, port: int = 0) -> str:
        """Start the server and return the address to open in a browser."""
        self.server.start(port)
        return self.server.address

    def close(self) -> None:
        """Send the reason for the end to the browsers, and stop the server and its thread."""
        self.server.stop(self.report.ended)

    def run(self, *, until_closed: bool = False) -> DriveReport:
        """Drive until the pilot ends the drive, the user presses Ctrl-C, or the maximum duration has passed.

        If ``until_closed`` is True, the drive also ends when the last browser disconnects. Signals are handled only
        between ticks, so that each tick is either executed and recorded, or not executed.
        """
        session, report = self.session, self.report
        try:
            while True:
                interruption.heed()
                interruption.check()
                self._wait_for_follower(until_closed)
                self._clock.next()
                interruption.keep()
                if self._is_over(until_closed):
                    break
                command, state, count = self.deadman.command()
                session.tick(self._followed(command, state))
                if self._follower is not None:
                    self._follower.after_tick()
                report.late.append(self._clock.late)
                report.lost = self._clock.lost
                self._show(state, count)
        except KeyboardInterrupt:
            interruption.answered()
            report.ended = "interrupted"
        except SimulationStopped as stop:
            report.ended, report.stop = str(stop), stop
        interruption.keep()
        return report

    def end(self, why: str = "ended by the pilot", *, at_once: bool = False) -> None:
        """End the drive before the next tick if ``at_once``, otherwise when its follower is steady; thread-safe."""
        self._ended = self._ended or why
        self._at_once = self._at_once or at_once
        self._over.set()

    def _followed(self, command: Command, state: str) -> Command:
        """Return a command that the follower can execute; delay a mode request while the dead-man switch is held."""
        if self._follower is None:
            return command
        if self._over.is_set() or state != DRIVING:
            self._requested = NO_REQUEST
            over = self._over.is_set()
            return Command((0.0,) * len(command.velocity), closed=command.closed) if over else command
        self._requested = command.request if command.request != NO_REQUEST else self._requested
        request = self._requested if self._follower.steady else NO_REQUEST
        self._requested = NO_REQUEST if request == self._requested else self._requested
        return replace(command, request=request)

    def _is_over(self, until_closed: bool) -> bool:
        if until_closed and self.server.had_clients and not self.server.clients:
            self.end("the last browser was closed")
        may_end = self._at_once or self._follower is None or self._follower.steady or self.session.ticks == 0
        if self.session.finished or (self._over.is_set() and may_end):
            self.report.ended = self._ended or "the maximum duration has passed"
        elif self.server.failure is not None:
            raise DynsimError(f"the server failed: {self.server.failure!r}")
        else:
            return False
        return True

    def _wait_for_follower(self, until_closed: bool) -> None:
        """Wait until the follower is ready.

        If the dead-man switch is held before the follower has begun, it must be released before it takes effect.
        """
        follower = self._follower
        while follower is not None and not follower.ready and not self._is_over(until_closed):
            if not follower.begun:
                self.deadman.disarm()
                if self.server.had_clients:
                    follower.report_pilot()
                self._show(NOT_READY, self.deadman.command()[2])
            # Do not wait for the event: it is already set if the drive only continues until its follower is steady.
            clock.sleep(WAIT)

    def _show(self, state: str, count: int) -> None:
        now = clock.monotonic()
        if now - self._framed_at >= 1.0 / FRAMES and self.server.clients:
            self._framed_at = now
            self.server.show(self._frame(state, count))

    def _frame(self, state: str, count: int) -> dict[str, Any]:
        frame = self.session.frame()
        return {
            "time": round(frame.time, 4),
            "poses": np.round(frame.poses, 5).ravel().tolist(),
            "hand": np.round(frame.hand, 4).tolist(),
            "hindrance": frame.hindrance,
            "state": state,
            "n": count,
            "late": round(1e3 * self._clock.late, 1),
            "lost": round(self._clock.lost, 2),
            "contacts": self._contacts(frame),
            **frame.extra,
        }

    def _contacts(self, frame: LiveFrame) -> dict[str, Any]:
        """Return the forces of closed contacts for the page: normal force, normal, tangential force and contact mode.

        If a body carries the surface, there is also the force on this body, and the place of both.
        """
        scene, forces = self.session.still.scene, dict[str, Any]()
        if scene is None:
            return forces
        for point in scene.contacts:
            touch = frame.touching.get(point.name)
            if touch is None or touch.mode == ka.OPEN:
                continue
            signs = {point.name: 1.0}
            if point.carrier != WORLD:
                signs[reaction_name(scene, point)] = -1.0
            for name, sign in signs.items():
                forces[name] = {
                    "force": round(touch.force, 3),
                    "normal": np.round(sign * touch.normal, 5).tolist(),
                    "tangent": np.round(sign * (touch.vector - touch.force * touch.normal), 3).tolist(),
                    "mode": touch.mode,
                    **({} if scene.surface(point.surface) else {"at": np.round(touch.position, 5).tolist()}),
                }
        return forces

    def _page(self, socket: str) -> str:
        return live_page("drive", self.name, self.session.still, socket)


def live_page(program: str, name: str, still: Record, socket: str) -> str:
    """Return the page of a record with one of the programs ``drive`` and ``pose``, which connects to the socket."""
    own = resources.files("dynsim.teleop.web").joinpath("page")
    style, text = (own.joinpath(f"{program}.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    constants = f"const DRIVE = {json.dumps({'socket': socket, 'style': style})};"
    return page({name: still}, scripts=[f"{constants}\n{text}"], connect=socket)
