"""Build the objects of a scenario: plant in its initial posture, controller, surfaces, contacts and loads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dynsim.compile.control import JointControl
from dynsim.compile.mobility import immobile
from dynsim.compile.model import Model
from dynsim.compile.posture import on_surfaces
from dynsim.compile.protocols import BuildContext
from dynsim.compile.solids import solids_of
from dynsim.compile.touching import gap_at, separation
from dynsim.config.base import BodyPoint
from dynsim.config.problems import dotted, errors_at, suggest
from dynsim.errors import ModelError, ScenarioError, brief
from dynsim.library import families
from dynsim.model.description import WORLD, Array, Contact, Foot, Inertia, Load, Robot
from dynsim.model.surfaces import Box, Capsule, SolidPair, Surface
from dynsim.scenario import between
from dynsim.scenario.candidates import candidates, unused
from dynsim.scenario.schema import ContactLaw, ContactPoint, Contacts, LinkSensorConfig, Payload, Scenario
from dynsim.system.arguments import names_wrong_types
from dynsim.system.memo import recall

if TYPE_CHECKING:
    from dynsim.snake.description import SnakeDescription, TaskSpaceController

# Maximum distance of a contact point from its surface at the start [m].
START_TOLERANCE = 1e-6
# Maximum initial depth of a compliant contact point below its surface [m].
PRESSED = 5e-3


def machine(scenario: Scenario) -> Robot | SnakeDescription:
    """Build the plant of the scenario: a tree of bodies, or the description of a snake."""
    if scenario.engine == "kinematic":
        # Imported here and below because an arm does not need the snake modules.
        from dynsim.snake.description import SnakeDescription

        return families.build("plant", scenario.plant, BuildContext(scenario.duration_s), SnakeDescription)
    return robot(scenario)


def robot(scenario: Scenario) -> Robot:
    """Build the tree of bodies with motors and payloads, in its initial posture.

    Raises
    ------
    ModelError
        If the plant has no rigid-body model or cannot be built, a payload is on an unknown body, or contact points
        cannot reach the surfaces that ``initial`` requires.
    """
    built = _loaded(scenario)
    return built if scenario.config.initial is None else _posed(scenario, built, _nameable(scenario, built))


def robot_and_contacts(scenario: Scenario) -> tuple[Robot, list[Contact]]:
    """Return :func:`robot` and all enabled contacts, building each only once."""
    config, built = scenario.config, unposed(scenario)
    touching = contacts(scenario, built)
    if config.initial is None:
        return built, touching
    points = _nameable(scenario, built)
    known = [contact.geometry for contact in points], _first_references(scenario, built)
    return recall("posture", lambda: _posed(scenario, built, points), built, config.initial, *known), touching


def unposed(scenario: Scenario) -> Robot:
    """Build the robot in the posture of its plant, before ``initial`` is applied."""
    config = scenario.config
    beside = (config.objects, config.surfaces, config.contacts) if config.objects else ()
    known = config.plant, config.duration_s, config.loads, config.ties, config.mass_error, *beside
    return recall("plant", lambda: _loaded(scenario), *known)


def _loaded(scenario: Scenario) -> Robot:
    """Build the plant's tree of bodies with payloads, objects and ties."""
    if scenario.engine == "kinematic":
        raise ModelError(f"plant {scenario.plant.type!r} is kinematic and has no rigid-body model")
    bare = families.build("plant", scenario.plant, BuildContext(scenario.duration_s), Robot)
    factor = 1.0
    if (error := scenario.config.mass_error) is not None:
        factor = error.payload_factor
        bare = replace(
            bare,
            links=tuple(replace(link, inertia=link.inertia.times(error.robot_factor)) for link in bare.links),
            motors=tuple(replace(motor, mass=error.robot_factor * motor.mass) for motor in bare.motors),
        )
    inertias: dict[int, list[Inertia]] = {}
    for name, config in scenario.config.loads.items():
        if isinstance(config, Payload):
            body, point, axes = _attached(bare, name, config)
            # A massless payload leaves the data of its link bit-identical.
            if config.mass_kg > 0.0:
                inertias.setdefault(body, [bare.links[body].inertia]).append(
                    _payload(name, config, point, axes).times(factor)
                )
    links = list(bare.links)
    for body, parts in inertias.items():
        links[body] = replace(links[body], inertia=Inertia.merged(parts))
    loaded = replace(bare, links=tuple(links)) if inertias else bare
    complete = _with_objects(scenario, loaded) if scenario.config.objects else loaded
    return _tied(scenario, complete) if scenario.config.ties else complete


