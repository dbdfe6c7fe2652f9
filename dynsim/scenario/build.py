"""Construction of a scenario's objects: plant in its initial posture, controller, surfaces, contacts and loads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.control import JointControl
from dynsim.compile.mobility import immobile
from dynsim.compile.model import Model
from dynsim.compile.posture import on_surfaces
from dynsim.compile.protocols import BuildContext
from dynsim.compile.shapes import gap_at
from dynsim.config.base import BodyPoint
from dynsim.config.problems import dotted, suggest
from dynsim.errors import ModelError, ScenarioError, brief
from dynsim.library import families
from dynsim.model.description import WORLD, Array, Contact, Foot, Inertia, Load, Robot
from dynsim.model.surfaces import SURFACES, Surface
from dynsim.scenario.candidates import candidates
from dynsim.scenario.schema import ContactPoint, Contacts, Payload, Scenario
from dynsim.system.memo import recall

if TYPE_CHECKING:
    from dynsim.snake.description import SnakeDescription, TaskSpaceController

# A contact point must start this close to its surface [m].
START_TOLERANCE = 1e-6
# A compliant contact point may start at this depth below its surface [m].
PRESSED = 5e-3


def machine(scenario: Scenario) -> Robot | SnakeDescription:
    """The plant of the scenario: a tree of bodies, or the description of a snake."""
    if scenario.engine == "kinematic":
        # Imported here and below: an arm needs nothing of a snake.
        from dynsim.snake.description import SnakeDescription

        return families.build("plant", scenario.plant, BuildContext(scenario.duration_s), SnakeDescription)
    return robot(scenario)


def robot(scenario: Scenario) -> Robot:
    """The tree of bodies with its motors and payloads, in its initial posture.

    Raises
    ------
    ModelError
        The plant is none or cannot be built, a payload is on a body that it does not have, or contact points do not
        reach the surfaces that ``initial`` puts them on.
    """
    built = _loaded(scenario)
    return built if scenario.config.initial is None else _posed(scenario, built, _nameable(scenario, built))


def robot_and_contacts(scenario: Scenario) -> tuple[Robot, list[Contact]]:
    """:func:`robot` and all enabled contacts, each built once."""
    config, built = scenario.config, unposed(scenario)
    touching = contacts(scenario, built)
    if config.initial is None:
        return built, touching
    points = _nameable(scenario, built)
    known = [contact.geometry for contact in points], _first_references(scenario, built)
    return recall("posture", lambda: _posed(scenario, built, points), built, config.initial, *known), touching


def unposed(scenario: Scenario) -> Robot:
    """The robot in the posture of its plant, before ``initial``."""
    config = scenario.config
    beside = (config.objects, config.surfaces, config.contacts) if config.objects else ()
    known = config.plant, config.duration_s, config.loads, config.ties, *beside
    return recall("plant", lambda: _loaded(scenario), *known)


def _loaded(scenario: Scenario) -> Robot:
    """The tree of bodies as its plant says, with payloads."""
    if scenario.engine == "kinematic":
        raise ModelError(f"plant {scenario.plant.type!r} is kinematic: it has no rigid-body model")
    bare = families.build("plant", scenario.plant, BuildContext(scenario.duration_s), Robot)
    inertias: dict[int, list[Inertia]] = {}
    for name, config in scenario.config.loads.items():
        if isinstance(config, Payload):
            body, point, axes = _attached(bare, name, config)
            # One of no mass leaves its link as it is, to the bit.
            if config.mass_kg > 0.0:
                inertias.setdefault(body, [bare.links[body].inertia]).append(_payload(name, config, point, axes))
    links = list(bare.links)
    for body, parts in inertias.items():
        links[body] = replace(links[body], inertia=Inertia.merged(parts))
    loaded = replace(bare, links=tuple(links)) if inertias else bare
    complete = _with_objects(scenario, loaded) if scenario.config.objects else loaded
    return _tied(scenario, complete) if scenario.config.ties else complete


def _with_objects(scenario: Scenario, built: Robot) -> Robot:
    """The robot and the objects beside it, each a tree of its own."""
    objects, surfaces = scenario.config.objects, list(scenario.config.surfaces)
    taken = {*(link.name for link in built.links), *built.joint_names, *(frame.name for frame in built.frames)}
    for name in objects:
        if not name or name == WORLD:
            raise ModelError(
                f"objects: {name!r} cannot be the name of an object; choose another", keys=("objects", name)
            )
        if name in taken:
            text = f"objects.{name}: the robot has a body, joint or frame of that name"
            raise ModelError(text, keys=("objects", name))
    context = BuildContext(scenario.duration_s)
    ties = [tie for name, body in objects.items() for tie in body.ties(name)]
    ties += [tie for name, body in objects.items() if body.grasp is not None for tie in built.holding(name)]
    touching = surfaces if scenario.config.contacts.law == "unilateral" else []
    return replace(
        built,
        links=(*built.links, *(link for name, body in objects.items() for link in body.links(name))),
        motors=(*built.motors, *(motor for name, body in objects.items() for motor in body.motors(name, context))),
        q0=np.concatenate([built.initial, *(body.start() for body in objects.values())]),
        feet=(*built.feet, *(foot for name, body in objects.items() for foot in body.feet(name, touching))),
        ties=(*built.ties, *ties),
        frames=(*built.frames, *(frame for name, body in objects.items() for frame in body.frames(name))),
    )


def _tied(scenario: Scenario, built: Robot) -> Robot:
    """The robot and objects with the ties between them."""
    ties = {name: config.tie(name) for name, config in scenario.config.ties.items()}
    taken = {tie.name for tie in built.ties}
    for name, tie in ties.items():
        if name in taken:
            text = f"ties.{name}: an object has a tie of that name, its spring or that of a gripper; choose another"
            raise ModelError(text, keys=("ties", name))
        for key, body in (("body", tie.body), ("other", tie.other)):
            if key == "other" and body == WORLD:
                continue
            try:
                built.attach(body, tie.point)
            except ModelError as error:
                keys = ("ties", name, key)
                raise ModelError(f"{dotted(keys)}: {error}", keys=keys) from error
    return replace(built, ties=(*built.ties, *ties.values()))


def _nameable(scenario: Scenario, built: Robot) -> list[Contact]:
    """What ``initial`` may name: all contacts, and disabled points, so that braced and free start in one posture."""
    initial = scenario.config.initial
    if initial is None or not initial.on_surface:
        return []
    return [*contacts(scenario, built), *disabled_points(scenario, built)]


def disabled_points(scenario: Scenario, described: Robot) -> list[Contact]:
    """Disabled contact points. They touch nothing, but a start or a path may keep them on their surfaces.

    So the same motion can be simulated with and without a brace.
    """
    options = scenario.config.contacts
    known = surfaces(scenario)
    points = {
        name: point.model_copy(update={"enabled": True})
        for name, point in options.points.items()
        if not point.enabled and point.surface in known
    }
    if not points:
        return []
    only = options.model_copy(update={"points": points, "candidates": "points"})
    alone = replace(scenario, config=scenario.config.model_copy(update={"contacts": only}))
    return contacts(alone, replace(described, feet=()))


def _posed(scenario: Scenario, built: Robot, touching: Sequence[Contact]) -> Robot:
    """The robot in the posture that ``initial`` asks for."""
    initial = scenario.config.initial
    first = _first_references(scenario, built)
    if first is not None:
        built = replace(built, q0=first)
    if initial is None or not initial.on_surface:
        return built
    points = {contact.name: contact for contact in touching}
    for name in initial.on_surface:
        if name in points:
            _check_body(scenario, built, points[name])
    try:
        return replace(built, q0=on_surfaces(Model(built), points, initial.on_surface, initial.keep))
    except ModelError as error:
        raise ModelError(str(error), keys=("initial",)) from error


def _first_references(scenario: Scenario, built: Robot) -> Array | None:
    """Coordinates where waypoints of joints begin, (nq,); None if that is not requested.

    Followers of these joints are where their leaders have them, the other joints where the plant has them.
    """
    initial = scenario.config.initial
    if initial is None or not initial.on_references:
        return None
    waypoints = getattr(scenario.controller, "joints", None)
    if not waypoints:
        raise ModelError("initial.on_references: no joint has waypoints; give controller.joints", keys=("initial",))
    q = built.initial.copy()
    for name, path in waypoints.items():
        if name in built.joint_names:
            q[built.position_index[built.joint_names.index(name)]] = path.values[0]
    places, placed = dict(zip(built.joint_names, built.position_index, strict=True)), {*waypoints}
    # A follower may lead another joint, and couplings have no order.
    for _ in built.couplings:
        for coupling in built.couplings:
            if coupling.leader in placed and coupling.joint not in waypoints:
                q[places[coupling.joint]] = coupling.ratio * q[places[coupling.leader]] + coupling.offset
                placed.add(coupling.joint)
    return q


def build_model(scenario: Scenario) -> Model:
    """The rigid-body model of a scenario's plant.

    Raises
    ------
    ModelError
        The plant has none, or is not physical.
    ScenarioError
        Not a scenario.
    """
    require_scenario(scenario)
    return Model(robot(scenario))


@overload
def controller(
    scenario: Scenario,
    machine: Model,
    progress: Callable[[float], None] | None = None,
    touching: Sequence[Contact] | None = None,
) -> JointControl: ...
@overload
def controller(
    scenario: Scenario, machine: SnakeDescription, progress: Callable[[float], None] | None = None
) -> TaskSpaceController: ...
def controller(
    scenario: Scenario,
    machine: Model | SnakeDescription,
    progress: Callable[[float], None] | None = None,
    touching: Sequence[Contact] | None = None,
) -> JointControl | TaskSpaceController:
    """The controller for a machine.

    Parameters
    ----------
    progress : called with the time [s] that the references have come to
    touching : the contacts of the scenario, when they are built already

    Raises
    ------
    ModelError
        The scenario has none, it is for other machines, or does not fit this one.
    UnreachableReference
        The hand cannot follow its path.
    """
    config = scenario.controller
    if config is None:
        raise ModelError("the scenario has no controller; its motors are short-circuited")
    # Of a snake at whatever level.
    if families.member("plant", scenario.plant.type).ENGINE != families.member("controller", config.type).ENGINE:
        raise ModelError(f"controller {config.type!r} cannot drive a {scenario.plant.type!r}")
    believed = scenario
    if isinstance(machine, Model) and scenario.config.surface_error is not None:
        # What it plans with is not what is there.
        believed = replace(scenario, config=scenario.config.model_copy(update={"surface_error": None}))
        touching = contacts(believed, machine.robot)
    elif touching is None:
        touching = contacts(scenario, machine.robot) if isinstance(machine, Model) else ()
    points = {contact.name: contact for contact in touching}
    declared = [
        name for name, contact in points.items() if name in scenario.config.contacts.points and not contact.left_out
    ]
    unused = disabled_points(believed, machine.robot) if isinstance(machine, Model) else []
    disabled = [contact.name for contact in unused]
    looked = _Looked({**points, **{contact.name: contact for contact in unused}})
    context = BuildContext(
        scenario.duration_s, machine, progress=progress, contacts=looked, declared=declared, disabled=disabled
    )
    if isinstance(machine, Model):

        def built() -> JointControl:
            return families.build("controller", config, context, JointControl)

        def blind() -> JointControl | None:
            # One that looks at no contact is that of all runs of the same machine and section.
            made.append(built())
            return None if looked.at else made[0]

        made: list[JointControl] = []
        known = recall("controller", blind, config, scenario.duration_s, machine, [*points], declared, disabled)
        control = known or (made[0] if made else built())
        # The kernels would follow the last polynomial on.
        if control.end < scenario.duration_s * (1.0 - 1e-6):
            ends = f"end at {control.end:g} s, the run at {scenario.duration_s:g} s"
            raise ModelError(f"controller {config.type!r}: its references {ends}")
        return control
    from dynsim.snake.description import TaskSpaceController

    return families.build("controller", config, context, TaskSpaceController)


class _Looked(Mapping[str, Contact]):
    """Contacts by name, and whether anyone has looked at one."""

    def __init__(self, contacts: Mapping[str, Contact]) -> None:
        self._contacts, self.at = contacts, False

    def __getitem__(self, name: str) -> Contact:
        self.at = True
        return self._contacts[name]

    # Names are known without a look at what they name.
    def __contains__(self, name: object) -> bool:
        return name in self._contacts

    def __iter__(self) -> Iterator[str]:
        return iter(self._contacts)

    def __len__(self) -> int:
        return len(self._contacts)


def surfaces(scenario: Scenario) -> dict[str, Surface]:
    """All surfaces by name, where they are, whether anything touches them or not."""
    context, configs = BuildContext(scenario.duration_s), scenario.config.surfaces
    error = scenario.config.surface_error

    def built() -> dict[str, Surface]:
        nominal: dict[str, Surface] = {
            name: families.build("surface", config, context, SURFACES) for name, config in configs.items()
        }
        if error is None or not any(error.shift_m):
            return nominal
        return {name: surface.shifted(np.array(error.shift_m)) for name, surface in nominal.items()}

    return recall("surfaces", built, scenario.duration_s, configs, error)


def contacts(scenario: Scenario, described: Robot | None = None) -> list[Contact]:
    """All enabled contact points with their surfaces, then the other candidates.

    ``described`` : the robot of the scenario, when it is known already; candidates that are not points are its parts

    Raises
    ------
    ModelError
        A point on a surface that the scenario does not have.
    """
    options = scenario.config.contacts
    known = surfaces(scenario)
    described = robot(scenario) if described is None else described
    result = [_foot(foot, known, options) for foot in described.feet]
    for name, point in options.points.items():
        if not point.enabled:
            continue
        if point.surface not in known:
            keys = ("contacts", "points", name, "surface")
            raise ModelError(
                f"{dotted(keys)} = {point.surface!r}: no such surface{suggest(point.surface, known)}; "
                f"surfaces: {', '.join(known) or 'none'}",
                keys=keys,
            )
        result.append(
            Contact(
                name=name,
                body=point.body,
                point=np.array(point.point_m),
                surface=known[point.surface],
                surface_name=point.surface,
                radius=point.radius_m,
                **_law(options, point),
            )
        )
    if result:
        places = [contact.geometry for contact in result]
        still = recall("left out", lambda: immobile(Model(described), result), described, places)
        result = [replace(contact, left_out=left_out) for contact, left_out in zip(result, still, strict=True)]
    if options.candidates != "points":
        law = _law(options, ContactPoint(body=""))
        # Objects touch with what they are made of, not with their origins.
        beside = {link.name for name, body in scenario.config.objects.items() for link in body.links(name)}
        own = (entry for entry in candidates(options.candidates, described, known, result) if entry.body not in beside)
        result += [replace(contact, **law) for contact in own]
    error = scenario.config.surface_error
    return result if error is None else [_rubbed(contact, error.friction_factor) for contact in result]


def _foot(foot: Foot, known: Mapping[str, Surface], options: Contacts) -> Contact:
    """The contact of what a robot is made to touch with."""
    if foot.surface not in known:
        raise ModelError(f"surfaces: {foot.name} stands on surface {foot.surface!r}, which there is not")
    law = _law(options, ContactPoint(body=foot.body))
    if foot.grip_axis is not None:
        law |= {"grip": 0.0, "grip_axis": foot.grip_axis}
    return Contact(
        foot.name, foot.body, foot.point, known[foot.surface], surface_name=foot.surface, radius=foot.radius, **law
    )


def _rubbed(contact: Contact, factor: float) -> Contact:
    """The contact with its coefficients of friction times a factor."""
    static = None if contact.static_friction is None else factor * contact.static_friction
    viscous = factor * contact.viscous_friction
    return replace(contact, friction=factor * contact.friction, static_friction=static, viscous_friction=viscous)


def _law(options: Contacts, point: ContactPoint) -> dict[str, Any]:
    """What the law of the contacts says of one of them."""
    friction, static = options.coefficients(point)
    stiffness, damping = options.compliance(point)
    if options.law == "bilateral":
        smoothing, pulling = options.slip_smoothing_m_s, options.pulling_friction
        return {"friction": friction, "slip_smoothing": smoothing, "pulling_friction": pulling}
    return {
        "friction": friction,
        "pulling_friction": "signed",
        "static_friction": static,
        "stribeck": options.stribeck_m_s or 0.0,
        "viscous_friction": options.viscous_friction_s_per_m,
        "restitution": options.restitution if point.restitution is None else point.restitution,
        "stiffness": stiffness,
        "damping": damping if stiffness else 0.0,
        **({} if point.grip is None else {"grip": point.grip.ratio, "grip_axis": np.array(point.grip.axis)}),
    }


def loads(scenario: Scenario, robot: Robot) -> list[Load]:
    """Forces and torques from outside on the links of a robot; payloads are part of the links already.

    Raises
    ------
    ModelError
        A load on a body that the robot does not have.
    """
    result = []
    for name, config in scenario.config.loads.items():
        if isinstance(config, Payload):
            continue
        body, point, axes = _attached(robot, name, config)
        knots, coefficients = config.pieces(scenario.duration_s)
        in_body = config.frame == "body"
        if in_body:
            # The axes of a frame fixed on a link are not the link's.
            coefficients = np.einsum("ab,kwbp->kwap", axes, coefficients.reshape(-1, 2, 3, 4)).reshape(-1, 6, 4)
        result.append(Load(name, robot.links[body].name, point, in_body, knots, coefficients, config.hold))
    return result


def _attached(robot: Robot, name: str, config: BodyPoint) -> tuple[int, Array, Array]:
    """Index of the link that a load is on, its point in the link's frame [m], and the axes that it is given in."""
    keys = ("loads", name, "body")
    try:
        index, point = robot.attach(config.body, np.array(config.point_m))
        return index, point, robot.attached_axes(config.body)
    except ModelError as error:
        raise ModelError(f"{dotted(keys)}: {error}", keys=keys) from error


