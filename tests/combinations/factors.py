"""Factors of a scene, their levels, and combinations of levels that are refused."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from combinations.sentences import (
    CANNOT_DRIVE,
    COUPLED,
    DO_NOT_BRING,
    NO_WAYPOINTS,
    NOTHING_HOLDS,
    OFF_SURFACE,
    REFERENCES_OFF,
)

Levels = Mapping[str, str]

# The method is not a factor: each scene is run by all methods that support it, see :func:`methods`.
FACTORS: dict[str, tuple[str, ...]] = {
    # Plants differ in their joints: revolute; also prismatic; from a file with a branch; coupled; free or planar root.
    "plant": ("revolute", "prismatic", "urdf", "mimic", "floating", "planar", "mobile", "snake"),
    # partly: one or two joints before the elbow have no motor; dc: with limits of voltage and current; velocity: a
    # servo in velocity mode.
    "motor": ("none", "partly", "published", "dc", "servo", "velocity", "torque"),
    "rubbing": ("nothing", "viscous", "bearing", "gear", "both"),
    "stops": ("none", "far", "reached"),
    # nothing: glued law, no point; free: unilateral law, no point; points, joints, links: the parts that can touch
    # under the unilateral law.
    "contact": ("nothing", "free", "glued", "points", "joints", "links"),
    # Declared points: only the elbow; also the hand; also a second point on the same link; also one on the first axis.
    "points": ("elbow", "two", "same_link", "unmoved"),
    "shape": ("point", "sphere"),
    # steep: a plane that the elbow leaves at a flat angle.
    "surface": ("plane", "inclined", "steep", "sphere", "cylinder", "bowl", "pipe", "box", "height_field"),
    "friction": ("none", "coulomb", "static", "stribeck", "viscous", "high", "grip"),
    "give": ("rigid", "restitution", "compliant"),
    "controller": (
        "none", "hold", "waypoints", "hand_path", "operator", "sampled", "encoders", "delayed", "torques", "gravity",
        "pressing",
    ),
    "start": ("given", "above", "on_surface", "on_references", "equilibrium"),
    "loads": ("none", "payload", "constant", "push", "body_push"),
    "objects": ("none", "box", "sphere", "hinge", "cart"),
    "ties": ("none", "linear", "torsion", "bounded"),
    "precision": ("default", "tight", "coarse"),
    "solver": ("articulated", "m_star"),
    "way": ("simulate", "pieces", "snapshot", "batch"),
    # A ball that falls on an object, on a link, or on a plate that the last link carries; links of the arm.
    "between": ("none", "objects", "links", "carried", "self"),
}  # fmt: skip
METHODS = ("auto", "dopri5", "radau5", "time_stepping")
METHOD = "method"
"""A factor of refusals in addition to :data:`FACTORS`."""


@dataclass(frozen=True)
class Refusal:
    """Levels that cannot be combined.

    Attributes
    ----------
    levels : dict
        Two or more factors, each with one or several levels; ``method`` may be among them.
    reason : str
        Why they cannot be combined.
    error : str
        Pattern of dynsim's message for a scene with these levels; empty: there is no such scene, because the levels
        exclude each other by their meaning.
    """

    levels: tuple[tuple[str, tuple[str, ...]], ...]
    reason: str
    error: str = ""

    def holds(self, levels: Levels) -> bool:
        """Whether an assignment, which may be partial, has all refused levels."""
        return all(levels.get(factor) in refused for factor, refused in self.levels)

    @property
    def name(self) -> str:
        """Levels of the refusal, joined to one word."""
        return "-".join("|".join(levels) for _, levels in self.levels)

    def holds_for(self, method: str) -> bool:
        """Whether the refusal concerns this method or all methods."""
        return method in dict(self.levels).get(METHOD, (method,))


def _refuse(reason: str, error: str = "", **levels: str | tuple[str, ...]) -> Refusal:
    chosen = tuple((key, (value,) if isinstance(value, str) else value) for key, value in levels.items())
    return Refusal(chosen, reason, error)


UNILATERAL = ("free", "points", "joints", "links")
GLUED = ("nothing", "glued")
SAMPLED = ("sampled", "encoders", "delayed")
# Controllers whose references are known for a whole run, with voltages planned along them.
PLANNED = ("gravity", "pressing")
DC = ("published", "dc")
STEPPED = "only time stepping has it"

WITH_BALL = ("objects", "links", "carried")

REFUSALS: tuple[Refusal, ...] = (
    # Feature × law.
    _refuse("under the glued law joints do not rest", r"contacts\.law: unilateral",
            contact=GLUED, rubbing=("bearing", "gear", "both")),
    _refuse("a glued point has one coefficient", r"contacts\.law: unilateral",
            contact=GLUED, friction=("static", "stribeck", "viscous", "grip")),
    _refuse("what is glued does not bounce or give way", r"contacts\.law: unilateral",
            contact=GLUED, give=("restitution", "compliant")),
    # Feature × method.
    _refuse(STEPPED, r"grip: .*integrator\.method: time_stepping",
            friction="grip", method=("auto", "dopri5", "radau5")),
    _refuse(STEPPED, r"stiffness_N_per_m.*: .*integrator\.method: time_stepping",
            give="compliant", method=("auto", "dopri5", "radau5")),
    _refuse(STEPPED, r"ties.*(contacts\.law: unilateral|integrator\.method: time_stepping)",
            ties=("linear", "torsion", "bounded"), method=("auto", "dopri5", "radau5")),
    _refuse("time stepping solves with articulated sweeps", r"integrator\.solver.*integrator\.method: auto",
            solver="m_star", method="time_stepping"),
    # Law or plant × method.
    _refuse("time stepping has the unilateral law alone", r"contacts\.law: unilateral",
            contact=GLUED, method="time_stepping"),
    _refuse("time stepping locates no overturning", r"integrator\.method: .*integrator\.method: auto",
            plant="mobile", method="time_stepping"),
    # These scenes would run slowly without tyres, until contacts contradict each other.
    _refuse("how the rigid wheels of a snake share its weight is not determined", "",
            plant="snake", method=("auto", "dopri5", "radau5")),
    # Plant × feature.
    _refuse("a snake stands on its wheels", "", plant="snake", contact=GLUED),
    _refuse("a snake has a controller of its own", r"'snake'",
            plant="snake", controller=("hold", "waypoints", "hand_path", "torques", "gravity", "pressing")),
    _refuse("a snake starts raised from below", r"", plant="snake",
            start=("on_surface", "on_references", "equilibrium")),
    _refuse("the joints of a snake are servos on position", r"", plant="snake",
            motor=("none", "partly", "published", "dc", "velocity", "torque")),
    _refuse("the postures of coupled joints are those of their file", COUPLED,
            plant="mimic", start=("on_surface", "equilibrium")),
    _refuse("nothing holds what floats", NOTHING_HOLDS,
            plant="floating", start="equilibrium", contact=("nothing", "free", "glued")),
    _refuse("nothing holds a free body", NOTHING_HOLDS,
            objects=("box", "sphere", "cart"), start="equilibrium", contact=GLUED),
    # The refusal does not apply if friction or braces hold all joints.
    _refuse("such motors hold no posture", "", motor=("none", "velocity"), start="equilibrium"),
    _refuse("such motors hold no posture", "", controller="none", start="equilibrium"),
    # Motor × controller.
    _refuse("a plan of voltages needs a DC motor at each joint", r"\bDC\b", motor=(
        "none", "partly", "servo", "velocity", "torque"), controller=PLANNED),
    _refuse("a plan of voltages needs a DC motor at each joint", r"\bDC\b",
            plant=("floating", "planar", "mimic"), controller=PLANNED),
    _refuse("a plan of voltages needs a DC motor at each joint, those of objects too", r"\bDC\b",
            objects=("box", "sphere", "hinge", "cart"), controller=PLANNED),
    _refuse("torques are of motors of that type", r"torque", motor=(
        "none", "partly", "published", "dc", "servo", "velocity"), controller="torques"),
    _refuse("nobody follows a path", r"motor", motor="none",
            controller=("waypoints", "hand_path", "operator")),
    _refuse("a torque follows no path", r"motor|torque", motor="torque",
            controller=("waypoints", "hand_path", "operator")),
    # Motor × friction of the gear.
    _refuse("there is no gear", "", motor=("none", "torque"), rubbing=("gear", "both")),
    _refuse("what presses starts on its surface", REFERENCES_OFF,
            controller="pressing", start="above"),
    # Start × others.
    _refuse("no joint has waypoints", f"{NO_WAYPOINTS}|{CANNOT_DRIVE}", start="on_references",
            controller=("none", "operator", "torques")),
    _refuse("no joint follows waypoints", f"{NO_WAYPOINTS}|motor", start="on_references",
            motor=("none", "torque")),
    _refuse("a glued point starts on its surface", OFF_SURFACE, start="above", contact="glued"),
    _refuse("no declared point", r"brace|contact", controller="pressing", contact=("nothing", "free")),
    # Bodies that touch each other.
    _refuse("under the glued law bodies do not touch each other", r"contacts\.between.*unilateral",
            between=("objects", "links", "self"), contact=GLUED),
    _refuse("a ball on a glued arm touches nothing", "", between="carried", contact=GLUED),
    _refuse("there is only one object", "", between="objects", objects="none"),
    _refuse("links of files have no radius", r"no links with a solid|has no solid", between=("links", "self"),
            plant=("urdf", "mimic", "floating", "planar")),
    _refuse("a snake moves its links as its own controller wants", "", between=("links", "carried", "self"),
            plant="snake"),
    _refuse("a plan of voltages needs a DC motor at each joint, those of objects too", r"\bDC\b",
            between=WITH_BALL, controller=PLANNED),
    _refuse("a ball on a ball or on a link has no equilibrium", "", between=WITH_BALL, start="equilibrium"),
    _refuse("links and joints near a plate start in it", "", between="carried", contact=("joints", "links")),
)  # fmt: skip


# Errors of a start that depend on the numbers of a scene, so that only dynsim can find them.
STARTS = {
    "equilibrium": rf"initial\.equilibrium: {NOTHING_HOLDS}",
    "on_surface": DO_NOT_BRING,
    # A hand path may use all joints that have motors.
    "on_references": f"{DO_NOT_BRING}|{NO_WAYPOINTS}",
}


def methods(levels: Levels) -> tuple[str, ...]:
    """Return the methods, including ``auto``, that support all levels of an assignment."""
    return tuple(method for method in METHODS if refused(levels, method) is None)


def refused(levels: Levels, method: str) -> Refusal | None:
    """Return the first refusal of a (possibly partial) assignment with a method, or None if it is accepted."""
    return next((refusal for refusal in REFUSALS if refusal.holds({**levels, METHOD: method})), None)


def matches(refusal: Refusal, text: str) -> bool:
    """Whether an error matches the pattern of a refusal."""
    return bool(refusal.error) and re.search(refusal.error, " ".join(text.split())) is not None