def _with_objects(scenario: Scenario, built: Robot) -> Robot:
    """Return the robot with the objects, each a separate tree."""
    objects, surfaces = scenario.config.objects, list(scenario.config.surfaces)
    taken = {*(link.name for link in built.links), *built.joint_names, *(frame.name for frame in built.frames)}
    for name in objects:
        if not name or name == WORLD:
            raise ModelError(
                f"objects: {name!r} is not a valid name for an object; choose another", keys=("objects", name)
            )
        if name in taken:
            text = f"objects.{name}: the robot has a body, joint or frame with this name; choose another"
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
    """Return the robot and objects with the ties between them."""
    ties = {name: config.tie(name) for name, config in scenario.config.ties.items()}
    taken = {tie.name for tie in built.ties}
    for name, tie in ties.items():
        if name in taken:
            text = f"ties.{name}: this name is used by the spring or gripper of an object; choose another"
            raise ModelError(text, keys=("ties", name))
        for key, body in (("body", tie.body), ("other", tie.other)):
            if key == "other" and body == WORLD:
                continue
            with errors_at("ties", name, key):
                built.attach(body, tie.point)
    return replace(built, ties=(*built.ties, *ties.values()))


def _nameable(scenario: Scenario, built: Robot) -> list[Contact]:
    """Return the contacts that may be listed in ``initial``.

    Disabled points are included, so that variants with and without a brace can start in the same posture.
    """
    initial = scenario.config.initial
    if initial is None or not initial.on_surface:
        return []
    return [*contacts(scenario, built), *disabled_points(scenario, built)]


