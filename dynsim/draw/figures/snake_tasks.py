"""Figures of a snake at work: torques, power, wheel loads, slip, grasps, and motion of objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dynsim.draw.figures import style
from dynsim.draw.figures.snake_view import (
    BODY,
    BOUND,
    LIMIT,
    TARGET,
    above_edge,
    greek,
    interval_starts,
    object_bodies,
    pair_wheels,
)
from dynsim.draw.figures.style import Array
from dynsim.record import Record
from dynsim.record.measures import GRIPPER_STATES
from dynsim.record.poses import ORIENTATION, POSITION
from dynsim.record.quaternion import continuous, of_turn, product, rotated

# Number of servos (with the largest rms torques) that have separate colours; maximum number of objects in a figure.
LOADED, OBJECTS = 4, 4
FAINT = "#C4C4C4"
# A limit is drawn if it is at most this multiple of the largest value; otherwise it is in a note.
NEAR = 3.0
# Colours of the bands for the states of the gripper.
STATES = dict(zip(GRIPPER_STATES, ("#FFFFFF", "#FDEFD3", "#C9E8DC", "#FAE6F0"), strict=True))
HATCHES = {"hardening": "///", "softening": "\\\\\\"}
# Line styles of the events of the gripper.
EVENTS = {"captures": (0, (5, 2)), "slips": (0, (1, 1)), "loses": "-", "releases": (0, (5, 2, 1, 2))}
# Smallest distance on the logarithmic axis [mm].
LEAST = 0.1
# If the gripper is closer to the axis of a hinge than this [m], the hinge angle is computed from its orientation.
ON_AXIS = 0.01


def makers(record: Record) -> dict[str, Callable[[Record], Figure]]:
    """Return the drawing functions by file name for which the record has data."""
    made: dict[str, Callable[[Record], Figure]] = {}
    if _kinds(record):
        made |= {"servos": servos, "servo_loads": servo_loads}
    if "energy_electrical" in record:
        made["power"] = power
    if "contact_normal_force" in record:
        made["wheels"] = wheels
    if "gripper_state" in record:
        made["gripper"] = gripper
    if object_bodies(record):
        made["object"] = objects
    return made


def _kinds(record: Record) -> dict[tuple[float, float, float], list[dict[str, Any]]]:
    """Return the summaries of the servos by their stall torque, nominal torque and gear friction [N m]."""
    kinds: dict[tuple[float, float, float], list[dict[str, Any]]] = {}
    for motor in record.summary.get("motors", ()):
        if "stall_torque_N_m" in motor:
            rated = (
                motor["stall_torque_N_m"],
                motor.get("nominal_torque_N_m", 0.0),
                motor.get("gear_friction_N_m", 0.0),
            )
            kinds.setdefault(rated, []).append(motor)
    return kinds


def servos(record: Record) -> Figure:
    """Draw the shaft torques with stall torque, nominal torque and gear friction; servos of one type share a panel.

    The curves of the most loaded servos are means over short intervals; the range of all servos includes every sample.
    If a joint is driven back, the gear friction adds to the torque of the motor, and the back EMF to its voltage. The
    shaft torque may then exceed the stall torque.
    """
    kinds = _kinds(record)
    heights = [1.0 if k == 0 else 0.6 for k in range(len(kinds))]
    # In a narrow figure the legends are above the panels, in two columns.
    legends = 4 * len(kinds) * style.legend_row() / 72.0 if style.narrow() else 0.0
    title = style.title(record, "servo torques and limits")
    figure = style.new_figure(0.9 + 2.9 * sum(heights) + legends, title)
    axes = figure.subplots(len(kinds), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    starts, far = interval_starts(len(record)), list[str]()
    for axis, ((stall, nominal, friction), motors) in zip(axes, kinds.items(), strict=True):
        order = sorted(motors, key=lambda motor: -motor["torque_rms_N_m"])
        looks = style.variant_styles([motor["joint"] for motor in order[:LOADED]])
        columns = [record.labels["torque"].index(motor["joint"]) for motor in order]
        torques = record["torque"][:, columns]
        time, low, high = record.time[starts], *(_each(f, torques, starts) for f in (np.minimum, np.maximum))
        edges = np.append(time, record.time[-1])
        means = _each(np.add, torques, starts) / np.diff(starts, append=len(torques))[:, None]
        for motor, values in zip(order, means.T[:LOADED], strict=False):
            name = motor["joint"]
            axis.plot(time, values, label=f"{greek(name)} rms {motor['torque_rms_N_m']:.2f} N m", **looks[name])
        everything = f"range of all {len(order)}"
        axis.stairs(
            high.max(axis=1), edges, baseline=low.min(axis=1), fill=True, color=FAINT, lw=0, zorder=1, label=everything
        )
        largest = max(motor["torque_max_N_m"] for motor in motors)
        reach = largest
        for value, text, look in ((stall, "stall", BOUND), (nominal, "nominal", LIMIT)):
            if 0.0 < value <= NEAR * largest:
                _both(axis, value, f"{text} {value:g} N m", **look)
                reach = max(reach, value)
            elif value:
                far.append(f"{text} torque of the {_group(motors)} {value:g} N m")
        if friction:
            _both(axis, friction, f"friction {friction:g} N m", color=style.SKY, lw=1.2)
        axis.set(xlim=(record.time[0], record.time[-1]), ylim=(-1.1 * reach, 1.1 * reach), ylabel="torque [N m]")
        style.legend_beside(axis)
    axes[-1].set_xlabel("time [s]")
    if len(starts) < len(record):
        figure.note(f"Curves: mean over {(record.time[-1] - record.time[0]) / len(starts):.2g} s.")
    if far:
        figure.note(f"Beyond the axes: {', '.join(far)}.")
    if any(friction for _, _, friction in kinds):
        figure.note("Nominal: limit of the rms torque. Friction: what the gear carries without current.")
    _explain_excess(figure, kinds)
    return figure


def _each(function: np.ufunc, values: Array, starts: NDArray[np.int64]) -> Array:
    """Return a function of the values, (T, k), in each interval."""
    return np.asarray(function.reduceat(values, starts, axis=0))


def _group(motors: list[dict[str, Any]]) -> str:
    """Return the common name of servos: "wheels" or "joints"."""
    return "wheels" if motors[0]["joint"].startswith("wheel") else "joints"


def _reach(stall: float, motors: list[dict[str, Any]]) -> float:
    """Return the end of an axis that shows the stall torque and the largest torque of servos [N m]."""
    return 1.1 * max(stall, *(motor["torque_max_N_m"] for motor in motors))


def _explain_excess(figure: style.Drawing, kinds: Mapping[tuple[float, float, float], list[dict[str, Any]]]) -> None:
    """Add a note if the shaft torque of a servo exceeds its stall torque."""
    above = [m for (stall, *_), motors in kinds.items() for m in motors if m["torque_max_N_m"] > 1.001 * stall]
    if above:
        worst = max(above, key=lambda motor: motor["torque_max_N_m"] / motor["stall_torque_N_m"])
        figure.note(
            f"{greek(worst['joint'])}: {worst['torque_max_N_m']:.2f} N m exceeds the stall torque. The servo is driven "
            "back; gear friction and back EMF add to its torque."
        )


def servo_loads(record: Record) -> Figure:
    """Draw the rms and largest torque of each servo next to its nominal torque and its stall torque."""
    kinds = _kinds(record)
    below = style.narrow()
    figure = style.new_figure(2.9 * (len(kinds) if below else 1) + 0.5, style.title(record, "load of each servo"))
    peaks: list[str] = []
    ratios = [len(motors) + 2.0 for motors in kinds.values()]
    shape: Any = {"height_ratios": [1.0] * len(kinds)} if below else {"width_ratios": ratios}
    axes = figure.subplots(len(kinds) if below else 1, 1 if below else len(kinds), squeeze=False, **shape).ravel()
    for axis, ((stall, nominal, _), motors) in zip(axes, kinds.items(), strict=True):
        rms = np.array([motor["torque_rms_N_m"] for motor in motors])
        places = np.arange(len(motors))
        above = (rms > nominal) & (nominal > 0.0)
        for chosen, colour, label in ((~above, style.BLUE, "rms torque"), (above, style.ORANGE, "rms above nominal")):
            if chosen.any():
                axis.bar(places[chosen], rms[chosen], width=0.7, color=colour, label=label)
        axis.plot(
            places, [motor["torque_max_N_m"] for motor in motors], "_", color="black", ms=6, label="largest torque"
        )
        axis.axhline(stall, label="stall torque", **BOUND)
        if nominal:
            axis.axhline(nominal, label="nominal torque", **LIMIT)
        axis.set_xticks(places, [greek(motor["joint"]) for motor in motors], rotation=90)
        axis.set(xlim=(-0.7, len(motors) - 0.3), ylim=(0.0, _reach(stall, motors)), ylabel="torque [N m]")
        axis.grid(axis="x", visible=False)
        worst = max(motors, key=lambda motor: motor["torque_max_N_m"])
        torque = np.abs(record["torque"][:, record.labels["torque"].index(worst["joint"])])
        time = record.time[torque.argmax()]
        peaks.append(f"{greek(worst['joint'])} {worst['torque_max_N_m']:.3g} N m at {time:.3g} s")
    style.legend_below(figure, list(axes), 5)
    figure.note(f"Largest torques: {'; '.join(peaks)}.")
    _explain_excess(figure, kinds)
    return figure


def power(record: Record) -> Figure:
    """Draw the electrical and mechanical power of all motors over time, with their means and totals."""
    figure = style.new_figure(4.4, style.title(record, "power of the motors"))
    axes = figure.subplots(2, 1, sharex=True)
    parts = (("energy_electrical", "electrical", style.ORANGE), ("work_mechanical", "mechanical", style.GREEN))
    length = float(record.time[-1] - record.time[0])
    for axis, (signal, text, colour) in zip(axes, parts, strict=True):
        total = float(record[signal][-1] - record[signal][0])
        mean = f"mean {style.number(total / length, 3)} W, " if length else ""
        label = f"{mean}total {style.number(total, 3)} J"
        # The mean power between samples, so that the area below the line is the energy.
        steps = np.diff(record[signal]) / np.diff(record.time)
        axis.stairs(steps, record.time, color=colour, lw=1.0, baseline=None, label=label)
        axis.axhline(0.0, color=style.GREY, lw=0.6)
        axis.set_ylabel(f"{text}\npower [W]")
        style.legend_above(axis)
    axes[-1].set(xlabel="time [s]", xlim=(record.time[0], record.time[-1] or None))
    figure.align_ylabels(axes)
    return figure


def wheels(record: Record) -> Figure:
    """Draw the load of each wheel pair, the times at which wheels on the ground carry nothing, and slip speeds."""
    figure = style.new_figure(6.2 + 0.6 * style.narrow(), style.title(record, "wheel loads and slip"))
    axes = figure.subplots(3, 1, sharex=True, height_ratios=[1.0, 0.9, 1.0])
    time, pairs, starts = record.time, pair_wheels(record), interval_starts(len(record))
    grounded = record["grounded"] > 0
    slip = 1e3 * np.linalg.norm(record["contact_slip_velocity"], axis=2)
    loads = record["contact_normal_force"]
    # Pairs that are in the air during the whole run have no curves.
    looks = style.variant_styles([pair for pair, columns in pairs.items() if loads[:, columns].any()])
    for k, (pair, columns) in enumerate(pairs.items()):
        touching = loads[:, columns] > 0.0
        bare = grounded[:, k] & ~touching.all(axis=1)
        for where, colour, label in (
            (grounded[:, k], FAINT, "on the ground"),
            (bare, style.DEEP, "a wheel without load"),
        ):
            if where.any():
                axes[1].fill_between(
                    time, k + 0.62, k + 1.38, where=where, step="post", color=colour, lw=0, label=label
                )
        if pair in looks:
            mean = _each(np.add, loads[:, columns].sum(axis=1), starts) / np.diff(starts, append=len(time))
            axes[0].plot(time[starts], mean, label=pair, **looks[pair])
            # Wheels in the air do not slip.
            fastest = _each(np.maximum, np.where(touching, slip[:, columns], 0.0).max(axis=1), starts)
            axes[2].plot(time[starts], fastest, **looks[pair])
    axes[0].set_ylabel("load of the pair\n[N]")
    above_edge(axes[0])
    axes[1].set(ylim=(len(pairs) + 0.5, 0.5), ylabel="wheel pair", yticks=range(1, len(pairs) + 1))
    axes[1].grid(visible=False)
    axes[2].set_ylabel("slip speed\n[mm/s]")
    style.at_least(axes[2], 1.0)
    above_edge(axes[2])
    axes[2].set(xlabel="time [s]", xlim=(time[0], time[-1] or None))
    figure.align_ylabels(axes)
    style.legend_below(figure, axes[:2], 7)
    contacts = {contact["name"]: contact for contact in record.summary.get("contacts", ())}
    named = [contacts[record.labels["contact_normal_force"][k]] for columns in pairs.values() for k in columns]
    slipped = max((1e3 * contact["slip_distance_m"], contact["name"]) for contact in named)
    if air := [pair.removeprefix("pair ") for pair in pairs if pair not in looks]:
        figure.note(f"Pairs in the air during the whole run: {', '.join(air)}.")
    if len(starts) < len(record):
        length = (time[-1] - time[0]) / len(starts)
        figure.note(f"Curves: mean load and largest slip speed in intervals of {length:.2g} s.")
    figure.note(f"Largest slip distance: {style.number(slipped[0], 3)} mm, {slipped[1]}.")
    return figure


def gripper(record: Record) -> Figure:
    """Draw the distance to the nearest grasp frame, and the forces and torques on the grasped object with bounds."""
    grip = None if record.scene is None else record.scene.grip
    forces = _held_forces(record)
    rows = 1 if forces is None else 3
    figure = style.new_figure(1.3 + 1.7 * rows, style.title(record, "the gripper"))
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    axes[0].plot(record.time, np.maximum(1e3 * record["grasp_distance"], LEAST), color=BODY, label="distance")
    style.log_axis(axes[0])
    axes[0].set_ylabel("distance to\nnearest grasp\nframe [mm]")
    if 1e3 * record["grasp_distance"].min() < LEAST:
        figure.note(f"Distances below {LEAST:g} mm are drawn as {LEAST:g} mm.")
    if grip is not None:
        axes[0].axhline(1e3 * grip.capture, label=f"captures within {1e3 * grip.capture:g} mm", **LIMIT)
    if forces is not None:
        bounds = (None, None) if grip is None else (grip.force, grip.torque)
        parts = (("force [N]", "N", bounds[0], ""), ("torque [N m]", "N m", bounds[1], "about "))
        for axis, values, (label, unit, bound, about) in zip(axes[1:], np.split(forces, 2, axis=1), parts, strict=True):
            for (name, look), column in zip(style.variant_styles("xyz").items(), values.T, strict=True):
                axis.plot(record.time, column, label=f"{about}{name}", **look)
            style.at_least(axis, 1e-3)
            if bound is not None and bound <= NEAR * np.abs(values).max():
                _both(axis, bound, f"bound {bound:g} {unit}", **BOUND)
            elif bound is not None:
                figure.note(f"Bound of the {label.partition(' [')[0]}, beyond the axis: {bound:g} {unit}.")
            axis.set_ylabel(label)
    _finish(axes, record)
    axes[-1].set_xlabel("time [s]")
    if forces is not None:
        figure.note("Force and torque of the gripper on the object; x: along the gripper.")
    return figure


def objects(record: Record) -> Figure:
    """Draw the positions of jointed objects and of the head, and joint loads; for free objects, draw the height."""
    bodies = object_bodies(record)
    some = list(bodies)[:OBJECTS]
    note = "" if len(some) == len(bodies) else f" ({len(some)} of {len(bodies)})"
    panels = [panel for name in some for panel in _panels(record, name, bodies[name])]
    subject = (f"the {some[0]}" if len(bodies) == 1 else "objects") + note
    figure = style.new_figure(1.1 + 1.9 * len(panels), style.title(record, subject))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, panel in zip(axes, panels, strict=True):
        panel(axis)
    _finish(axes, record)
    axes[-1].set_xlabel("time [s]")
    return figure


def _panels(record: Record, name: str, body: int) -> list[Callable[[Axes], None]]:
    """Return one drawing function for each panel of an object."""
    assert record.scene is not None
    kind = record.scene.bodies[body].joint.kind
    if kind in ("revolute", "prismatic"):
        loads = _joint_loads(record, name)
        made: list[Callable[[Axes], None]] = [lambda axis: _moved(axis, record, name, body)]
        return [*made, lambda axis: _loaded(axis, record, name, loads)] if loads else made
    made = [lambda axis: _height(axis, record, name, body)]
    ground = [
        k for k, label in enumerate(record.labels.get("contact_normal_force", ())) if label.startswith(f"{name}.")
    ]
    return [*made, lambda axis: _standing(axis, record, name, ground)] if ground else made


def _moved(axis: Axes, record: Record, name: str, body: int) -> None:
    """Draw the coordinate of an object on a hinge or rails, and the gripper's motion along it during a grasp."""
    assert record.scene is not None
    turns = record.scene.bodies[body].joint.kind == "revolute"
    scale, unit = (180.0 / np.pi, "°") if turns else (1e3, "mm")
    own = record["q"][:, record.labels["q"].index(name)]
    last = f"{style.number(scale * own[-1], 3)}{'' if turns else ' '}{unit}"
    # The lines become thinner, because they coincide unless the gripper slips.
    axis.plot(record.time, scale * own, color="#BBBBBB", lw=4.0, label=f"{name}: {last}")
    drawn: tuple[tuple[str, str, dict[str, Any]], ...] = (
        ("w", "gripper", {"color": style.BLUE, "lw": 1.8}),
        ("w_target", "target", {"color": "black", "lw": 0.8}),
    )
    for signal, label, look in drawn:
        tracks = [
            (a, b, scale * (own[a] + _followed(record, record[signal][a:b], body))) for a, b in _holds(record, name)
        ]
        off = max((np.abs(along - scale * own[a:b]).max() for a, b, along in tracks), default=0.0)
        text = f"{label}, at most {style.number(off, 2)}{'' if turns else ' '}{unit} away"
        for a, b, along in tracks:
            axis.plot(record.time[a:b], along, label=text, **look)
    style.at_least(axis, 1.0)
    axis.set_ylabel(f"{'angle' if turns else 'displacement'} of {name} [{unit}]")


