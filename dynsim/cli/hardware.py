"""Commands ``dynsim hw …``: replay a record on real or virtual servos, drive them live, and check or configure them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing, nullcontext
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from dynsim.cli.app import QuietOption, ScenarioArgument, SetOption, TrustOption, parsed_overrides
from dynsim.cli.drawing import write_view
from dynsim.cli.output import print_error
from dynsim.cli.teleop import (
    BaseSpeedOption,
    HttpPortOption,
    LongestOption,
    OpenOption,
    SpeedOption,
    TurnOption,
    UntilClosedOption,
    VariantOption,
    new_folder,
    print_address,
    print_drive,
    require,
)
from dynsim.errors import DynsimError, RecordError
from dynsim.hardware.errors import ReplayInterrupted, ServoMapError, VerificationFailed
from dynsim.system import interruption
from dynsim.system.files import file_name, json_text, write_json
from dynsim.system.terminal import Terminal, plain

if TYPE_CHECKING:
    from dynsim.hardware.bus.protocol import Bus, Clock
    from dynsim.hardware.nudge import Nudge
    from dynsim.hardware.replay.check import MotionTask
    from dynsim.hardware.servo_map import MappedServo, ServoMap

hw = typer.Typer(
    no_args_is_help=True,
    help="Replay a record on real or virtual Dynamixel servos. Not a safety device: fit an emergency power switch.",
)
# Leave the wrapping of long lines to the terminal, so that paths can be copied. Disable markup, because "[rad]" is a
# unit, not a style.
console = Terminal(soft_wrap=True, highlight=False, markup=False, emoji=False)


Policy = StrEnum("Policy", ["hold", "decelerate", "off"])


RecordFile = Annotated[Path, typer.Argument(metavar="RECORD", help="Record of a run (record.h5).")]
MapFile = Annotated[Path, typer.Option("--map", help="Servo map: a file, or the name of a shipped map (arm, snake).")]
Port = Annotated[str, typer.Option("--port", help="Serial device, e.g. /dev/ttyUSB0.")]
Rate = Annotated[float | None, typer.Option("--rate", help="Command rate [Hz]; default: the rate in the map.")]
Speed = Annotated[float, typer.Option("--speed", help="Playback speed; 0.5 is half speed.")]
ReplayPort = Annotated[str, typer.Option("--port", help="Serial device, or `virtual` for simulated servos.")]
PolicyOption = Annotated[
    Policy | None, typer.Option("--policy", help="Reaction to a fault; default: the policy in the map.")
]
Live = Annotated[bool, typer.Option("--live", help="Move the robot; without this option, a real port gets a dry run.")]
Yes = Annotated[
    bool,
    typer.Option("--yes", help="Skip the confirmation, unless the start is farther away than safety.start_distance."),
]
Configure = Annotated[bool, typer.Option("--configure", help="Correct EEPROM settings that differ from the map.")]
Faults = Annotated[Path | None, typer.Option("--faults", help="Fault script for virtual servos.")]
Plant = Annotated[str | None, typer.Option("--plant", help="Scenario that provides the load for the virtual servos.")]
PlantVariant = Annotated[str | None, typer.Option("--variant", help="Variant of that scenario.")]


def require_client_library() -> None:
    """Raise DynsimError if the packages for servos are not installed."""
    require("hardware", "dynamixel_sdk", "serial")


@hw.command(epilog="Example: dynsim hw scan --port /dev/ttyUSB0 --map arm")
def scan(
    port: Port,
    map_file: Annotated[Path | None, typer.Option("--map", help="Compare the servos with this servo map.")] = None,
    baud: Annotated[int | None, typer.Option("--baud", help="Scan only at this bit rate [bit/s].")] = None,
) -> None:
    """List the servos that respond at any common bit rate (read-only)."""
    require_client_library()
    from dynsim.hardware.bus import scan as survey
    from dynsim.hardware.bus.control_table import RETURN_DELAY_SECONDS_PER_UNIT, VOLT_PER_UNIT

    servo_map, bauds = _map_and_bauds(map_file, baud, survey.SCAN_BAUD_RATES)
    answers = survey.scan(port, bauds)
    if not answers:
        raise VerificationFailed(
            f"{port}: no servo answered at {', '.join(f'{b}' for b in bauds)} bit/s; check the power and the cable. "
            "MX servos with Protocol 1 firmware do not answer: update them to Protocol 2.0; "
            "AX, RX and EX servos use Protocol 1, which is unsupported"
        )
    owners = {servo.id: servo for servo in servo_map.servos} if servo_map else {}
    table = Table("ID", "model", "fw", "bit/s", "mode", "delay µs", "V", "°C", "torque", "error", "joint")
    for servo in answers:
        registers = servo.registers
        delay = registers["return_delay"] * RETURN_DELAY_SECONDS_PER_UNIT
        volts = registers["present_voltage"] * VOLT_PER_UNIT
        numbers = [f"{delay * 1e6:.0f}", f"{volts:.1f}", f"{registers['present_temperature']:.0f}"]
        error = f"0x{registers['hardware_error']:02x}" if registers["hardware_error"] else "-"
        joint = owners[servo.id].joint if servo.id in owners else "-"
        who = [str(servo.id), servo.model_name, *map(str, (servo.firmware, servo.baud, registers["operating_mode"]))]
        table.add_row(*who, *numbers, "ON" if registers["torque_enable"] else "off", error, joint)
    console.print(table)
    if servo_map:
        _compare_with_map(answers, servo_map)


def _map_and_bauds(map_file: Path | None, baud: int | None, common: tuple[int, ...]) -> tuple[Any, tuple[int, ...]]:
    from dynsim.hardware.servo_map import load_servo_map

    servo_map = load_servo_map(map_file) if map_file else None
    return servo_map, (baud,) if baud else (servo_map.bus.baud,) if servo_map else common


def _compare_with_map(answers: list[Any], servo_map: Any) -> None:

    seen = {servo.id: servo for servo in answers}
    wrong = [f"{servo} did not answer" for servo in servo_map.servos if servo.id not in seen]
    wrong += [f"ID {id_} is not in the map" for id_ in seen if id_ not in servo_map.ids]
    wrong += [
        f"{servo} is {seen[servo.id].model_name}, but {servo.model.name} in the map"
        for servo in servo_map.servos
        if servo.id in seen and seen[servo.id].model != servo.model.number
    ]
    if wrong:
        raise VerificationFailed("; ".join(wrong))
    console.print(f"all {len(seen)} servos in {servo_map.path} answered")


@hw.command(epilog="Example: dynsim hw check results/elbow_comparison/two_elbows/record.h5 --map arm")
def check(
    record: RecordFile, map_file: MapFile, rate: Rate = None, speed: Speed = 1.0, trust: TrustOption = False
) -> None:
    """Check a record against the limits of a servo map (offline)."""
    _, servo_map, motion = _checked(record, map_file, rate, speed, trust)
    _print_check(motion, servo_map)


def _checked(record_file: Path, map_file: Path, rate: float | None, speed: float, trust: bool) -> tuple[Any, Any, Any]:
    from dynsim.hardware.replay.check import check_motion
    from dynsim.hardware.servo_map import load_servo_map
    from dynsim.record import Record

    record, servo_map = Record.load(record_file, trust=trust), load_servo_map(map_file)
    return record, servo_map, check_motion(record, servo_map, rate=rate, speed=speed)


def _print_check(motion: Any, servo_map: Any) -> None:
    table = Table("joint", "quantity", "tightest", "limit", "margin", "at [s]", "origin of the limit")
    for margin in motion.margins:
        numbers = [f"{number:.4f}" for number in (margin.value, margin.limit, margin.margin)]
        table.add_row(margin.joint, f"{margin.quantity} [{margin.unit}]", *numbers, f"{margin.time:.3f}", margin.source)
    console.print(table)
    for warning in motion.warnings:
        console.print(f"warning: {warning}")
    plan = motion.plan
    console.print(
        f"check passed: {motion.duration:.2f} s at {plan.rate:g} Hz, "
        f"bus busy for {plan.cycle_time * 1e3:.2f} of {1e3 / plan.rate:.2f} ms per cycle"
    )
    if tightest := motion.tightest(servo_map):
        margin, part = tightest
        console.print(f"smallest margin: {margin}, {100 * part:.0f} % left")


@hw.command(epilog="Example: dynsim hw replay results/elbow_comparison/two_elbows/record.h5 --map arm --port virtual")
def replay(
    record: RecordFile,
    map_file: MapFile,
    port: ReplayPort,
    rate: Rate = None,
    speed: Speed = 1.0,
    policy: PolicyOption = None,
    out: Annotated[Path | None, typer.Option("--out", help="Output folder; default: results/ROBOT_replay.")] = None,
    live: Live = False,
    yes: Yes = False,
    configure: Configure = False,
    faults: Faults = None,
    plant: Plant = None,
    variant: PlantVariant = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Do not show a progress bar.")] = False,
    trust: TrustOption = False,
) -> None:
    """Check the record, verify and arm the servos, move to the start, replay, and save the measurements.

    Press Ctrl-C once for a controlled stop, twice to switch the torque off.
    """
    require_client_library()
    from dynsim.hardware.ports import VIRTUAL, bus_on
    from dynsim.hardware.replay.session import shown_by

    if (faults or plant) and port != VIRTUAL:
        raise ServoMapError("--faults and --plant require virtual servos; use --port virtual")
    simulated, servo_map, motion = _checked(record, map_file, rate, speed, trust)
    script = _fault_script(faults, servo_map)
    robot = _plant(plant, variant, servo_map, motion.start)
    folder = out or Path("results") / file_name(f"{servo_map.robot}_replay")
    for warning in motion.warnings:
        console.print(f"warning: {warning}")
    moves = live or port == VIRTUAL
    if live and port != VIRTUAL:
        confirm_replay(servo_map, motion, port, asked=not yes)
    with shown_by(folder) as lost:
        result = replayed(
            motion,
            servo_map,
            bus_on(port, servo_map, script=script, plant=robot),
            folder,
            lost,
            quiet=quiet,
            live=moves,
            policy=policy,
            write_eeprom=configure,
            provenance={"port": port, "record": str(record), "simulated": simulated.provenance},
        )
        print_timing(result)
        if moves:
            print_replay(result, "replayed", folder, record)
        else:
            print_dry_run(result)


def replayed(
    motion: Any,
    servo_map: Any,
    connection: Any,
    folder: Path,
    lost: dict[str, BaseException],
    *,
    quiet: bool,
    **options: Any,
) -> Any:
    """Run a replay that signals can stop; show progress unless ``quiet``, and add display errors to ``lost``."""
    from dynsim.hardware.replay.output import StopRequest, displayed, stop_on_signals
    from dynsim.hardware.replay.session import run_replay

    stop = StopRequest()
    with stop_on_signals(stop), nullcontext() if quiet else displayed(console, lost) as observer:
        return run_replay(motion, servo_map, connection, folder, observer=observer, stop=stop, **options)


def print_dry_run(result: Any) -> None:
    """Print the result of a dry run, in which nothing moved."""

    from dynsim.hardware.replay.rules import QUANTITIES, differences

    table = Table("joint", "ID", *QUANTITIES, title="limits: servo | map")
    for row in result.limits:
        table.add_row(row.joint, str(row.id), *(" | ".join(cell) for cell in row.cells))
    console.print(table)
    for line in differences(result.limits):
        console.print(line)
    console.print("dry run: the servos were verified and the bus was timed, but nothing was moved; use --live to move")


def print_replay(result: Any, done: str, folder: Path, record: Path) -> None:
    """Print whether the torque is on after a successful motion, and the command that compares the records."""
    left = "ON, holding" if result.end_state == "holding" else "off"
    console.print(f"{done}; the torque is {left}; measured record: {folder / 'measured.h5'}")
    console.print(f"to compare: dynsim hw compare {record} {folder / 'measured.h5'}")


def _fault_script(path: Path | None, servo_map: Any) -> Any:
    from dynsim.hardware.virtual.faults import load_fault_script

    return load_fault_script(path, servo_map.ids) if path else None


def _plant(scenario: str | None, variant: str | None, servo_map: Any, start: Sequence[float] | None = None) -> Any:
    from dynsim.hardware.virtual.simulated_plant import simulated_arm

    posture = {} if start is None else dict(zip((servo.label for servo in servo_map.servos), start, strict=True))
    return simulated_arm(scenario, variant, servo_map, posture) if scenario else None


def print_timing(result: Any) -> None:
    """Print the timing of the control loop in one line."""
    if timing := result.timing:
        period, longest, lateness, exchange = (
            1e3 * timing[f"{name}_s"] for name in ("period_mean", "period_max", "lateness_p99", "exchange_mean")
        )
        console.print(
            f"{timing['cycles']} cycles, period {period:.3f} ms (max {longest:.3f}), lateness 99 % {lateness:.3f} ms, "
            f"bus {exchange:.2f} ms per cycle, {timing['skipped_cycles']} cycles skipped, "
            f"{timing['missed_statuses']} status packets missed"
        )


@hw.command(epilog="Example: dynsim hw recover results/arm_replay")
def recover(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of a replay that crashed.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Output folder for the record and the summary; default: FOLDER.")
    ] = None,
) -> None:
    """Build a record (marked incomplete) from the data saved by a replay that crashed."""
    from dynsim.hardware.replay import measured
    from dynsim.hardware.replay.output import MEASURED

    record = measured.recover(folder, out)
    span = f", {record.time[0]:.2f} to {record.time[-1]:.2f} s" if len(record) else ""
    state = "complete" if record.complete else "incomplete"
    console.print(f"{len(record)} cycles{span}, {state}: {(out or folder) / MEASURED}")


@hw.command(
    epilog="Example: dynsim hw compare results/elbow_comparison/two_elbows/record.h5 results/arm_replay/measured.h5"
)
def compare(
    record: RecordFile,
    measured: Annotated[Path, typer.Argument(metavar="MEASURED", help="Measured record of a replay (measured.h5).")],
    gate: Annotated[
        Path | None, typer.Option("--gate", help="YAML file with error bounds; exit code 5 if one is exceeded.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Output folder; default: the folder of MEASURED.")] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option(
            "--joint",
            help="Joint to highlight in the figure; repeatable; default: the one with the largest error.",
        ),
    ] = None,
    trust: TrustOption = False,
) -> None:
    """Compare a simulated and a measured run: delay, errors of joints and wheels, torques and currents."""
    from dynsim.hardware.replay.compare import check_gate, compare_records, draw_comparison, load_gate
    from dynsim.record import Record

    bounds = load_gate(gate) if gate else None
    comparison = compare_records(Record.load(record, trust=trust), Record.load(measured, trust=trust))
    folder = out or measured.parent
    # Draw first, because this raises an error for unknown joints.
    figure = draw_comparison(comparison, folder / "comparison.png", joints or ())
    table = Table("joint", "rms [rad]", "max [rad]", "at [s]", "rms, common delay removed [rad]", "own delay [ms]")
    common = not math.isnan(comparison.delay)
    for joint in comparison.joints:
        delay = "-" if math.isnan(joint.delay) else f"{joint.delay * 1e3:.1f}"
        errors = [f"{joint.rms:.5f}", f"{joint.max:.5f}", f"{joint.time_of_max:.3f}"]
        table.add_row(joint.joint, *errors, f"{joint.rms_delay_removed:.5f}" if common else "-", delay)
    console.print(table)
    if comparison.wheels:
        wheels = Table(
            "wheel", "rate: rms [rad/s]", "max [rad/s]", "at [s]", "turned [rad]", "error: max [rad]", "at end"
        )
        for wheel in comparison.wheels:
            rates = [f"{wheel.rate_rms:.4f}", f"{wheel.rate_max:.4f}", f"{wheel.time_of_max:.3f}"]
            angles = [f"{wheel.turned:.3f}", f"{wheel.angle_max:.4f}", f"{wheel.angle_end:+.4f}"]
            wheels.add_row(wheel.wheel, *rates, *angles)
        console.print(wheels)
    if comparison.efforts:
        efforts = Table("joint", "effort", "rms: simulated", "measured", "error: rms", "max", "at [s]")
        for effort in comparison.efforts:
            sizes = (effort.simulated_rms, effort.measured_rms, effort.rms, effort.max)
            numbers = [f"{size:.3f}" for size in (*sizes, effort.time_of_max)]
            efforts.add_row(effort.joint, f"{effort.quantity} [{effort.unit}]", *numbers)
        console.print(efforts)
    why = "" if common else " (no delay explains half of the mean square error over all joints)"
    console.print(f"{comparison.delay_text}{why}, worst joint {comparison.worst.joint}")
    write_json(folder / "comparison.json", comparison.summary())
    console.print(f"figure: {figure}")
    if bounds:
        check_gate(comparison, bounds)


@hw.command(epilog="Example: dynsim hw virtual --map arm --link /tmp/ttyDXL")
def virtual(
    map_file: MapFile,
    faults: Faults = None,
    link: Annotated[Path | None, typer.Option("--link", help="Create this symbolic link to the device.")] = None,
    plant: Plant = None,
    variant: PlantVariant = None,
) -> None:
    """Run virtual servos on a pseudo-terminal to which any Dynamixel tool can connect; stop with Ctrl-C."""
    require_client_library()
    from dynsim.hardware.replay.output import StopRequest, stop_on_signals
    from dynsim.hardware.servo_map import load_servo_map
    from dynsim.hardware.virtual.line import PseudoTerminal, line_for_map

    servo_map = load_servo_map(map_file)
    script = _fault_script(faults, servo_map)
    robot = _plant(plant, variant, servo_map)
    terminal = PseudoTerminal(line_for_map(servo_map, script=script, plant=robot), link)
    stop = StopRequest()
    # Print a plain line, because other programs wait for it.
    print(
        f"{len(servo_map.servos)} virtual servos at {servo_map.bus.baud} bit/s on {plain(link or terminal.device)}",
        flush=True,
    )
    with closing(terminal), stop_on_signals(stop):
        terminal.serve(lambda: stop.count == 0)


@hw.command("map", epilog="Example: dynsim hw map six_axis_arm --model XM430-W350 --out my_arm.yaml")
def draft(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    model: Annotated[
        str | None, typer.Option("--model", help="Servo model for motors that are not Dynamixel servos.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Output file; default: SCENARIO_map.yaml.")] = None,
) -> None:
    """Write a servo map for the robot of a scenario, to be completed with IDs, zeros and signs."""
    from dynsim.hardware.map_draft import draft_map
    from dynsim.scenario import load_scenario
    from dynsim.system.files import write_text

    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    target = out or Path(file_name(f"{loaded.name}_map.yaml"))
    if target.exists():
        raise ServoMapError(f"{target}: already exists; choose another --out")
    write_text(target, draft_map(loaded, model))
    console.print(f"written: {target}; set the IDs, then run `dynsim hw calibrate --map {target} --port PORT`")


@hw.command("stop", epilog="Example: dynsim hw stop --port /dev/ttyUSB0")
def stop_servos(
    port: Port,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="Use the bit rate and the servo IDs of this servo map.")
    ] = None,
    baud: Annotated[int | None, typer.Option("--baud", help="Use only this bit rate [bit/s].")] = None,
) -> None:
    """Switch off the torque of all servos, at all common bit rates, even during a replay.

    This is not a substitute for an emergency power switch.
    """
    require_client_library()
    from dynsim.hardware.bus import scan as survey

    servo_map, bauds = _map_and_bauds(map_file, baud, survey.STOP_BAUD_RATES)
    asked = survey.stop_all(port, bauds, servo_map.ids if servo_map else ())
    on = [id_ for id_, still_on in asked.torque.items() if still_on]
    # Without a map, servos that use a bit rate at which the port failed are not known.
    if on or not asked.torque or (asked.trouble and not servo_map):
        who = f"ID {', '.join(map(str, on))}" if on else "all servos" if asked.torque else "any servo"
        why = f" ({'; '.join(asked.trouble)})" if asked.trouble else ""
        raise VerificationFailed(f"torque off was sent but NOT confirmed by {who}: cut the power{why}")
    console.print(f"torque off, confirmed by {len(asked.torque)} servos")


@hw.command(epilog="Example: dynsim hw schema > servo_map.schema.json")
def schema() -> None:
    """Print the JSON schema of servo maps for your editor."""
    from dynsim.hardware.servo_map import json_schema

    print(json_text(json_schema()), end="")


@hw.command(epilog="Example: dynsim hw calibrate --map my_arm.yaml --port /dev/ttyUSB0")
def calibrate(
    map_file: MapFile,
    port: Port,
    joint: Annotated[list[str] | None, typer.Option("--joint", help="Calibrate only this joint; repeatable.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Output file; default: the map itself.")] = None,
    nudge: Annotated[
        bool, typer.Option("--nudge", help="Turn each joint by 3° and back to check its direction.")
    ] = False,
    live: Annotated[bool, typer.Option("--live", help="Move the robot (with --nudge).")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask questions, only report (with --nudge).")] = False,
    write: Annotated[bool, typer.Option("--write", help="Correct the signs in the map (with --nudge).")] = False,
) -> None:
    """Store the zero position: pose the robot by hand with the torque off, then run this command.

    With --nudge, the command moves the joints one by one instead, to find joints that turn in the wrong direction.
    """
    require_client_library()
    from dynsim.hardware.bus.protocol import NoAnswer, RequestRefused
    from dynsim.hardware.ports import bus_on
    from dynsim.hardware.servo_map import SHIPPED, load_servo_map, mark_turns, read_zero_ticks, write_into_map

    servo_map = load_servo_map(map_file)
    target = out or servo_map.path
    shipped = target.resolve().parent == SHIPPED
    if shipped and (write or not nudge):
        raise ServoMapError(f"{target} is a shipped map; write your own map with --out")
    axles = list(dict.fromkeys(servo.axle for servo in servo_map.servos))
    unknown = [name for name in joint or () if name not in axles]
    if unknown:
        raise ServoMapError(f"{map_file} has no joint {', '.join(unknown)}; joints: {', '.join(axles)}")
    if nudge:
        chosen = [servo for servo in servo_map.servos if servo.axle in (joint or axles)]
        signs, blocked = find_directions(servo_map, chosen, port, live=live, asked=not yes)
        text = f"The sign of {', '.join(signs)} is wrong in {target}."
        if signs and (write or (not shipped and _agreed(text, "correct it?"))):
            write_into_map(servo_map, "sign", signs, target)
            console.print(f"correct signs were written to {target}")
        if blocked:
            raise VerificationFailed(f"{', '.join(blocked)} did not turn as commanded; check for an obstacle")
        return
    if live or yes or write:
        raise ServoMapError("--live, --yes and --write require --nudge: zero ticks are read while the torque is off")
    chosen = [servo for servo in servo_map.servos if (servo.axle in joint if joint else servo.in_position_mode)]
    with bus_on(port, servo_map) as (bus, _):
        ticks = read_zero_ticks(bus, chosen)
        write_into_map(servo_map, "zero_tick", ticks, target)
        try:
            mark_turns(bus, chosen)
        except (NoAnswer, RequestRefused) as error:
            raise VerificationFailed(f"{error}; the turn is not verified, repeat the command") from error
    table = Table("joint", "ID", "old zero", "new zero")
    for servo in chosen:
        table.add_row(servo.joint, str(servo.id), str(servo.zero_tick), str(ticks[servo.joint]))
    console.print(table)
    console.print(f"zero ticks of {len(ticks)} joints written to {target}")


# Command ``dynsim hw drive``: the user drives a simulation in real time, and servos follow it.
EXAMPLE = "Example: dynsim hw drive elbow_comparison --variant two_elbows --map arm --port virtual"
SERVOS = "servos"
"""Name of the subfolder for the measured run."""


def hw_drive(
    scenario: ScenarioArgument,
    map_file: MapFile,
    port: ReplayPort,
    variant: VariantOption = None,
    overrides: SetOption = None,
    rate: Rate = None,
    policy: PolicyOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Output folder; default: a new folder results/SCENARIO/drive_N."),
    ] = None,
    speed: SpeedOption = 0.1,
    turn: TurnOption = 0.5,
    base_speed: BaseSpeedOption = 0.3,
    longest: LongestOption = 600.0,
    http_port: HttpPortOption = 0,
    until_closed: UntilClosedOption = False,
    open_: OpenOption = True,
    live: Live = False,
    yes: Yes = False,
    configure: Configure = False,
    faults: Faults = None,
    quiet: QuietOption = False,
) -> None:
    """Drive a scenario live, as with `dynsim teleop`, while servos follow the simulated joints.

    As in a replay, the servos are verified and armed, and move to the start. Every posture is checked against the map
    before it is sent. Press Ctrl-C once for a controlled stop, twice to switch the torque off. The button on the page
    ends the drive normally.
    """
    require("live", "websockets")
    require_client_library()
    from dynsim.engine.recording import RUN_FILES
    from dynsim.hardware.ports import VIRTUAL, bus_on
    from dynsim.hardware.replay.check import check_drive
    from dynsim.hardware.replay.session import shown_by
    from dynsim.hardware.servo_map import load_servo_map
    from dynsim.scenario import load_scenario
    from dynsim.system.files import check_writable
    from dynsim.teleop.snake import SpeedLimits
    from dynsim.teleop.web.follower import DriveRequest, SimulationProcess

    if faults and port != VIRTUAL:
        raise ServoMapError("--faults requires virtual servos; use --port virtual")
    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    servo_map = load_servo_map(map_file)
    script = _fault_script(faults, servo_map)
    folder = out or new_folder(Path("results", loaded.name))
    check_writable(folder, RUN_FILES)
    limits = SpeedLimits(speed, turn, base_speed)
    request = DriveRequest(loaded, servo_map, limits, longest, http_port, until_closed, folder)
    moves = live or port == VIRTUAL
    result: Any = None
    with SimulationProcess(request) as process:
        with console.status("loading the kernels; on first use, compiling them takes half a minute"):
            ready = process.ready()
        motion = check_drive(
            ready.first, servo_map, process.feed, step=ready.step, longest=longest, rate=rate, scene=ready.still.scene
        )
        if live and port != VIRTUAL:
            confirm_replay(servo_map, motion, port, asked=not yes, at_most=True)
        if moves:
            print_address(ready.address, "Ctrl-C stops the robot; a second Ctrl-C switches the torque off", open_=open_)
            console.print("The servos are armed when this page is open in a browser.")
            process.wait_for_pilot()
        posture = dict(zip(servo_map.joints, motion.start.tolist(), strict=True))
        done: Any = None
        error: DynsimError | None = None

        def finish(ended: str) -> None:
            """Save the drive before anything is printed, because nobody may read it; defer signals meanwhile."""
            nonlocal done
            interruption.keep()
            try:
                done = process.finish(ended)
            except DynsimError as lost_drive:
                done = lost_drive
            interruption.heed()

        try:
            with shown_by(folder / SERVOS) as lost:
                try:
                    result = replayed(
                        motion,
                        servo_map,
                        bus_on(port, servo_map, script=script, posture=posture, in_wall_time=True),
                        folder / SERVOS,
                        lost,
                        quiet=quiet,
                        live=moves,
                        policy=policy,
                        write_eeprom=configure,
                        provenance={
                            "port": port,
                            "record": str(folder / "record.h5"),
                            "simulated": ready.still.provenance,
                        },
                    )
                except Exception as stopped:
                    finish(f"the servos stopped: {stopped}")
                    raise
                finish("ended")
        except DynsimError as stopped:
            error, result = stopped, getattr(stopped, "result", None)
        if isinstance(done, DynsimError):
            if error is None:
                raise done
            print_error(done)
            raise error
    if result is not None and not quiet:
        print_timing(result)
    if not moves and error is None:
        print_dry_run(result)
        return
    if done.saved:
        _write_page(loaded.variant or loaded.name, folder, result, quiet=quiet)
        if not quiet:
            print_drive(done.report, done.driven, folder)
    if error is None and not quiet:
        print_replay(result, "driven", folder / SERVOS, folder / "record.h5")
    if error is not None and done.failure is not None:
        print_error(f"simulation: {done.failure}")
    if failure := error or done.failure:
        raise failure


def _write_page(name: str, folder: Path, result: Any, *, quiet: bool) -> None:
    """Write the page that shows the measured robot next to the simulated one."""
    from dynsim.record import Record

    records = {name: Record.load(folder / "record.h5")}
    if result is not None and len(result.record):
        records["measured"] = result.record
    write_view(records, folder, quiet)


# Command ``dynsim import``: the user converts recorded joint positions to a record that servos can replay.
IMPORT_EXAMPLE = "Example: dynsim import demonstration.csv --map arm --unit deg"
PositionUnit = StrEnum("PositionUnit", ["rad", "deg", "tick"])


def import_recording(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="CSV file with columns for time and joints, MCAP file with joint states, or record with positions.",
        ),
    ],
    map_file: MapFile,
    unit: Annotated[
        PositionUnit | None,
        typer.Option("--unit", help="Unit of columns whose names contain no unit, as in `elbow [deg]`."),
    ] = None,
    bandwidth: Annotated[
        float | None,
        typer.Option(
            "--bandwidth", help="Bandwidth of the motion [Hz]; default: a sixth of the sampling rate, max. 5."
        ),
    ] = None,
    rate: Annotated[
        float | None, typer.Option("--rate", help="Sampling rate of the record [Hz]; default: the rate in the map.")
    ] = None,
    topic: Annotated[
        str | None, typer.Option("--topic", help="Topic in an MCAP file; default: the only one with joint states.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Output file; default: the name of FILE with the suffix .h5.")
    ] = None,
    trust: TrustOption = False,
) -> None:
    """Import recorded joint positions as a smooth motion with velocities, for `dynsim hw replay`."""
    from dynsim.hardware.imported import import_motion
    from dynsim.hardware.servo_map import load_servo_map
    from dynsim.system.inputs import check_file

    check_file(file, RecordError)
    target = out or file.with_suffix(".h5")
    if target.exists() and target.samefile(file):
        raise RecordError(f"{file} would be overwritten; choose another file with --out")
    record, joints, notes = import_motion(
        file,
        load_servo_map(map_file),
        unit=unit.value if unit else None,
        bandwidth=bandwidth,
        rate=rate,
        topic=topic,
        trust=trust,
    )
    record.save(target)
    table = Table("joint", "samples at [Hz]", "deviation: rms [mrad]", "max [mrad]", "outliers")
    for joint in joints:
        numbers = (f"{1 / joint.step:.4g}", f"{1e3 * joint.rms:.3g}", f"{1e3 * joint.max:.3g}")
        table.add_row(joint.joint, *numbers, str(len(joint.outliers)))
    console.print(table)
    for note in notes:
        console.print(f"note: {note}")
    console.print(
        f"cubic smoothing spline, bandwidth {joints[0].bandwidth:.3g} Hz (half amplitude), {len(record)} samples in "
        f"{record.time[-1]:.2f} s"
    )
    console.print(f"written: {target}\nto check: dynsim hw check {target} --map {map_file}")


# Prompts of the commands that move a robot: before a replay, and when the joints are nudged one by one.
ANSWERS = ("y", "n", "again")
CLEAR = "Is everyone clear of the robot, and is the emergency power switch within reach?"


def confirm_replay(servo_map: ServoMap, motion: MotionTask, port: str, *, asked: bool, at_most: bool = False) -> None:
    """Show the distance to the start and ask for confirmation.

    Parameters
    ----------
    servo_map : ServoMap
        Map of the servos.
    motion : MotionTask
        Motion to confirm.
    port : str
        Serial device.
    asked : bool
        Whether to ask for confirmation. If the start is farther than ``safety.start_distance``, it is always requested.
    at_most : bool, optional
        Whether the motion may end before ``motion.duration``.

    Raises
    ------
    ReplayInterrupted
        If the user declines or does not answer.
    PortError, VerificationFailed
        If the posture cannot be read.
    """
    from dynsim.hardware.ports import bus_on
    from dynsim.hardware.replay.rules import way_to_start

    with bus_on(port, servo_map) as (bus, _):
        distances, duration = way_to_start(bus, servo_map, motion.start)
    console.print(
        f"{servo_map.robot}: {len(servo_map.servos)} servos will move for {'at most ' if at_most else ''}"
        f"{motion.duration:.1f} s, after an approach of {duration:.1f} s."
    )
    for distance in distances[:1]:
        console.print(f"largest distance to the start: {distance}")
    agreed = not asked or _agreed(CLEAR, "move?")
    bound = servo_map.safety.start_distance
    if agreed and (far := [distance for distance in distances if distance.size > bound]):
        still = "" if asked else " (this requires confirmation even with --yes)"
        console.print(f"these joints are more than safety.start_distance = {bound:g} rad from the start{still}:")
        for distance in far:
            console.print(f"  {distance}")
        agreed = _agreed("All joints will move to the start together. Is their path clear?", "move to the start?")
    if not agreed:
        raise ReplayInterrupted("not confirmed; nothing was moved")


def find_directions(
    servo_map: ServoMap, chosen: Sequence[MappedServo], port: str, *, live: bool, asked: bool
) -> tuple[dict[str, int], list[str]]:
    """Nudge the joints one by one, and ask whether each joint moved in the direction given by the map.

    Parameters
    ----------
    servo_map : ServoMap
        Map of the servos.
    chosen : sequence of MappedServo
        Servos to nudge.
    port : str
        Serial device, or ``VIRTUAL``.
    live : bool
        Whether to move the robot; if False, a real port gets a dry run.
    asked : bool
        Whether to ask the user; if False, the motion is only reported.

    Returns
    -------
    signs : dict of str to int
        Correct sign of every joint that turned opposite to the direction in the map.
    blocked : list of str
        Joints that did not reach their goals.

    Raises
    ------
    ReplayInterrupted
        If the user declines, does not answer, or stops a nudge.
    VerificationFailed, ReplayAborted
        If a servo is not ready to move, or an abort rule ends a nudge; the torque is off then.
    """
    from dynsim.hardware.nudge import ANGLE
    from dynsim.hardware.ports import VIRTUAL, bus_on

    real = port != VIRTUAL
    angle = f"{math.degrees(ANGLE):g}°"
    if real and live and asked:
        console.print(
            f"{servo_map.robot}: {len(chosen)} joint(s) will turn {angle} and back, one by one; the others stay limp."
        )
        if not _agreed(CLEAR, "move?"):
            raise ReplayInterrupted("not confirmed; nothing was moved")
    agrees: dict[str, bool] = {}
    blocked: list[str] = []
    with bus_on(port, servo_map) as (bus, clock):
        for servo in chosen:
            moved = _nudge(bus, clock, servo_map, servo, live=live or not real)
            if moved is None:
                console.print(f"{servo}: ready to move")
                continue
            answer = _ask_direction(moved, asked=asked)
            while answer == "again":
                moved = _nudge(bus, clock, servo_map, servo, live=True) or moved
                answer = _ask_direction(moved, asked=asked)
            if not moved.followed:
                blocked.append(servo.joint)
            agrees[servo.joint] = answer == "y"
    if real and not live:
        console.print("dry run: nothing was moved; use --live to move")
    signs: dict[str, int] = {
        servo.joint: -servo.sign for servo in servo_map.servos if not agrees.get(servo.joint, True)
    }
    for joint, sign in signs.items():
        console.print(f"{joint} turns opposite to the direction in the map; its sign should be {sign}")
    return signs, blocked


def _nudge(bus: Bus, clock: Clock, servo_map: ServoMap, servo: MappedServo, *, live: bool) -> Nudge | None:
    from dynsim.hardware.nudge import nudge
    from dynsim.hardware.replay.output import StopRequest, stop_on_signals

    stop = StopRequest()
    with stop_on_signals(stop):
        return nudge(servo_map, servo, bus, clock, live=live, stop=stop)


def _ask_direction(moved: Nudge, *, asked: bool) -> str:
    """Print how far a joint moved, and ask whether the direction was right; return "y", "n" or "again"."""
    console.print(
        f"{moved.joint} (ID {moved.id}): {math.degrees(moved.moved):+.1f}° (map), {moved.ticks:+d} ticks, and back"
    )
    if not asked or not moved.followed:
        return "y"
    direction = "positive" if moved.asked > 0 else "negative"
    answer = ""
    try:
        while answer not in ANSWERS:
            question = f"Did {moved.joint} turn in the {direction} direction first? [{'/'.join(ANSWERS)}]"
            answer = typer.prompt(question).strip().lower()
        return answer
    except typer.Abort:
        raise ReplayInterrupted(f"no answer about {moved.joint}; the torque is off, and nothing was written") from None


def _agreed(text: str, question: str) -> bool:
    console.print(text)
    try:
        return typer.confirm(question)
    except typer.Abort:
        return False
