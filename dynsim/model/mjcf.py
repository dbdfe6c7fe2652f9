"""MJCF export: a robot as a MuJoCo file with the same mass matrix, bias forces and motors.

The export contains bodies, joints with limits, viscous losses, dry friction and rotor inertia, couplings, gravity and
the initial posture. MuJoCo's format represents all of these exactly. DC motors become ``dcmotor`` actuators with their
circuits and voltage loops. Servos become ``position`` actuators, ``general`` ones in velocity mode, or ``dcmotor``
actuators without inductance if their current is limited. Contact points become sites; on request, they and the surfaces
also become colliding geoms, whose contacts are soft in MuJoCo, as do the solids of bodies that touch each other.

Every actuator has one control c, in the unit of the reference. Notation: gains k_p and k_d, torque constant K,
resistance R, reference q_d with rate v_d, feed-forward voltage u_f.

- DC motor with k_p > 0: u = k_p (c − q) − k_d v, so that c = q_d + (k_d v_d + u_f)/k_p is dynsim's controller.
- DC motor with k_p = 0 < k_d: u = (k_d + K) c − k_d v, so that c = (k_d v_d + u_f)/(k_d + K). Without gains: c = u.
- Servo: c = q_d + k_d v_d/k_p, in velocity mode c = v_d. For a ``position`` or ``general`` actuator, the back-EMF is a
  damping K²/R of the joint, so that the force of the actuator is within ±K U/R exactly if the voltage is within ±U.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence

import numpy as np

from dynsim.errors import ModelError
from dynsim.model.description import WORLD, Array, Contact, Link, Robot
from dynsim.model.drives import Drive, Servo, TorqueSource
from dynsim.model.surfaces import Box, SolidPair
from dynsim.record.quaternion import of_matrix
from dynsim.record.scene import HERE, SceneSurface, Shape
from dynsim.record.urdf_text import Element, numbers, xml_text

# MuJoCo rejects bodies without mass or inertia; these values are negligible in any robot [kg, kg m²].
LEAST = 1e-12
# Half the edge length of the part of a plane that is drawn [m].
_PLANE = 5.0
_SIMPLE = {"revolute": "hinge", "prismatic": "slide"}
_BALL = ["ball_x", "ball_y", "ball_z"]
# Radius that is added to a contact geom and subtracted again by the margin of its contact [m]: points need a size.
_PAD = 1e-3
# Smallest half edge of a box [m].
_LEAST_SIZE = 1e-6
# Stiffest constraint that steps of 1 ms resolve: time constant [s] and damping ratio, and impedances close to one.
_STIFF = {"solref": "0.002 1", "solimp": "0.9999 0.9999 0.001 0.5 2"}
Gains = Mapping[str, tuple[float, float]]
"""Gains of the voltage controllers of DC motors by joint [V/rad, V s/rad; V/m, V s/m]."""


def write_mjcf(
    robot: Robot,
    contacts: Sequence[Contact],
    surfaces: Sequence[tuple[SceneSurface, str | None]],
    damping: Array,
    armature: Array,
    rubs: Mapping[str, float],
    gains: Gains,
    meshes: Mapping[str, str],
    touching: bool,
    pairs: Sequence[SolidPair],
) -> str:
    """Write the bodies, joints, motors and shapes of a robot as MJCF text.

    Parameters
    ----------
    robot : Robot
        Robot whose links include the masses of its motors.
    contacts : sequence of Contact
        Contact points, which become sites ``contact_NAME``; the hand is the site ``hand``.
    surfaces : sequence of (SceneSurface, str or None)
        Surfaces with the bodies that carry them, None for the world; only planes, spheres, cylinders and boxes are
        drawn, on bodies no planes.
    damping, armature : (n,) ndarray
        Damping and armature of each row of the joints [N m s/rad, kg m²; N s/m, kg].
    rubs : mapping of str to float
        Dry friction of bearing and gear, for each joint that has any [N m or N].
    gains : mapping
        Gains of the voltage controllers of DC motors.
    meshes : mapping of str to str
        Paths of mesh files that MuJoCo can read, by the name of the mesh; other meshes are omitted.
    touching : bool
        Whether contact points and surfaces collide, and pairs of solids.
    pairs : sequence of SolidPair
        Pairs of solids.

    Raises
    ------
    ModelError
        If MJCF has no such kind of joint, or if there are ties between bodies.
    """
    if robot.ties:
        raise ModelError(f"{robot.ties[0].name}: ties between bodies cannot be exported to MJCF")
    root = Element("mujoco", model=robot.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    option = {"timestep": "0.001", "integrator": "implicitfast", "gravity": numbers(robot.gravity)}
    ElementTree.SubElement(root, "option", option | ({"cone": "elliptic"} if touching else {}))
    looks = ElementTree.SubElement(ElementTree.SubElement(root, "default"), "geom")
    looks.attrib.update(contype="0", conaffinity="0", group="1", mass="0")
    world = ElementTree.SubElement(root, "worldbody")
    ElementTree.SubElement(world, "light", pos="0 0 5", dir="0 0 -1", directional="true")
    assets = _add_meshes(root, robot, meshes)
    elements: dict[str | None, Element] = {None: world}
    solid = {s.name: s for s, carrier in surfaces if carrier is None and _add_surface(world, s, touching)}
    _add_shapes(world, robot.fixed_shapes, assets)
    below: dict[str | None, list[list[Link]]] = {}
    for group in _joints(robot):
        below.setdefault(group[0].parent, []).append(group)
    row = {link.joint: i for i, link in enumerate(robot.links)}
    order: list[Link] = []

    def add(parent: str | None) -> None:
        for group in below.get(parent, ()):
            link = group[-1]
            origin = {"pos": numbers(group[0].p_PJ), "quat": numbers(of_matrix(group[0].R_PJ))}
            body = ElementTree.SubElement(elements[parent], "body", {"name": link.name, **origin})
            elements[link.name] = body
            _add_inertial(body, link)
            _add_joints(body, group, rubs, damping[[row[link.joint] for link in group]], armature[row[link.joint]])
            _add_shapes(body, link.shapes, assets)
            order.extend(group)
            add(link.name)

    add(None)
    for surface, carrier in surfaces:
        if carrier is not None and surface.kind != "plane" and _add_surface(elements[carrier], surface, touching):
            solid[surface.name] = surface
    hand, point = robot.hand
    ElementTree.SubElement(elements[hand], "site", name="hand", pos=numbers(point), size="0.005")
    for contact in contacts:
        index, on_body = robot.attach(contact.body, contact.point)
        site = {"name": f"contact_{contact.name}", "pos": numbers(on_body), "size": "0.005", "rgba": "1 0.5 0 1"}
        ElementTree.SubElement(elements[robot.links[index].name], "site", site)
    if touching:
        _add_contacts(root, robot, contacts, solid, elements)
        _add_pairs(root, pairs, elements)
    _add_couplings(root, robot)
    if robot.motors:
        actuators = ElementTree.SubElement(root, "actuator")
        for motor in robot.motors:
            tag, attributes = _actuator(motor, *gains.get(motor.joint, (0.0, 0.0)))
            ElementTree.SubElement(actuators, tag, {"name": motor.joint, "joint": motor.joint, **attributes})
    q, first = robot.initial, dict(zip((link.joint for link in robot.links), robot.position_index, strict=True))
    posture = [q[first[link.joint] : first[link.joint] + len(link.row.neutral)] for link in order]
    key = {"name": "initial", "qpos": numbers(np.concatenate(posture))}
    if robot.motors:
        # The first reference is the start, except for torque sources; other controls are zero.
        follows = [(m, control_scale(m, *gains.get(m.joint, (0.0, 0.0)))[0]) for m in robot.motors]
        key["ctrl"] = numbers([0.0 if isinstance(m, TorqueSource) else k * q[first[m.joint]] for m, k in follows])
    ElementTree.SubElement(ElementTree.SubElement(root, "keyframe"), "key", key)
    return xml_text(root)


def _joints(robot: Robot) -> list[list[Link]]:
    """Return the rows of each joint, after checking that MJCF has such a joint."""
    groups: dict[str, list[Link]] = {}
    for link in robot.links:
        groups.setdefault(link.joint_of_rows or link.joint, []).append(link)
    for name, group in groups.items():
        kinds = [link.kind for link in group]
        if [kind for kind in kinds if kind not in (*_SIMPLE, *_BALL)]:
            raise ModelError(
                f"{name}: is made of {', '.join(kinds)}; MJCF has no such joint, and no wheels that roll without slip; "
                "export an arm on a fixed base"
            )
    return list(groups.values())


def _add_joints(
    body: Element, group: Sequence[Link], rubs: Mapping[str, float], damping: Array, armature: float
) -> None:
    """Add the joints of a body; three slides and a ball joint of a body free in the world become one free joint."""
    kinds = [link.kind for link in group]
    first = group[0]
    loose = kinds == ["prismatic"] * 3 + _BALL and not damping.any() and armature == 0.0
    if loose and first.parent is None and not first.p_PJ.any() and np.array_equal(first.R_PJ, np.eye(3)):
        ElementTree.SubElement(body, "freejoint", name=first.joint_of_rows or first.joint)
        return
    for link, loss in zip(group, damping, strict=True):
        common = {"name": link.joint, "damping": numbers(loss), "armature": numbers(armature)}
        if link.kind == "ball_x":
            ElementTree.SubElement(body, "joint", {**common, "type": "ball"})
        elif link.kind in _SIMPLE:
            joint = {**common, "type": _SIMPLE[link.kind], "axis": numbers(link.axis)}
            if link.joint in rubs:
                joint |= {"frictionloss": numbers(rubs[link.joint]), **_stiff("friction")}
            if math.isfinite(link.lower) and math.isfinite(link.upper):
                joint |= {"range": numbers([link.lower, link.upper]), **_stiff("limit")}
            ElementTree.SubElement(body, "joint", joint)


def _stiff(kind: str) -> dict[str, str]:
    return {f"{name}{kind}": value for name, value in _STIFF.items()}


def _add_inertial(body: Element, link: Link) -> None:
    inertia = link.inertia
    least, middle, largest = np.linalg.eigvalsh(inertia.tensor).tolist()
    # MuJoCo accepts no moment that exceeds the sum of the two others by rounding.
    lacking = max(LEAST - least, largest - least - middle + 1e-12 * largest)
    tensor = np.asarray(inertia.tensor) + max(0.0, lacking) * np.eye(3)
    off = tensor[[0, 0, 1], [1, 2, 2]]
    moments = (
        {"fullinertia": numbers([*np.diag(tensor), *off])} if off.any() else {"diaginertia": numbers(np.diag(tensor))}
    )
    origin = {"pos": numbers(inertia.com), "mass": numbers(max(inertia.mass, LEAST))}
    ElementTree.SubElement(body, "inertial", {**origin, **moments})


_Assets = dict[tuple[str, tuple[float, ...]], str]


def _add_meshes(root: Element, robot: Robot, meshes: Mapping[str, str]) -> _Assets:
    """Add the meshes with a path as assets; return the names of the assets by mesh and scale."""
    assets: _Assets = {}
    shapes = [*robot.fixed_shapes, *(shape for link in robot.links for shape in link.shapes)]
    for shape in shapes:
        if shape.kind == "mesh" and shape.file in meshes and (shape.file, shape.size) not in assets:
            assets[shape.file, shape.size] = f"mesh_{len(assets) + 1}"
    if assets:
        asset = ElementTree.SubElement(root, "asset")
        for (file, scale), name in assets.items():
            # The mass of a body does not depend on its meshes; as a shell, an open mesh is valid too.
            attributes = {"name": name, "file": meshes[file], "scale": numbers(scale), "inertia": "shell"}
            ElementTree.SubElement(asset, "mesh", attributes)
    return assets


def _add_shapes(body: Element, shapes: Sequence[Shape], assets: _Assets) -> None:
    """Add shapes as geoms, without meshes that are not assets."""
    for shape in shapes:
        geom = {"type": shape.kind, "pos": numbers(shape.position), "quat": numbers(shape.orientation)}
        if shape.kind == "mesh":
            if (shape.file, shape.size) not in assets:
                continue
            geom["mesh"] = assets[shape.file, shape.size]
        elif shape.kind == "box":
            geom["size"] = numbers([0.5 * edge for edge in shape.size])
        else:
            geom["size"] = numbers([shape.size[0], *(0.5 * length for length in shape.size[1:])])
        if shape.colour is not None:
            geom["rgba"] = numbers(shape.colour)
        ElementTree.SubElement(body, "geom", geom)


def _edge_radius(surface: SceneSurface) -> float:
    """Return the radius of a box's edges, to which the margin of its contacts inflates a smaller, sharp box [m]."""
    return (surface.radius or 0.0) if surface.kind == "box" else 0.0