def disabled_points(scenario: Scenario, described: Robot) -> list[Contact]:
    """Return the disabled contact points.

    They make no contact, but a start posture or a path may keep them on their surfaces, so that the same motion can be
    simulated with and without a brace.
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
    """Return the robot in the posture that ``initial`` requires."""
    initial = scenario.config.initial
    references = _first_references(scenario, built)
    if references is not None:
        built = replace(built, q0=references)
    if initial is None or not initial.on_surface:
        return built
    points = {contact.name: contact for contact in touching}
    for name in initial.on_surface:
        if name in points:
            check_body(scenario, built, points[name])
            if points[name].slot:
                first = touching[[*points].index(name) - points[name].slot]
                text = f"initial.on_surface: {name!r} is a further contact of a pair; use {first.name!r}"
                raise ModelError(text, keys=("initial", "on_surface"))
    try:
        return replace(built, q0=on_surfaces(Model(built), points, initial.on_surface, initial.keep))
    except ModelError as error:
        raise ModelError(str(error), keys=("initial",)) from error


def _first_references(scenario: Scenario, built: Robot) -> Array | None:
    """Return the coordinates at the first waypoints of the joints, shape (nq,); None if not requested.

    Coupled joints follow their leaders; all other joints keep the plant's posture.
    """
    initial = scenario.config.initial
    if initial is None or not initial.on_references:
        return None
    waypoints = getattr(scenario.controller, "joints", None)
    if not waypoints:
        raise ModelError("initial.on_references: no joint has waypoints; set controller.joints", keys=("initial",))
    q = built.initial.copy()
    for name, path in waypoints.items():
        if name in built.joint_names:
            q[built.position_index[built.joint_names.index(name)]] = path.values[0]
    places, placed = dict(zip(built.joint_names, built.position_index, strict=True)), {*waypoints}
    # Repeat this, because a follower may lead another joint and couplings are not ordered.
    for _ in built.couplings:
        for coupling in built.couplings:
            if coupling.leader in placed and coupling.joint not in waypoints:
                q[places[coupling.joint]] = coupling.ratio * q[places[coupling.leader]] + coupling.offset
                placed.add(coupling.joint)
    return q


@names_wrong_types
def build_model(scenario: Scenario) -> Model:
    """Build the rigid-body model of a scenario's plant.

    Parameters
    ----------
    scenario : Scenario
        Validated scenario, see :func:`load_scenario`.

    Returns
    -------
    Model
        Rigid-body model of the plant with its payloads, objects and ties, in its initial posture.

    Raises
    ------
    ModelError
        If the plant is kinematic, or its masses or joints are not physically possible.
    ScenarioError
        If ``scenario`` is not a Scenario.

    Examples
    --------
    >>> import dynsim
    >>> model = dynsim.build_model(dynsim.load_scenario("elbow_comparison"))
    >>> model.robot.initial.shape
    (10,)
    """
    require_scenario(scenario)
    return Model(robot(scenario))


def snake_controller(scenario: Scenario, description: SnakeDescription) -> TaskSpaceController:
    """Build the controller for a snake; raises ModelError as :func:`controller`."""
    from dynsim.snake.description import TaskSpaceController

    context = BuildContext(scenario.duration_s, description)
    return families.build("controller", _fitting_controller(scenario), context, TaskSpaceController)


def _fitting_controller(scenario: Scenario) -> Any:
    """Return the configuration of the controller; raise ModelError if there is none, or it does not fit the plant."""
    config = scenario.controller
    if config is None:
        raise ModelError("the scenario has no controller; its motors are short-circuited")
    # Compare the ENGINE of the modules, not of the scenario, because a snake's controller drives a snake at both
    # levels.
    if families.member("plant", scenario.plant.type).ENGINE != families.member("controller", config.type).ENGINE:
        raise ModelError(f"controller {config.type!r} cannot drive a {scenario.plant.type!r}")
    return config


def controller(
    scenario: Scenario,
    machine: Model,
    progress: Callable[[float], None] | None = None,
    touching: Sequence[Contact] | None = None,
) -> JointControl:
    """Build the controller for a model.

    Parameters
    ----------
    scenario : Scenario
        Validated scenario.
    machine : Model
        Machine that the controller drives.
    progress : callable, optional
        Called with the time [s] up to which the references are computed.
    touching : sequence of Contact, optional
        Contacts of the scenario, if they have already been built.

    Raises
    ------
    ModelError
        If the scenario has no controller, or the controller does not fit the machine.
    UnreachableReference
        If the hand cannot follow its path.
    """
    config, nominal, start = _fitting_controller(scenario), scenario, None
    if scenario.config.surface_error is not None:
        # The controller plans with the nominal surfaces, not with the simulated ones.
        nominal = replace(scenario, config=scenario.config.model_copy(update={"surface_error": None}))
        touching, start = None, robot_and_contacts(nominal)[0].initial
    if scenario.config.mass_error is not None:
        # The same for masses.
        alone = replace(scenario, config=scenario.config.model_copy(update={"mass_error": None}))
        machine = Model(replace(unposed(alone), q0=machine.robot.initial))
    touching = contacts(nominal, machine.robot) if touching is None else touching
    points = {contact.name: contact for contact in touching}
    declared = [
        name for name, contact in points.items() if name in scenario.config.contacts.points and not contact.left_out
    ]
    unused = {contact.name: contact for contact in disabled_points(nominal, machine.robot)}
    tracked, disabled = _TrackedContacts(points | unused), list(unused)
    context = BuildContext(scenario.duration_s, machine, "", progress, tracked, declared, disabled, start)
    made: list[JointControl] = []

    def independent_of_contacts() -> JointControl | None:
        # A controller that reads no contact is the same for all runs with this machine and section.
        made.append(families.build("controller", config, context, JointControl))
        return None if tracked.accessed else made[0]

    known = config, scenario.duration_s, machine, [*points], declared, disabled, start
    control = recall("controller", independent_of_contacts, *known)
    if control is None:
        control = made[0] if made else families.build("controller", config, context, JointControl)
    # The kernels would extrapolate the last polynomial.
    if control.end < scenario.duration_s * (1.0 - 1e-6):
        ends = f"end at {control.end:g} s, the run at {scenario.duration_s:g} s"
        raise ModelError(f"controller {config.type!r}: the references {ends}; extend the references")
    return control


class _TrackedContacts(Mapping[str, Contact]):
    """Mapping of names to contacts that records whether a contact was read."""

    def __init__(self, contacts: Mapping[str, Contact]) -> None:
        self._contacts, self.accessed = contacts, False

    def __getitem__(self, name: str) -> Contact:
        self.accessed = True
        return self._contacts[name]

    # Reading a name does not count as reading its contact.
    def __contains__(self, name: object) -> bool:
        return name in self._contacts

    def __iter__(self) -> Iterator[str]:
        return iter(self._contacts)

    def __len__(self) -> int:
        return len(self._contacts)


def surfaces(scenario: Scenario) -> dict[str, Surface]:
    """Return all named surfaces, whether used or not, at their simulated positions."""
    context, configs = BuildContext(scenario.duration_s), scenario.config.surfaces
    error = scenario.config.surface_error
    carried = any(getattr(config, "on", None) for config in configs.values()) and scenario.engine != "kinematic"
    frames = {frame.name: frame for frame in unposed(scenario).frames} if carried else {}

    def built() -> dict[str, Surface]:
        nominal: dict[str, Surface] = {}
        for name, config in configs.items():
            surface: Surface = families.build("surface", config, context, Surface)
            on: str | None = getattr(config, "on", None)
            if (frame := frames.get(on or "")) is not None:
                with errors_at("surfaces", name, "on"):
                    surface = surface.turned(frame.R).shifted(frame.p)
                on = frame.body
            nominal[name] = replace(surface, carrier=on)
        if error is None or not any(error.shift_m):
            return nominal
        by = np.array(error.shift_m)  # of what stands in the world
        return {name: s if s.carrier is not None else s.shifted(by) for name, s in nominal.items()}

    return recall("surfaces", built, scenario.duration_s, configs, error, frames)


def contacts(scenario: Scenario, described: Robot | None = None) -> list[Contact]:
    """Return all enabled contact points with their surfaces, followed by the other contact candidates.

    Parameters
    ----------
    scenario : Scenario
        Validated scenario.
    described : Robot, optional
        Robot of the scenario, if it has already been built.

    Raises
    ------
    ModelError
        If a point is on a surface that does not exist.
    """
    options = scenario.config.contacts
    known = surfaces(scenario)
    described = robot(scenario) if described is None else described
    _check_carriers(known, described)
    result = [
        _foot(foot, known, options)
        for foot in described.feet
        if foot.surface not in known or known[foot.surface].carrier != foot.body
    ]
    # Corner 1 of a box b and a sphere b1 would have the same name.
    used = set[str]()
    result = [replace(contact, name=unused(contact.name, used)) for contact in result]
    for name, point in options.points.items():
        if not point.enabled:
            continue
        if point.surface not in known:
            keys = ("contacts", "points", name, "surface")
            raise ModelError(
                f"{dotted(keys)} = {point.surface!r}: unknown surface{suggest(point.surface, known)}; "
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
    if options.between:
        pairs, names = options.between, {contact.name for contact in result}
        laws = partial(_law, options)
        stepped = scenario.config.integrator.method == "time_stepping"
        for k, entry in enumerate(pairs):
            for name in {*entry.bodies} & {*known} - {*described.bodies} if entry.bodies != between.SELF else ():
                raise ModelError(
                    f"contacts.between: {name!r} is a surface, not a body; objects touch all surfaces, links with "
                    "contacts.points or contacts.candidates; remove this entry",
                    keys=("contacts", "between", k, "bodies"),
                )
        result += between.contacts_between(pairs, described, scenario.config.objects, laws, names, stepped)
    if result:
        places = [contact.geometry for contact in result]
        still = recall("left out", lambda: immobile(Model(described), result), described, places)
        result = [replace(contact, left_out=left_out) for contact, left_out in zip(result, still, strict=True)]
    if options.candidates != "points":
        law = _law(options, ContactPoint(body=""))
        # Objects touch surfaces with their solids, not with their origins.
        beside = {link.name for name, body in scenario.config.objects.items() for link in body.links(name)}
        fixed = {name: surface for name, surface in known.items() if surface.carrier is None}
        own = (entry for entry in candidates(options.candidates, described, fixed, result) if entry.body not in beside)
        result += [replace(contact, **law) for contact in own]
    error = scenario.config.surface_error
    return result if error is None else [_scaled_friction(contact, error.friction_factor) for contact in result]


def solid_pairs(scenario: Scenario, described: Robot) -> list[SolidPair]:
    """Return the pairs of solids of ``contacts.between`` with their kinetic friction."""
    options, error = scenario.config.contacts, scenario.config.surface_error
    factor = 1.0 if error is None else error.friction_factor
    pairs = between.solid_pairs(options.between, described, scenario.config.objects)
    return [SolidPair(a, b, factor * options.coefficients(entry)[0]) for a, b, entry in pairs]


def _check_carriers(known: Mapping[str, Surface], described: Robot) -> None:
    """Raise ModelError if a surface is on a body that does not exist."""
    for name, surface in known.items():
        if surface.carrier is not None and surface.carrier not in described.bodies:
            keys = ("surfaces", name, "on")
            raise ModelError(
                f"{dotted(keys)} = {surface.carrier!r}: no such moving body"
                f"{suggest(surface.carrier, described.bodies)}; bodies: {', '.join(described.bodies)}",
                keys=keys,
            )


def _foot(foot: Foot, known: Mapping[str, Surface], options: Contacts) -> Contact:
    """Return the contact of a foot, a part of the robot that is designed to touch a surface."""
    if foot.surface not in known:
        raise ModelError(f"surfaces: surface {foot.surface!r} does not exist (used by {foot.name})")
    law = _law(options, ContactPoint(body=foot.body))
    if foot.grip_axis is not None:
        law |= {"grip": 0.0, "grip_axis": foot.grip_axis}
    return Contact(
        foot.name, foot.body, foot.point, known[foot.surface], surface_name=foot.surface, radius=foot.radius, **law
    )


def _scaled_friction(contact: Contact, factor: float) -> Contact:
    """Return the contact with all friction coefficients multiplied by a factor."""
    static = None if contact.static_friction is None else factor * contact.static_friction
    viscous = factor * contact.viscous_friction
    return replace(contact, friction=factor * contact.friction, static_friction=static, viscous_friction=viscous)


def _law(options: Contacts, point: ContactLaw) -> dict[str, Any]:
    """Return the contact-law parameters of a point or pair, as keyword arguments of `Contact`."""
    friction, static = options.coefficients(point)
    stiffness, damping = options.compliance(point)
    if options.law == "bilateral":
        smoothing, pulling = options.slip_smoothing_m_s, options.pulling_friction
        return {"friction": friction, "slip_smoothing": smoothing, "pulling_friction": pulling}
    grip = getattr(point, "grip", None)
    return {
        "friction": friction,
        "pulling_friction": "signed",
        "static_friction": static,
        "stribeck": options.stribeck_m_s or 0.0,
        "viscous_friction": options.viscous_friction_s_per_m,
        "restitution": options.of(point, "restitution"),
        "stiffness": stiffness,
        "damping": damping if stiffness else 0.0,
        **({} if grip is None else {"grip": grip.ratio, "grip_axis": np.array(grip.axis)}),
    }


def loads(scenario: Scenario, robot: Robot) -> list[Load]:
    """Return the external forces and torques on the links of a robot; payloads are already part of the links.

    Raises
    ------
    ModelError
        If a load is on a body that does not exist.
    """
    result = []
    for name, config in scenario.config.loads.items():
        if isinstance(config, Payload):
            continue
        body, point, axes = _attached(robot, name, config)
        knots, coefficients = config.pieces(scenario.duration_s)
        in_body = config.frame == "body"
        if in_body:
            # Convert from the axes of a frame to the axes of its link.
            coefficients = np.einsum("ab,kwbp->kwap", axes, coefficients.reshape(-1, 2, 3, 4)).reshape(-1, 6, 4)
        result.append(Load(name, robot.links[body].name, point, in_body, knots, coefficients, config.hold))
    return result


def _attached(robot: Robot, name: str, config: BodyPoint) -> tuple[int, Array, Array]:
    """Return a load's link index, its point in the link's frame [m], and the axes of its components, shape (3, 3)."""
    with errors_at("loads", name, "body"):
        index, point = robot.attach(config.body, np.array(config.point_m))
    return index, point, robot.attached_axes(config.body)


def _payload(name: str, config: Payload, point: Array, axes: Array) -> Inertia:
    """Return the mass properties of a payload in its link's frame."""
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
    q: Array | None = None,
    depth: float = START_TOLERANCE,
) -> None:
    """Check that every contact is on a body of the robot and starts on its surface.

    Parameters
    ----------
    scenario : Scenario
        Validated scenario.
    model : Model
        Model of the robot.
    touching : sequence of Contact
        Contacts to check.
    q : (nq,) ndarray, optional
        Coordinates at the start [rad or m]; default: the robot's initial coordinates.
    depth : float, optional
        Maximum depth of a point below its surface [m].

    Raises
    ------
    ModelError
        If a contact does not start on its surface. The message is about the first such contact and lists the names
        and gaps of the others.
    """
    own = q is None
    q = model.robot.initial if q is None else q
    off: list[tuple[Contact, bool, tuple[str, ...], float]] = []
    for contact in touching:
        declared, keys = _keys_of(scenario, contact)
        check_body(scenario, model.robot, contact)
        gap = gap_at(model, contact, q)
        if isinstance(contact.solid, Box | Capsule) and isinstance(contact.surface, Box | Capsule) and not contact.slot:
            # A bar through a box has no corner or edge in it, so the gap alone does not show the overlap.
            gap = min(gap, -float(np.linalg.norm(separation(model, contact.solid, contact.surface, q))) or gap)
        if scenario.config.contacts.law == "unilateral" and gap > (-PRESSED if contact.stiffness > 0.0 else 0.0):
            continue
        if not -depth <= gap <= START_TOLERANCE:
            off.append((contact, declared, keys, gap))
    if off:
        contact, declared, keys, gap = off[0]
        if contact.is_between_bodies:
            raise _overlap(scenario, contact, model, q)
        if own and gap < 0.0 and (name := _object_of(scenario, contact)) is not None:
            same = contact.body, contact.surface_name
            gap = min(its for other, *_, its in off if (other.body, other.surface_name) == same)
            raise ModelError(
                f"objects.{name}.position_m: {name} starts {-gap:.4g} m inside surface {contact.surface_name!r} (limit "
                f"{depth:g} m); move the object along the normal of the surface by at least {-gap:.4g} m",
                keys=("objects", name, "position_m"),
            )
        position = model.point_position(contact.body, contact.point, q)
        remedy = "start from another posture, change the surface"
        if own and scenario.plant.type == "snake":  # `initial` does not place its joints
            remedy = "move the surface or change plant.initial_joints_rad"
        elif own:
            named = [other for other, by_name, *_ in off if by_name and not other.left_out]
            remedy = f"{_remedy(scenario, named)}change the initial configuration or the surface"
        if contact.left_out:
            remedy = "no joint moves it along the normal; move the surface"
        others = ", ".join(f"{other.name} {its:+.4g} m from {other.surface_name!r}" for other, _, _, its in off[1:])
        limit = START_TOLERANCE if gap > 0.0 else depth
        raise ModelError(
            f"{dotted(keys)}: {'its point' if declared else contact.name} starts {gap:+.4g} m "
            f"from surface {contact.surface_name!r} "
            f"(limit {limit:g} m), at {position.tolist()}{f' (also {others})' if others else ''}; "
            f"{remedy}, or disable the contact",
            keys=keys,
        )


