"""Questions and tables of the commands that move a robot: before a replay, and about nudges of single servos."""

from __future__ import annotations

import math
from collections.abc import Sequence

import typer
from rich.console import Console
from rich.table import Table

from dynsim.hardware.bus.clock import Clock
from dynsim.hardware.bus.protocol import Bus
from dynsim.hardware.errors import ReplayInterrupted
from dynsim.hardware.nudge import ANGLE, Nudge, nudge, swapped
from dynsim.hardware.ports import VIRTUAL, bus_on
from dynsim.hardware.replay.motion import MotionTask
from dynsim.hardware.replay.states import StopRequest, stop_on_signals
from dynsim.hardware.replay.verify import QUANTITIES, LimitRow, differences, way_to_start
from dynsim.hardware.servo_map import MappedServo, ServoMap

ANSWERS = ("y", "n", "again")
CLEAR = "Is everybody clear of the robot, and the power cut within reach?"


def confirm_replay(
    console: Console, servo_map: ServoMap, motion: MotionTask, port: str, *, asked: bool, at_most: bool = False
) -> None:
    """Show the distance to the start and ask for consent.

    A start beyond ``safety.start_distance`` needs an answer even where not ``asked``.

    ``at_most``: the motion may end sooner.

    Raises
    ------
    ReplayInterrupted
        The user does not agree, or does not answer.
    PortError, VerificationFailed
        The posture cannot be read.
    """
    with bus_on(port, servo_map) as (bus, _):
        approach = way_to_start(bus, servo_map, motion.start)
    console.print(
        f"{servo_map.robot}: {len(servo_map.servos)} servos will move for {motion.duration:.1f} s"
        f"{' at most' if at_most else ''}, "
        f"after {approach.duration:.1f} s to the start."
    )
    for distance in approach.distances[:1]:
        console.print(f"furthest from its start: {distance}")
    agreed = not asked or _agreed(console, CLEAR, "move?")
    if agreed and approach.far:
        still = "" if asked else " (asked with --yes too)"
        bound = servo_map.safety.start_distance
        console.print(f"further than safety.start_distance, {bound:g} rad, from their start{still}:")
        for distance in approach.far:
            console.print(f"  {distance}")
        agreed = _agreed(console, "All joints go there in step: is the whole way free?", "move there?")
    if not agreed:
        raise ReplayInterrupted("not confirmed; nothing was moved")


def print_limits(console: Console, rows: Sequence[LimitRow]) -> None:
    """Limits that the servos have stored, beside the map's."""
    table = Table("joint", "ID", *QUANTITIES, title="limits, stored in the servo | of the map")
    for row in rows:
        table.add_row(row.joint, str(row.id), *(" | ".join(cell) for cell in row.cells))
    console.print(table)
    for line in differences(rows):
        console.print(line)


def find_senses(
    console: Console, servo_map: ServoMap, chosen: Sequence[MappedServo], port: str, *, live: bool, asked: bool
) -> tuple[dict[str, int], list[str]]:
    """Nudge joint after joint, and ask whether it moved as the map says.

    A real port is a dry run without ``live``; where not ``asked``, motion is reported only.

    Returns
    -------
    signs : dict
        What the sign of every joint should be that turned against the map.
    blocked : list
        Joints that did not go where they were sent.

    Raises
    ------
    ReplayInterrupted
        The user does not agree, does not answer, or stopped a nudge.
    VerificationFailed, ReplayAborted
        A servo is not fit to move, or an abort rule ended a nudge; torque is off.
    """
    real = port != VIRTUAL
    angle = f"{math.degrees(ANGLE):g}°"
    if real and live and asked:
        console.print(
            f"{servo_map.robot}: {len(chosen)} joint(s) will turn {angle} and back, one by one; the others limp."
        )
        if not _agreed(console, CLEAR, "move?"):
            raise ReplayInterrupted("not confirmed; nothing was moved")
    agrees: dict[str, bool] = {}
    blocked: list[str] = []
    with bus_on(port, servo_map) as (bus, clock):
        for servo in chosen:
            moved = _nudge(bus, clock, servo_map, servo, live=live or not real)
            if moved is None:
                console.print(f"{servo}: fit to move")
                continue
            answer = _shown(console, moved, asked=asked)
            while answer == "again":
                moved = _nudge(bus, clock, servo_map, servo, live=True) or moved
                answer = _shown(console, moved, asked=asked)
            if not moved.followed:
                blocked.append(servo.joint)
            agrees[servo.joint] = answer == "y"
    if real and not live:
        console.print("dry run: nothing was moved; --live moves")
    signs = swapped(servo_map, agrees)
    for joint, sign in signs.items():
        console.print(f"{joint}: turns against the map; its sign should be {sign}")
    return signs, blocked


def may_write(console: Console, joints: Sequence[str], target: object) -> bool:
    """Ask whether the map is to be changed."""
    return _agreed(console, f"The sign of {', '.join(joints)} is wrong in {target}.", "write it?")


def _nudge(bus: Bus, clock: Clock, servo_map: ServoMap, servo: MappedServo, *, live: bool) -> Nudge | None:
    stop = StopRequest()
    with stop_on_signals(stop):
        return nudge(servo_map, servo, bus, clock, live=live, stop=stop)


def _shown(console: Console, moved: Nudge, *, asked: bool) -> str:
    """Tell what a joint did; "y", "n" or "again"."""
    console.print(
        f"{moved.joint} (ID {moved.id}): {math.degrees(moved.moved):+.1f}° by the map, {moved.ticks:+d} ticks, and back"
    )
    if not asked or not moved.followed:
        return "y"
    sense = "positive" if moved.asked > 0 else "negative"
    answer = ""
    try:
        while answer not in ANSWERS:
            question = f"Did {moved.joint} turn in the {sense} sense first? [{'/'.join(ANSWERS)}]"
            answer = typer.prompt(question).strip().lower()
        return answer
    except typer.Abort:
        raise ReplayInterrupted(f"no answer about {moved.joint}; torque is off, nothing was written") from None


def _agreed(console: Console, text: str, question: str) -> bool:
    console.print(text)
    try:
        return typer.confirm(question)
    except typer.Abort:
        return False