def _payload(name: str, config: Payload, point: Array, axes: Array) -> Inertia:
    """Mass properties of a payload in its link's frame."""
    if config.inertia_kg_m2 is None:
        return Inertia.solid_sphere(config.mass_kg, config.radius_m, point)
    keys = ("loads", name, "inertia_kg_m2")
    payload = Inertia(config.mass_kg, np.zeros(3), np.diag(config.inertia_kg_m2)).placed(axes, point)
    try:
        payload.check(dotted(keys))
    except ModelError as error:
        raise ModelError(str(error), keys=keys) from error
    return payload


def check_start(
    scenario: Scenario,
    model: Model,
    touching: Sequence[Contact],
    q: NDArray[np.float64] | None = None,
    depth: float = START_TOLERANCE,
) -> None:
    """Raise :class:`ModelError` unless every contact is on a body of the robot and starts on its surface.

    One error for all that do not: about the first, and with the names and gaps of the others.
    ``q`` : coordinates at the start, (nq,) [rad or m]; default: the robot's initial ones
    ``depth`` : that a point may have below its surface [m]
    """
    own = q is None
    q = model.robot.initial if q is None else q
    off: list[tuple[Contact, bool, tuple[str, ...], float]] = []
    for contact in touching:
        declared, keys = _keys_of(scenario, contact)
        _check_body(scenario, model.robot, contact)
        gap = gap_at(model, contact, q)
        if scenario.config.contacts.law == "unilateral" and gap > (-PRESSED if contact.stiffness > 0.0 else 0.0):
            continue
        if not -depth <= gap <= START_TOLERANCE:
            off.append((contact, declared, keys, gap))
    if off:
        contact, declared, keys, gap = off[0]
        position = model.point_position(contact.body, contact.point, q)
        remedy = "take another posture to start from; or change the surface"
        if own and scenario.plant.type == "snake":  # `initial` does not place its joints
            remedy = "move the surface or change plant.initial_joints_rad"
        elif own:
            named = [other for other, by_name, *_ in off if by_name and not other.left_out]
            remedy = f"{_remedy(scenario, named)}change the initial configuration or the surface"
        if contact.left_out:
            remedy = "no joint moves it along the normal: move the surface"
        others = ", ".join(f"{other.name} {its:+.4g} m from {other.surface_name!r}" for other, _, _, its in off[1:])
        limit = START_TOLERANCE if gap > 0.0 else depth
        raise ModelError(
            f"{dotted(keys)}: {'its point' if declared else contact.name} starts {gap:+.4g} m "
            f"from surface {contact.surface_name!r} "
            f"(limit {limit:g} m), at {position.tolist()}{f' (also {others})' if others else ''}; "
            f"{remedy}, or disable the contact",
            keys=keys,
        )