def _add_surface(world: Element, surface: SceneSurface, touching: bool) -> bool:
    """Add a surface as a geom; return False if MJCF has no such shape."""
    geom = {"name": f"surface_{surface.name}", "rgba": "0.7 0.7 0.7 0.5"}
    # A drawn surface that encloses its free side would hide everything on that side.
    if surface.kind == "plane":
        geom |= {"type": "plane", "size": f"{_PLANE} {_PLANE} 0.1", "zaxis": numbers(surface.direction)}
    elif surface.kind == "sphere" and (surface.radius or 0.0) > 0.0:
        geom |= {"type": "sphere", "size": numbers(surface.radius)}
    elif surface.kind == "cylinder" and (surface.radius or 0.0) > 0.0:
        geom |= {"type": "cylinder", "size": numbers([surface.radius, _PLANE]), "zaxis": numbers(surface.direction)}
    elif surface.kind == "box":
        half = 0.5 * np.array(surface.edges) - (_edge_radius(surface) if touching else 0.0)
        size = numbers(np.maximum(half, _LEAST_SIZE))
        geom |= {"type": "box", "size": size, "quat": numbers(surface.orientation or HERE)}
    else:
        return False
    ElementTree.SubElement(world, "geom", {**geom, "pos": numbers(surface.position)})
    return True