def _followed(record: Record, w: Array, body: int) -> Array:
    """Return the rotation of poses ``w`` about the axis of a body's joint, or the displacement along it, (T,)."""
    assert record.scene is not None
    joint = record.scene.bodies[body].joint
    axis = rotated(record[ORIENTATION][0, body].astype(float), np.array(joint.axis))
    turn = product(product(of_turn([0, 0, 1], w[:, 5]), of_turn([0, 1, 0], w[:, 4])), of_turn([1, 0, 0], w[:, 3]))
    tip = w[:, :3] + record.scene.tip * rotated(turn, np.array([1.0, 0.0, 0.0])).T
    if joint.kind == "prismatic":
        return np.asarray((tip - tip[0]) @ axis)
    arm = tip - record[POSITION][0, body]
    arm = arm - np.outer(arm @ axis, axis)
    if np.linalg.norm(arm[0]) < ON_AXIS:
        q = continuous(product(turn, turn[:, :1] * np.array([1.0, -1.0, -1.0, -1.0])[:, None]))
        return np.asarray(np.unwrap(2.0 * np.arctan2(axis @ q[1:], q[0])))
    return np.asarray(np.unwrap(np.arctan2(np.cross(arm[0], arm) @ axis, arm @ arm[0])))


def _joint_loads(record: Record, name: str) -> dict[str, Array]:
    """Return the torques or forces that a hinge or rails exert on their object, by cause."""
    signals = (("friction", "joint_friction", name), ("spring", "tie_force", f"{name}.spring"))
    return {
        text: record[signal][:, record.labels[signal].index(label)]
        for text, signal, label in signals
        if signal in record and label in record.labels[signal]
    }