def _object_of(scenario: Scenario, contact: Contact) -> str | None:
    """Return the object whose solid has a contact that the scenario does not declare; None for others."""
    if contact.name in scenario.config.contacts.points:
        return None
    bodies = ((name, link.name) for name, body in scenario.config.objects.items() for link in body.links(name))
    return next((name for name, link in bodies if link == contact.body), None)


def _overlap(scenario: Scenario, contact: Contact, model: Model, q: Array) -> ModelError:
    """Return the error about two bodies that overlap at the start."""
    bodies, solids = (contact.body, contact.surface_name), solids_of(model.robot)
    pairs = product(*(solids[body] for body in bodies))
    by = max((separation(model, a, b, q) for a, b in pairs), key=lambda push: float(np.linalg.norm(push)))
    movable = next((name for name in bodies if name in scenario.config.objects), None)
    remedy = "start from another posture"
    if movable is not None:
        # Components are rounded away from zero, so that the bodies do not overlap afterwards.
        steps = (by if movable == bodies[0] else -by) / 1e-5
        x, y, z = 1e-5 * np.copysign(np.ceil(np.abs(steps) - 1e-3), steps) + 0.0
        remedy = f"move {movable} by ({x:.6g}, {y:.6g}, {z:.6g}) m (objects.{movable}.position_m)"
    return ModelError(
        f"contacts.between: {bodies[0]} and {bodies[1]} overlap by {np.linalg.norm(by):.4g} m at the start (limit "
        f"{START_TOLERANCE:g} m); {remedy}, or list the pair in `ignore`",
        keys=("contacts", "between"),
    )


