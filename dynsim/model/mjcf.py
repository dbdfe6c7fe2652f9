"""MJCF export: a robot as a MuJoCo file with the same mass matrix and bias forces.

The export contains bodies, joints with limits, viscous losses, dry friction and rotor inertia, couplings, gravity and
the initial posture. MuJoCo's format represents all of these exactly. Motors become torques on their joints, bounded by
their current limits; circuits, smoothed gear friction and controllers are omitted. Contact points become sites and
surfaces become shapes without contact, because MuJoCo's contacts are soft.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence

import numpy as np

from dynsim.errors import ModelError
from dynsim.model.description import Array, Contact, Link, Robot
from dynsim.model.drives import TorqueSource
from dynsim.record.quaternion import of_matrix
from dynsim.record.scene import HERE, SceneSurface, Shape
from dynsim.record.urdf_text import Element, numbers, xml_text

# MuJoCo rejects bodies without mass or inertia; these values are negligible in any robot [kg, kg m²].
LEAST = 1e-12
# Half the edge length of the part of a plane that is drawn [m].
_PLANE = 5.0
_SIMPLE = {"revolute": "hinge", "prismatic": "slide"}
_BALL = ["ball_x", "ball_y", "ball_z"]


def write_mjcf(
    robot: Robot,
    contacts: Sequence[Contact],
    surfaces: Sequence[SceneSurface],
    damping: Array,
    armature: Array,
    rubs: Mapping[str, float],
) -> str:
    """Write the bodies, joints, torques and visual shapes of a robot as MJCF text.

    Parameters
    ----------
    robot : Robot
        Robot whose links include the masses of its motors.
    contacts : sequence of Contact
        Contact points, which become sites ``contact_NAME``; the hand is the site ``hand``.
    surfaces : sequence of SceneSurface
        Surfaces; only planes, spheres, cylinders and boxes are drawn.
    damping, armature : (n,) ndarray
        Damping and armature of each row of the joints [N m s/rad, kg m²; N s/m, kg].
    rubs : mapping of str to float
        Dry friction of bearing and gear, for each joint that has any [N m or N].

    Raises
    ------
    ModelError
        If MJCF has no such kind of joint, or if there are ties between bodies.
    """
    if robot.ties:
        raise ModelError(f"{robot.ties[0].name}: ties between bodies cannot be exported to MJCF")
    root = Element("mujoco", model=robot.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ElementTree.SubElement(root, "option", timestep="0.001", integrator="implicitfast", gravity=numbers(robot.gravity))
    looks = ElementTree.SubElement(ElementTree.SubElement(root, "default"), "geom")
    looks.attrib.update(contype="0", conaffinity="0", group="1", mass="0")
    world = ElementTree.SubElement(root, "worldbody")
    ElementTree.SubElement(world, "light", pos="0 0 5", dir="0 0 -1", directional="true")
    for surface in surfaces:
        _add_surface(world, surface)
    _add_shapes(world, robot.fixed_shapes)
    elements: dict[str | None, Element] = {None: world}
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
            _add_shapes(body, link.shapes)
            order.extend(group)
            add(link.name)

    add(None)
    hand, point = robot.hand
    ElementTree.SubElement(elements[hand], "site", name="hand", pos=numbers(point), size="0.005")
    for contact in contacts:
        index, on_body = robot.attach(contact.body, contact.point)
        site = {"name": f"contact_{contact.name}", "pos": numbers(on_body), "size": "0.005", "rgba": "1 0.5 0 1"}
        ElementTree.SubElement(elements[robot.links[index].name], "site", site)
    _add_couplings(root, robot)
    _add_motors(root, robot)
    q, first = robot.initial, dict(zip((link.joint for link in robot.links), robot.position_index, strict=True))
    posture = [q[first[link.joint] : first[link.joint] + len(link.row.neutral)] for link in order]
    ElementTree.SubElement(
        ElementTree.SubElement(root, "keyframe"), "key", name="initial", qpos=numbers(np.concatenate(posture))
    )
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
                joint["frictionloss"] = numbers(rubs[link.joint])
            if math.isfinite(link.lower) and math.isfinite(link.upper):
                joint["range"] = numbers([link.lower, link.upper])
            ElementTree.SubElement(body, "joint", joint)


def _add_inertial(body: Element, link: Link) -> None:
    inertia = link.inertia
    tensor = np.asarray(inertia.tensor) + max(0.0, LEAST - float(np.linalg.eigvalsh(inertia.tensor)[0])) * np.eye(3)
    off = tensor[[0, 0, 1], [1, 2, 2]]
    moments = (
        {"fullinertia": numbers([*np.diag(tensor), *off])} if off.any() else {"diaginertia": numbers(np.diag(tensor))}
    )
    origin = {"pos": numbers(inertia.com), "mass": numbers(max(inertia.mass, LEAST))}
    ElementTree.SubElement(body, "inertial", {**origin, **moments})


def _add_shapes(body: Element, shapes: Sequence[Shape]) -> None:
    """Add shapes as geoms, without meshes, whose files MuJoCo may not be able to read."""
    for shape in shapes:
        if shape.kind == "mesh":
            continue
        size = {
            "box": lambda s: [0.5 * edge for edge in s],
            "sphere": lambda s: list(s),
            "cylinder": lambda s: [s[0], 0.5 * s[1]],
            "capsule": lambda s: [s[0], 0.5 * s[1]],
        }[shape.kind](shape.size)
        geom = {"type": shape.kind, "size": numbers(size), "pos": numbers(shape.position)}
        geom["quat"] = numbers(shape.orientation)
        if shape.colour is not None:
            geom["rgba"] = numbers(shape.colour)
        ElementTree.SubElement(body, "geom", geom)


def _add_surface(world: Element, surface: SceneSurface) -> None:
    geom = {"name": f"surface_{surface.name}", "rgba": "0.7 0.7 0.7 0.5"}
    # A drawn surface that encloses its free side would hide everything on that side.
    if surface.kind == "plane":
        geom |= {"type": "plane", "size": f"{_PLANE} {_PLANE} 0.1", "zaxis": numbers(surface.direction)}
    elif surface.kind == "sphere" and (surface.radius or 0.0) > 0.0:
        geom |= {"type": "sphere", "size": numbers(surface.radius)}
    elif surface.kind == "cylinder" and (surface.radius or 0.0) > 0.0:
        geom |= {"type": "cylinder", "size": numbers([surface.radius, _PLANE]), "zaxis": numbers(surface.direction)}
    elif surface.kind == "box":
        edges = np.array(surface.edges)
        geom |= {"type": "box", "size": numbers(0.5 * edges), "quat": numbers(surface.orientation or HERE)}
    else:
        return
    ElementTree.SubElement(world, "geom", {**geom, "pos": numbers(surface.position)})


def _add_couplings(root: Element, robot: Robot) -> None:
    if not robot.couplings:
        return
    equality = ElementTree.SubElement(root, "equality")
    for coupling in robot.couplings:
        law = numbers([coupling.offset, coupling.ratio, 0.0, 0.0, 0.0])
        ElementTree.SubElement(equality, "joint", joint1=coupling.joint, joint2=coupling.leader, polycoef=law)


def _add_motors(root: Element, robot: Robot) -> None:
    if not robot.motors:
        return
    actuator = ElementTree.SubElement(root, "actuator")
    for motor in robot.motors:
        torque = (
            motor.torque_limit if isinstance(motor, TorqueSource) else motor.joint_constant * motor.greatest_current
        )
        limit = {"ctrlrange": numbers([-torque, torque])} if math.isfinite(torque) else {}
        ElementTree.SubElement(actuator, "motor", {"name": motor.joint, "joint": motor.joint, **limit})