def _loaded(axis: Axes, record: Record, name: str, loads: dict[str, Array]) -> None:
    assert record.scene is not None
    hinge = record.scene.bodies[object_bodies(record)[name]].joint.kind == "revolute"
    for (text, values), colour in zip(loads.items(), (style.ORANGE, style.PURPLE), strict=False):
        axis.plot(record.time, values, color=colour, label=text)
    style.at_least(axis, 1e-3)
    axis.axhline(0.0, color=style.GREY, lw=0.6)
    axis.set_ylabel(f"torque of the hinge\non {name} [N m]" if hinge else f"force of the rails\non {name} [N]")


def _height(axis: Axes, record: Record, name: str, body: int) -> None:
    height = 1e3 * record[POSITION][:, body, 2].astype(float)
    axis.plot(record.time, 1e3 * record["w_target"][:, 2], "--", color=TARGET, lw=1.0, label="target of the snake")
    axis.plot(record.time, 1e3 * record["w"][:, 2], color=style.BLUE, lw=1.0, label="controlled point")
    rise = style.number(round(float(height[-1] - height[0]), 1) + 0.0)
    axis.plot(record.time, height, color=style.ORANGE, lw=1.2, label=f"{name}: rises by {rise} mm")
    axis.set_ylabel("height [mm]")


