"""Combinations that were wrong once: levels that differ from a plain scene, and numbers of scenes with the fault."""

from __future__ import annotations

from dataclasses import dataclass

KNOWN_SEED = 1000
# An arm that leans an elbow on a plane and holds.
PLAIN = {
    "plant": "revolute", "motor": "published", "rubbing": "nothing", "stops": "none", "contact": "points",
    "points": "elbow", "shape": "point", "surface": "plane", "friction": "coulomb", "give": "rigid",
    "controller": "hold", "start": "given", "loads": "none", "objects": "none", "ties": "none",
    "precision": "default", "solver": "articulated", "way": "simulate", "between": "none",
}  # fmt: skip


@dataclass(frozen=True)
class Known:
    """A corrected fault.

    Attributes
    ----------
    fault : str
        Description in one sentence.
    levels : dict
        Levels that differ from :data:`PLAIN`.
    numbers : tuple of int
        Scenes with the fault.
    """

    fault: str
    levels: dict[str, str]
    numbers: tuple[int, ...]

    @property
    def assignment(self) -> dict[str, str]:
        """Return the levels of all factors."""
        return {**PLAIN, **self.levels}


KNOWN = {
    "sampled_start": Known(
        "commands before the choice of modes, with dry friction of joints: the arm began at q = 0",
        {"rubbing": "bearing", "controller": "sampled"},
        (0,),
    ),
    "force_of_spheres": Known(
        "time stepping recorded forces of spheres and capsules with a wrong tangential direction",
        {"shape": "sphere", "controller": "waypoints"},
        (0, 2),
    ),
    "jam": Known(
        "a contact stayed sticking while its normal force grew from nothing",
        {"motor": "torque", "controller": "torques", "friction": "high", "surface": "steep"},
        (6, 10, 20),
    ),
    "unmoved": Known(
        "a point that joints move by rounding alone got forces without bound",
        {"points": "unmoved", "shape": "sphere", "controller": "waypoints"},
        (2, 6),
    ),
    "equilibrium": Known(
        "a start at rest that needs friction began on the edge of the cone and slipped",
        {"motor": "partly", "start": "equilibrium", "friction": "high"},
        (4,),
    ),
    "equilibrium_of_two": Known(
        "the same, with two points on planes that lean",
        {"motor": "partly", "start": "equilibrium", "friction": "high", "surface": "inclined", "points": "two"},
        (2, 8),
    ),
    "passed_stop": Known(
        "time stepping never moved a joint back to a stop that it had passed",
        {"rubbing": "bearing", "stops": "reached", "contact": "free", "motor": "none", "controller": "none"},
        (2,),
    ),
    "snake_start": Known(
        "what stands beside a snake moved while its head was raised, before the run",
        {"plant": "snake", "motor": "servo", "controller": "sampled", "objects": "box", "give": "compliant"},
        (0,),
    ),
    "voltage": Known(
        "the recorded voltage of a sampled loop was that before the tick",
        {"controller": "sampled"},
        (0,),
    ),
}