def _add_contacts(
    root: Element,
    robot: Robot,
    contacts: Sequence[Contact],
    surfaces: Mapping[str, SceneSurface],
    elements: Mapping[str | None, Element],
) -> None:
    """Add a sphere or capsule for each contact, which collides only with the surface of the contact."""
    pairs = ElementTree.SubElement(root, "contact")
    for contact in contacts:
        if contact.surface_name not in surfaces:
            continue
        index, start = robot.attach(contact.body, contact.point)
        name = f"contact_{contact.name}"
        geom = {"name": name, "type": "sphere", "group": "3", "size": numbers(contact.radius + _PAD)}
        if contact.tip is None:
            geom["pos"] = numbers(start)
        else:
            ends = numbers([*start, *robot.attach(contact.body, contact.tip)[1]])
            geom |= {"type": "capsule", "fromto": ends}
        ElementTree.SubElement(elements[robot.links[index].name], "geom", geom)
        margin = _edge_radius(surfaces[contact.surface_name]) - _PAD
        _add_pair(pairs, f"surface_{contact.surface_name}", name, margin, contact.friction)


def _add_pairs(root: Element, pairs: Sequence[SolidPair], elements: Mapping[str | None, Element]) -> None:
    """Add a geom for each solid, which collides only with its partners in the pairs."""
    contact, names = ElementTree.SubElement(root, "contact"), dict[int, str]()
    for first, second, friction in pairs:
        geoms, margin = list[str](), 0.0
        for solid in (first, second):
            if id(solid) not in names:
                names[id(solid)] = f"solid_{solid.carrier or WORLD}_{len(names) + 1}"
                geom = {"name": names[id(solid)], "group": "3"}
                if isinstance(solid, Box):
                    half = np.maximum(solid.core, _LEAST_SIZE)
                    turn = numbers(of_matrix(solid.axes.T))
                    geom |= {"type": "box", "pos": numbers(solid.centre), "quat": turn, "size": numbers(half)}
                elif solid.axis.any():
                    ends = numbers([*solid.start, *solid.start + solid.axis])
                    geom |= {"type": "capsule", "fromto": ends, "size": numbers(solid.radius)}
                else:
                    geom |= {"type": "sphere", "pos": numbers(solid.start), "size": numbers(solid.radius)}
                ElementTree.SubElement(elements[solid.carrier], "geom", geom)
            geoms.append(names[id(solid)])
            margin += solid.edge_radius if isinstance(solid, Box) else 0.0
        _add_pair(contact, geoms[0], geoms[1], margin, friction)


