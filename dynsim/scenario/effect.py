"""Warnings about keys that a scenario sets although they have no effect."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from dynsim.config.problems import dotted
from dynsim.library.families import engine

Keys = tuple[int | str, ...]

# Sections that only the dynamics engine uses.
OF_DYNAMICS = ("contacts", "initial", "integrator", "metrics")
# Sections of joint_pd that define a moving reference or plan voltages along it.
MOVING = ("hand", "base", "joints", "torques", "brace")


def without_effect(scenario: Any, motors: bool = True) -> list[str]:
    """Return a warning for each key that the scenario sets but that has no effect, with location and reason.

    Parameters
    ----------
    scenario : Scenario
        Validated scenario.
    motors : bool, optional
        Whether the plant has motors.
    """
    config = scenario.config
    texts: dict[Keys, str] = {}
    if config.controller is not None and not motors:
        texts[("controller",)] = texts[("sensors", "encoders")] = "the plant has no motors"
    for keys, why in idle_keys(config).items():
        if keys[:1] not in texts:
            texts[keys] = why
    return [
        f"{dotted(keys)} has no effect: {why} ({scenario.location(keys)})"
        for keys, why in texts.items()
        if is_set(config, keys)
    ]


def idle_keys(config: Any) -> dict[Keys, str]:
    """Return all keys that have no effect, whether set or not, with the reason for each."""
    kinematic = engine(config.plant) == "kinematic"
    rules = (
        [_of_kinematics(config)] if kinematic else [_of_integrator(config), _of_contacts(config), _of_sensors(config)]
    )
    return dict(pair for rule in (*rules, _of_controller(config), _of_time(config)) for pair in rule)


def is_set(config: BaseModel, keys: Keys) -> bool:
    """Return whether the file, the variant or an override sets the key."""
    node: Any = config
    for key in keys:
        if isinstance(node, BaseModel):
            if key not in node.model_fields_set or getattr(node, str(key)) is None:
                return False
            node = getattr(node, str(key))
        else:
            node = node[key]
    return True


def _of_kinematics(config: Any) -> Iterator[tuple[Keys, str]]:
    """Yield the keys about forces and integration, which a kinematic plant ignores."""
    for section in OF_DYNAMICS:
        part = getattr(config, section)
        for key in () if part is None else type(part).model_fields:
            yield (section, key), f"plant {config.plant.type} is kinematic"
    for section in ("loads", "ties", "mass_error", "sensors"):
        yield (section,), f"plant {config.plant.type} is kinematic"
    if hasattr(config.plant, "dynamics"):
        yield ("plant", "dynamics"), "plant.level is kinematic"


def _of_integrator(config: Any) -> Iterator[tuple[Keys, str]]:
    if config.integrator.method != "time_stepping":
        return
    why = "time_stepping takes steps of integrator.step_s"
    yield ("integrator", "rtol"), why
    yield ("integrator", "step_max_s"), why
    if config.contacts.law != "unilateral":  # under this law atol is the speed below which slip has no direction
        yield ("integrator", "atol"), why


def _of_contacts(config: Any) -> Iterator[tuple[Keys, str]]:
    contacts = config.contacts
    if contacts.law == "unilateral":
        yield ("contacts", "reference_tolerance_m"), "it requires law: bilateral; unilateral braces may lift off"
    has_feet = getattr(config.plant, "level", "") == "dynamic"
    # Free objects always have contacts at their corners and wheels.
    touches = contacts.law == "unilateral" and any(body.joint is None for body in config.objects.values())
    if not contacts.points and contacts.candidates == "points" and not (has_feet or touches or contacts.between):
        for key in type(contacts).model_fields:
            if key not in ("law", "candidates", "points", "between", "reference_tolerance_m"):
                yield ("contacts", key), "contacts.points is empty, and contacts.candidates is points"
    carried = {name: body for name, part in config.surfaces.items() if (body := getattr(part, "on", None)) is not None}
    if contacts.candidates != "points" and len(carried) == len(config.surfaces):
        yield ("contacts", "candidates"), f"the scenario has no surfaces{' in the world' if carried else ''}"
    touched = {point.surface for point in contacts.points.values()}
    for name, body in carried.items():
        # Free objects touch all surfaces that they do not carry.
        feet = touches and any(part.joint is None and key != body for key, part in config.objects.items())
        if name not in touched and not (has_feet or feet):
            yield ("surfaces", name), f"no contact point and no free object can touch a surface on {body}"
    for name, point in contacts.points.items():
        if point.grip is not None and point.grip.ratio == 1.0:
            yield ("contacts", "points", name, "grip"), "ratio 1 means equal friction in all directions"


def _of_controller(config: Any) -> Iterator[tuple[Keys, str]]:
    controller = config.controller
    if controller is None or controller.type != "joint_pd":
        return
    moves = any(getattr(controller, key) for key in MOVING) or controller.feed_forward != "none"
    if not moves:
        yield ("controller", "knot_spacing_s"), "all references are constant"


def _of_sensors(config: Any) -> Iterator[tuple[Keys, str]]:
    """Yield unused sensors; a snake controller uses at most one sensor."""
    state = getattr(config.controller, "state", None)
    if config.sensors is None or state is None:
        return
    read = {"estimated": "encoders", "measured": "motion_capture"}.get(state)
    for sensor in ("encoders", "motion_capture"):
        if sensor != read:
            yield ("sensors", sensor), f"controller.state is {state}"


def _of_time(config: Any) -> Iterator[tuple[Keys, str]]:
    """Yield references, loads and commands that start after the end of the run."""
    end = config.duration_s
    ends = f"the run ends at {end:g} s"
    settle = config.metrics.settle_s
    if settle >= end and settle != type(config.metrics).model_fields["settle_s"].default:
        yield ("metrics", "settle_s"), f"{ends}, so no tracking error is evaluated"
    for name, load in config.loads.items():
        first = getattr(load, "times_s", None)
        if first is None and load.type == "csv":
            first = load.pieces(end)[0]
        if first is not None and first[0] >= end and not getattr(load, "hold", False):
            yield ("loads", name), f"it begins at {first[0]:g} s, but {ends}"
    controller = config.controller
    if controller is None:
        return
    timed: list[tuple[Keys, Any]] = []
    for section in ("hand", "base"):
        if (part := getattr(controller, section, None)) is not None:
            timed.append((("controller", section, "path"), part.path))
    for section in ("joints", "torques"):
        parts = getattr(controller, section, None)
        if isinstance(parts, dict):
            timed += [(("controller", section, name), part) for name, part in parts.items()]
    operator = getattr(controller, "operator", None)
    owners: tuple[tuple[Keys, Any], ...] = ((("controller",), controller), (("controller", "operator"), operator))
    for keys, owner in owners:
        commands = getattr(owner, "commands", None) or ()
        timed += [((*keys, "commands", k), command) for k, command in enumerate(commands)]
    for keys, part in timed:
        begins = _begins(part)
        if begins is not None and begins >= end:
            yield keys, f"it begins at {begins:g} s, but {ends}"


def _begins(part: Any) -> float | None:
    """Return the start time of a path, waypoints or a command [s]; None if unknown."""
    for name in ("start_s", "at_s"):
        if isinstance(value := getattr(part, name, None), int | float):
            return float(value)
    if times := getattr(part, "times_s", None):
        return float(times[0])
    rows = getattr(part, "_rows", None)
    return None if rows is None else float(rows[0][0])