def _keys_of(scenario: Scenario, contact: Contact) -> tuple[bool, tuple[str, ...]]:
    """Return whether the contact is a declared contact point, and the keys that define it."""
    declared = contact.name in scenario.config.contacts.points
    if contact.is_between_bodies:
        return declared, ("contacts", "between")
    return declared, ("contacts", "points", contact.name) if declared else ("contacts", "candidates")


def check_body(scenario: Scenario, robot: Robot, contact: Contact) -> None:
    """Raise ModelError if a contact is on a body that does not exist or does not move."""
    with errors_at(*_keys_of(scenario, contact)[1], "body"):
        robot.attach(contact.body, contact.point)


def left_out_warnings(
    scenario: Scenario, contacts: Sequence[Contact], behind_brakes: Mapping[str, float] = MappingProxyType({})
) -> list[str]:
    """Return a warning for each contact that no joint moves along the normal of its surface.

    Parameters
    ----------
    scenario : Scenario
        Validated scenario.
    contacts : sequence of Contact
        Contacts of the run.
    behind_brakes : mapping of str to float, optional
        Contacts that only braked joints can move, with the time at which the brakes closed [s].
    """
    sentences = []
    for contact in contacts:
        declared, keys = _keys_of(scenario, contact)
        name, surface = dotted(keys) if declared else contact.name, contact.surface_name
        if contact.left_out:
            sentences.append(
                f"{name}: no joint moves this point along the normal of {surface}, so its force has no effect; "
                "the contact is omitted, with a force of zero"
            )
        elif contact.name in behind_brakes:
            sentences.append(
                f"{name}: from t = {behind_brakes[contact.name]:.4g} s only braked joints move this point along the "
                f"normal of {surface}, so its force has no effect; the contact is omitted, with a force of zero, while "
                "these brakes are closed"
            )
    return sentences