def _add_pair(contact: Element, first: str, second: str, margin: float, friction: float) -> None:
    """Add a contact between two geoms; ``margin`` is by how much both together are too small [m]."""
    sliding = numbers([friction, friction, 0.0, 0.0, 0.0])
    geoms = {"geom1": first, "geom2": second, "margin": numbers(margin)}
    ElementTree.SubElement(contact, "pair", {**geoms, "condim": "3", "friction": sliding, **_STIFF})


def _add_couplings(root: Element, robot: Robot) -> None:
    if not robot.couplings:
        return
    equality = ElementTree.SubElement(root, "equality")
    for coupling in robot.couplings:
        law = numbers([coupling.offset, coupling.ratio, 0.0, 0.0, 0.0])
        joints = {"joint1": coupling.joint, "joint2": coupling.leader, "polycoef": law}
        ElementTree.SubElement(equality, "joint", joints | _STIFF)


def current_limited(servo: Servo) -> bool:
    """Return whether the current limit of a servo, not its voltage, bounds its torque at rest."""
    return servo.greatest_current < servo.voltage_limit / servo.resistance


def back_emf_damping(motor: Drive) -> float:
    """Return the damping K²/R of a servo's joint, which its actuator then omits [N m s/rad or N s/m]."""
    if not isinstance(motor, Servo) or current_limited(motor):
        return 0.0
    return motor.torque_constant**2 / motor.resistance