def _standing(axis: Axes, record: Record, name: str, columns: list[int]) -> None:
    axis.plot(record.time, record["contact_normal_force"][:, columns].sum(axis=1), color=style.ORANGE)
    axis.set_ylabel(f"load of {name}\non surfaces [N]")
    axis.set_ylim(bottom=0.0)


def _held_forces(record: Record) -> Array | None:
    """Return the forces x, y, z [N] and torques [N m] of the gripper on its object, (T, 6); None at kinematic level."""
    names = [name for name in record.labels.get("tie_force", ()) if name.startswith("gripper.")]
    if not names:
        return None
    # The gripper holds one object at a time. The signal is the force on the first body of a tie, which is the gripper.
    columns = [record.labels["tie_force"].index(name) for name in names]
    return -record["tie_force"][:, columns].reshape(len(record), -1, 6).sum(axis=1)


def _holds(record: Record, name: str) -> list[tuple[int, int]]:
    """Return, for each grasp of an object, its first row and the row after its last row."""
    spans: list[tuple[int, int]] = []
    for event in record.events:
        if event.name != name or event.kind not in ("gripper captures", "gripper releases", "gripper loses"):
            continue
        row = int(np.searchsorted(record.time, event.time - 1e-9))
        if event.kind == "gripper captures":
            spans.append((row, len(record)))
        else:
            spans[-1] = (spans[-1][0], row)
    return [span for span in spans if span[1] > span[0]]


