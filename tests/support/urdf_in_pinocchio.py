"""A URDF file read by Pinocchio, for comparison with dynsim's reading."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio

from dynsim.model.description import Link
from dynsim.model.urdf.reader import (
    _ATTRIBUTES,
    _CHILDREN,
    ROWS,
    SEVERAL,
    Element,
    UrdfTree,
    _links,
    _places,
    _words,
    read_tree,
    read_xml,
)

# Two readers of the same decimals differ by rounding, in sines of angles and in sums over merged bodies.
AGREEMENT = 1e-9


def plain_text(root: Element, name: str) -> str:
    """Return the elements that physics depends on, with the numbers of the file, as minimal UTF-8 text.

    Needed because Pinocchio's parser knows no other encoding and drops the whole inertia over a space next to a number.
    """

    def written(element: Element, tags: tuple[str, ...]) -> str:
        attributes = ""
        for key, value in element.attributes.items():
            if key in ("name", "type", "link", "joint"):
                attributes += f" {key}={quoteattr(value)}"
            elif key in _ATTRIBUTES.get(element.tag, ()):
                attributes += f" {key}={quoteattr(' '.join(_words(value)))}"
        # Pinocchio refuses dynamics without a loss, which the specification allows.
        if element.tag == "dynamics" and not attributes:
            return ""
        inside = "".join(written(child, _CHILDREN.get(child.tag, ())) for child in single(element, tags))
        return f"<{element.tag}{attributes}>{inside}</{element.tag}>"

    def single(element: Element, tags: tuple[str, ...]) -> list[Element]:
        """Children with a tag, without equal repetitions."""
        children = [child for child in element.children if child.tag in tags]
        return [child for k, child in enumerate(children) if not any(map(child.equals, children[:k]))]

    inside = "".join(written(child, _CHILDREN[child.tag]) for child in single(root, ("link", "joint")))
    return f"<robot name={quoteattr(name)}>{inside}</robot>"


def assert_pinocchio_reads_the_same(path: Path, text: str | None = None) -> None:
    """Raise AssertionError unless Pinocchio reads the same joints and bodies from the file, or from ``text``."""
    tree = read_tree(path)
    model = pinocchio.buildModelFromXML(plain_text(read_xml(path), tree.name) if text is None else text)
    neutral = pinocchio.neutral(model)
    places = _places(tree)
    links = _links(tree, places)
    ours, theirs = {link.joint for link in links}, set(list(model.names)[1:])
    if ours != theirs:
        raise AssertionError(f"{path}: the readers differ in moving joints: {', '.join(sorted(ours ^ theirs))}")
    joint_of = {link.name: link.joint for link in links}
    for link in links:
        joint, j = tree.joints[link.joint], model.getJointId(link.joint)
        inertia, placement = model.inertias[j], model.jointPlacements[j]
        parent = "universe" if link.parent is None else joint_of[link.parent]
        if model.names[model.parents[j]] != parent:
            raise _difference(tree, link, "parent joint", parent, model.names[model.parents[j]])
        length = max(1.0, float(np.abs(link.p_PJ).max()), float(np.abs(link.inertia.com).max()))
        pairs: list[tuple[str, Any, Any, float]] = [
            ("rotation of the joint", link.R_PJ, placement.rotation, 1.0),
            ("position of the joint", link.p_PJ, placement.translation, length),
            ("mass", link.inertia.mass, inertia.mass, link.inertia.mass),
        ]
        if link.inertia.mass > 0.0:
            pairs.append(("centre of mass", link.inertia.com, inertia.lever, length))
        size = float(np.abs(link.inertia.tensor).max()) + link.inertia.mass * length**2
        pairs.append(("inertia", link.inertia.tensor, inertia.inertia, size))
        pairs.append(("damping", link.damping, model.damping[model.joints[j].idx_v], link.damping))
        if link.kind in SEVERAL:
            # Pinocchio does not read the normal of a plane: it uses z.
            pairs.append(("number of rates", len(ROWS[link.kind](link)), model.joints[j].nv, 0.0))
        else:
            # Motion of the body per unit rate in its own frame: (0, a) for a revolute, (a, 0) for a prismatic joint.
            in_joint = model.joints[j].createData()
            model.joints[j].calc(in_joint, neutral)
            zero, revolute = np.zeros(3), link.kind == "revolute"
            motion = np.concatenate([zero, link.axis] if revolute else [link.axis, zero])
            pairs.append(("joint motion", motion, in_joint.S, 1.0))
        if joint.kind not in ("continuous", *SEVERAL):
            k = model.joints[j].idx_q
            for name, value, limits in (
                ("lower limit", link.lower, model.lowerPositionLimit),
                ("upper limit", link.upper, model.upperPositionLimit),
            ):
                if math.isfinite(value):
                    pairs.append((name, value, limits[k], abs(value)))
        for name, value, limits in (
            ("velocity limit", link.velocity_limit, model.velocityLimit),
            ("effort limit", link.effort_limit, model.effortLimit),
        ):
            if math.isfinite(value):
                pairs.append((name, value, limits[model.joints[j].idx_v], value))
        for name, own, other, scale in pairs:
            if not np.allclose(own, other, rtol=0.0, atol=AGREEMENT * scale):
                raise _difference(tree, link, name, own, other)


def _difference(tree: UrdfTree, link: Link, name: str, own: Any, other: Any) -> AssertionError:
    def text(value: Any) -> str:
        return " ".join(np.array2string(np.asarray(value), precision=12).split()) if np.ndim(value) else str(value)

    return AssertionError(f"{tree.path}: link {link.name!r}: {name} is {text(own)}, Pinocchio reads {text(other)}")