def _keys_of(scenario: Scenario, contact: Contact) -> tuple[bool, tuple[str, ...]]:
    """Whether the scenario declares a contact point by name, and the keys that it comes from."""
    declared = contact.name in scenario.config.contacts.points
    return declared, ("contacts", "points", contact.name) if declared else ("contacts", "candidates")


def _check_body(scenario: Scenario, robot: Robot, contact: Contact) -> None:
    """Refuse a contact on a body that the robot does not have, or that does not move."""
    try:
        robot.attach(contact.body, contact.point)
    except ModelError as error:
        keys = (*_keys_of(scenario, contact)[1], "body")
        raise ModelError(f"{dotted(keys)}: {error}", keys=keys) from error


def left_out_warnings(
    scenario: Scenario, contacts: Sequence[Contact], behind_brakes: Mapping[str, float] = MappingProxyType({})
) -> list[str]:
    """Return a sentence for each contact that no joint moves along the normal of its surface.

    behind_brakes : those that only joints with a closed brake would move, by name, and since when [s]
    """
    sentences = []
    for contact in contacts:
        declared, keys = _keys_of(scenario, contact)
        name, surface = dotted(keys) if declared else contact.name, contact.surface_name
        if contact.left_out:
            sentences.append(
                f"{name}: no joint moves this point along the normal of {surface}, so its force changes no motion; "
                "it is left out of the contacts, with a force of zero"
            )
        elif contact.name in behind_brakes:
            sentences.append(
                f"{name}: from t = {behind_brakes[contact.name]:.4g} s on, no joint without a closed brake moves this "
                f"point along the normal of {surface}, so its force changes no motion; it is left out of the contacts, "
                "with a force of zero, while these brakes are closed"
            )
    return sentences


def _remedy(scenario: Scenario, off: Sequence[Contact]) -> str:
    """What puts declared points on their surfaces, for the end of an error; nothing where that was asked for."""
    initial = scenario.config.initial
    already = [] if initial is None else initial.on_surface
    names = [contact.name for contact in off if contact.name not in already]
    return f"`{on_surface_key(scenario, names)}` puts it there; or " if names else ""


def on_surface_key(scenario: Scenario, names: Sequence[str]) -> str:
    """The line of a scenario that puts these points on their surfaces, beside those that are there."""
    initial = scenario.config.initial
    return f"initial: {{on_surface: [{', '.join([*(initial.on_surface if initial else ()), *names])}]}}"


def require_scenario(scenario: object) -> None:
    """Raise :class:`ScenarioError` for what is none, such as the name of one."""
    if not isinstance(scenario, Scenario):
        raise ScenarioError(f"needs a Scenario, not {brief(scenario)}; load_scenario(name or file) gives one")