def _finish(axes: Array, record: Record) -> None:
    """Draw bands for the states of the gripper, lines at its events, and legends."""
    happened = {kind: [e.time for e in record.events if e.kind == f"gripper {kind}"] for kind in EVENTS}
    for axis in axes:
        axis.set_xlim(record.time[0], record.time[-1])
        for state, (name, colour) in enumerate(STATES.items()):
            if state > 0 and "gripper_state" in record:
                hatched = {"hatch": HATCHES.get(name), "edgecolor": "#D9B98A"}
                reached = record["gripper_state"] == state
                style.shade(axis, record.time, reached, colour, f"{style.UNLISTED}{name}", **hatched)
        for kind, times in happened.items():
            for time in times:
                axis.axvline(time, color="#555555", ls=EVENTS[kind], lw=0.8, label=f"{style.UNLISTED}{kind}")
        if axis.get_legend_handles_labels()[1]:
            style.legend_beside(axis, 3)
    # Add one legend below all panels.
    named = {
        h.get_label(): h
        for h in (*axes[0].collections, *axes[0].lines)
        if str(h.get_label()).startswith(style.UNLISTED)
    }
    texts = [*STATES, *EVENTS]
    shown = {text: named[style.UNLISTED + text] for text in texts if style.UNLISTED + text in named}
    if shown:
        axes[0].figure.put_below(shown, 7)


def _both(axis: Axes, value: float, label: str, **look: Any) -> None:
    """Draw lines at plus and minus a value."""
    axis.axhline(value, label=f"± {label}", **look)
    axis.axhline(-value, **look)