def control_scale(motor: Drive, k_p: float, k_d: float) -> tuple[float, float, float]:
    """Return the factors of reference, rate of the reference, and feed-forward voltage in the control of an actuator.

    ``k_p`` and ``k_d`` are the gains of a DC motor [V/rad, V s/rad].
    """
    if isinstance(motor, TorqueSource):
        return 1.0, 0.0, 0.0
    if isinstance(motor, Servo):
        return (0.0, 1.0, 0.0) if motor.velocity_mode else (1.0, motor.k_d / motor.k_p, 0.0)
    if k_p > 0.0:
        return 1.0, k_d / k_p, 1.0 / k_p
    total = k_d + motor.joint_constant
    return (0.0, k_d / total, 1.0 / total) if k_d > 0.0 else (0.0, 0.0, 1.0)


def _actuator(motor: Drive, k_p: float, k_d: float) -> tuple[str, dict[str, str]]:
    """Return tag and attributes of the actuator of a motor; see the notation of this module."""
    if isinstance(motor, TorqueSource):
        limit = motor.torque_limit
        return "motor", {"ctrlrange": numbers([-limit, limit])} if math.isfinite(limit) else {}
    k, R, inductance = motor.joint_constant, motor.resistance, 0.0
    if isinstance(motor, Servo):
        if not current_limited(motor):
            stall = motor.stall_torque
            limited = {"forcerange": numbers([-stall, stall])} if math.isfinite(stall) else {}
            if motor.velocity_mode:
                bias = {"biastype": "affine", "biasprm": numbers([0.0, 0.0, k / R * (k - motor.k_v)])}
                return "general", {"gainprm": numbers(k / R * motor.k_v), **bias, **limited}
            return "position", {"kp": numbers(k / R * motor.k_p), "kv": numbers(k / R * motor.k_d), **limited}
        k_p, k_d = (0.0, motor.k_v - k) if motor.velocity_mode else (motor.k_p, motor.k_d)
    else:
        inductance = motor.inductance
    circuit = {"resistance": numbers(R), "motorconst": numbers([k, k]), "inductance": numbers([inductance, 0.0])}
    if math.isfinite(motor.greatest_current):
        circuit["saturation"] = numbers([k * motor.greatest_current, 0.0, 0.0])
    limit = motor.voltage_limit if math.isfinite(motor.voltage_limit) else 0.0
    if k_p == k_d == 0.0:
        return "dcmotor", circuit | ({"ctrlrange": numbers([-limit, limit])} if limit else {})
    # MuJoCo's controller commands a torque and compensates the back-EMF: u = R/K (k_p' (c − q) − k_d' v) + K v.
    loop = numbers([k / R * k_p, 0.0, k / R * (k_d + k), 0.0, 0.0, limit])
    return "dcmotor", circuit | {"input": "pos" if k_p > 0.0 else "vel", "controller": loop}