def _remedy(scenario: Scenario, off: Sequence[Contact]) -> str:
    """Return the advice for putting declared points on their surfaces; empty if the scenario already requests it."""
    initial = scenario.config.initial
    already = [] if initial is None else initial.on_surface
    names = [contact.name for contact in off if contact.name not in already]
    return f"`{on_surface_key(scenario, names)}` puts it there; otherwise " if names else ""


def on_surface_key(scenario: Scenario, names: Sequence[str]) -> str:
    """Return the scenario line that puts these points on their surfaces, in addition to those already listed."""
    initial = scenario.config.initial
    return f"initial: {{on_surface: [{', '.join([*(initial.on_surface if initial else ()), *names])}]}}"


def require_scenario(scenario: object) -> None:
    """Raise :class:`ScenarioError` if the argument is not a Scenario, e.g. the name of a scenario."""
    if not isinstance(scenario, Scenario):
        raise ScenarioError(f"expected a Scenario, got {brief(scenario)}; load one with load_scenario(name or file)")


class SensorMount(NamedTuple):
    """Location of a sensor: index of its link, and axes (3, 3) and point (3,) [m] of the sensor in the link's frame."""

    body: int
    axes: Array
    point: Array


def sensor_mounts(scenario: Scenario, robot: Robot) -> dict[str, dict[str, SensorMount]]:
    """Return the sensors on links of a scenario by kind and name.

    Raises
    ------
    ModelError
        If a body or frame does not exist, or the frame is not fixed to the body.
    """
    sensors = scenario.config.sensors
    return {
        kind: {name: _mount(robot, config, ("sensors", kind, name)) for name, config in named.items()}
        for kind, named in sensors or ()
        if isinstance(named, dict) and named  # only sections of named sensors contain sensors on links
    }


def _mount(robot: Robot, config: LinkSensorConfig, keys: tuple[str, ...]) -> SensorMount:
    frames = {frame.name: frame.body for frame in robot.frames}
    with errors_at(*keys, "body"):
        if config.body == WORLD:
            raise ModelError(f"'world' has no joint; bodies: {', '.join(robot.bodies)}")
        robot.attach(config.body, np.zeros(3))
        if config.body in frames:
            body = frames[config.body]
            raise ModelError(f"{config.body!r} is a frame fixed to {body}; use body: {body}, frame: {config.body}")
    if config.frame is not None and frames.get(config.frame) != config.body:
        with errors_at(*keys, "frame"):
            own = [name for name, body in frames.items() if body == config.body]
            fix = f"frames: {', '.join(own)}" if own else "remove it, because this body has no frames"
            raise ModelError(f"{config.frame!r} is not a frame fixed to {config.body}; {fix}")
    frame = config.body if config.frame is None else config.frame
    index, point = robot.attach(frame, np.array(config.point_m))
    return SensorMount(index, robot.attached_axes(frame), point)
