"""Serial chain of links on a fixed base, with optional motors (Wang and Minami, section IV)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import (
    BodyPoint,
    Limits,
    NonNegative,
    Positive,
    StrictConfig,
    Vector3,
    default,
    error_at,
    unit_vector,
)
from dynsim.library import families
from dynsim.model.description import Inertia, Link, Robot, vector
from dynsim.model.drives import Drive

ENGINE = "dynamics"

MotorChoice: Any = families.union("motor")
AXES = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}

# Maximum number of links of a chain; each link takes a few kilobytes before the simulation starts.
LINKS_MAX = 100_000


class LinkKeys(StrictConfig):
    """Scenario keys of a joint and its link. The link extends from the joint along its own +z axis."""

    count: int = default(1, "number of equal links", ge=1, le=LINKS_MAX)
    kind: Literal["revolute", "prismatic"] = default("revolute", "type of the joint")
    axis: Literal["x", "y", "z"] | Vector3 = default("y", "joint axis in the link's frame")
    length_m: NonNegative = default(0.3, "length of the link")
    radius_m: Positive = default(
        0.01,
        "radius of the solid cylinder that defines the inertia, and depth below a surface beyond which a "
        "warning reports the link",
    )
    mass_kg: NonNegative = default(0.1, "mass of the link")
    com_m: Vector3 | None = default(None, "centre of mass in the link's frame; default: the middle of the link")
    inertia_kg_m2: list[float] | None = default(
        None,
        "inertia tensor xx, xy, xz, yy, yz, zz about the centre of mass; default: solid cylinder",
        min_length=6,
        max_length=6,
    )
    damping_N_m_s_per_rad: NonNegative = default(0.0, "viscous damping of a revolute joint")
    damping_N_s_per_m: NonNegative = default(0.0, "viscous damping of a prismatic joint")
    friction_N_m: NonNegative = default(0.0, "dry friction of a revolute joint; unilateral law")
    friction_N: NonNegative = default(0.0, "dry friction of a prismatic joint; unilateral law")
    motor: MotorChoice | None = default(None, "motor of the joint; default: no motor")
    limit_deg: Limits | None = default(None, "lower and upper stop of a revolute joint; default: no stops")
    limit_m: Limits | None = default(None, "lower and upper stop of a prismatic joint; default: no stops")
    initial_deg: float | None = default(
        None, "initial angle of a revolute joint; default: the angle within its limits that is nearest to 0"
    )
    initial_m: float | None = default(
        None, "initial position of a prismatic joint; default: the position within its limits that is nearest to 0"
    )

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, axis: str | list[float]) -> str | list[float]:
        if not isinstance(axis, str):
            unit_vector(axis, "axis")
        return axis


# Mapping from the keys of one kind of joint to their counterparts for the other kind.
ONLY_REVOLUTE = {
    "damping_N_m_s_per_rad": "damping_N_s_per_m",
    "friction_N_m": "friction_N",
    "initial_deg": "initial_m",
    "limit_deg": "limit_m",
}
ONLY_PRISMATIC = {angular: linear for linear, angular in ONLY_REVOLUTE.items()}


def _of_other_kind(kind: object) -> dict[str, str]:
    """Return a mapping from the keys that a joint of this kind does not have to their counterparts."""
    return ONLY_REVOLUTE if kind == "prismatic" else ONLY_PRISMATIC


class LinkConfig(LinkKeys):
    """Joint with its link, or `count` equal joints and links."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for key, instead in _of_other_kind(self.kind).items():
            if getattr(self, key) not in (0.0, None):
                raise error_at(key, f"not available for a {self.kind} joint; use {instead}")
        return self

    @property
    def initial(self) -> float:
        """Initial position [rad, or m if prismatic]; by default the position within the limits nearest to zero."""
        if not self.placed:
            return min(max(0.0, self.limits[0]), self.limits[1])
        return float(self.initial_m or 0.0 if self.kind == "prismatic" else np.deg2rad(self.initial_deg or 0.0))

    @property
    def placed(self) -> bool:
        """Whether the entry sets the initial position."""
        return (self.initial_m if self.kind == "prismatic" else self.initial_deg) is not None

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit [rad, or m if prismatic]; infinite if the joint has no limits."""
        if self.limit_deg is not None:
            low, high = np.deg2rad(self.limit_deg).tolist()
            return low, high
        return (self.limit_m[0], self.limit_m[1]) if self.limit_m is not None else (-np.inf, np.inf)

    def unit_axis(self) -> np.ndarray:
        """Return the joint axis as a unit vector, shape (3,)."""
        return unit_vector(AXES[self.axis] if isinstance(self.axis, str) else self.axis, "axis")

    def inertia(self) -> Inertia:
        """Return the mass properties of one link."""
        solid = Inertia.solid_cylinder(self.mass_kg, self.radius_m, self.length_m)
        com = solid.com if self.com_m is None else np.array(self.com_m)
        tensor = solid.tensor
        if self.inertia_kg_m2 is not None:
            xx, xy, xz, yy, yz, zz = self.inertia_kg_m2
            tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return Inertia(self.mass_kg, com, tensor)


class BaseConfig(StrictConfig):
    """Pose of the base of a serial chain."""

    position_m: Vector3 = default([0.0, 0.0, 0.0], "position of the first joint in the world")
    yaw_deg: float = default(0.0, "rotation about the vertical axis")


class Config(StrictConfig):
    """Serial chain: `chain` lists the links from the base to the hand, `link` sets defaults for all of them."""

    type: Literal["serial_arm"]
    base: BaseConfig = default(BaseConfig(), "pose of the base")
    gravity_m_s2: Vector3 = default([0.0, 0.0, -9.81], "gravitational acceleration")
    # Resolved scenarios omit this key, because every entry of their chain is complete.
    link: LinkKeys | None = default(None, "defaults for all entries of `chain`; default: none", exclude=True)
    chain: list[LinkConfig] = Field(min_length=1, description="links from the base to the hand")
    initial_deg: list[float] | None = default(
        None, "initial angles of all joints of a revolute chain; default: `initial_deg` of the links"
    )
    hand: BodyPoint | None = default(None, "controlled point; default: the end of the last link")

    @model_validator(mode="before")
    @classmethod
    def _check_shared(cls, data: Any) -> Any:
        """Reject a key of ``link`` that no entry uses, e.g. in a resolved scenario with complete entries."""
        link, chain = (data.get("link"), data.get("chain")) if isinstance(data, dict) else (None, None)
        if isinstance(link, dict) and isinstance(chain, list) and chain and all(isinstance(e, dict) for e in chain):
            taken = {key for entry in chain for key in _with_defaults(link, entry) if key not in entry}
            for key in link:
                if key in LinkKeys.model_fields and key not in taken:
                    fix = f"set {_owners(key, chain)} instead, or remove it"
                    raise error_at(f"link.{key}", f"has no effect on any entry of plant.chain; {fix}")
        return data

    @field_validator("chain", mode="before")
    @classmethod
    def _share(cls, chain: Any, info: ValidationInfo) -> Any:
        """Apply ``link`` as defaults to every entry; an invalid ``link`` is reported separately and skipped here."""
        link = info.data.get("link")
        if link is None or not isinstance(chain, list):
            return chain
        shared = {key: getattr(link, key) for key in link.model_fields_set}
        return [_with_defaults(shared, entry) if isinstance(entry, dict) else entry for entry in chain]

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = sum(link.count for link in self.chain)
        if n > LINKS_MAX:
            raise error_at("chain", f"has {n} links; must have at most {LINKS_MAX}")
        if self.initial_deg is not None:
            if len(self.initial_deg) != n:
                raise error_at("initial_deg", f"has {len(self.initial_deg)} angles for {n} joints; use one per joint")
            if any(link.kind == "prismatic" for link in self.chain):
                raise error_at("initial_deg", "requires only revolute joints; set initial_m and initial_deg per link")
        return self


def _with_defaults(shared: dict[str, Any], entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry of the chain, completed with the shared keys that apply to its kind of joint."""
    merged = {**shared, **entry}
    foreign = _of_other_kind(merged.get("kind"))
    return {key: value for key, value in merged.items() if key in entry or key not in foreign}


def _owners(key: str, chain: list[dict[str, Any]]) -> str:
    """Return the paths at which chain entries set the key; if none does, its counterpart for the other joint kind."""
    owners = [f"plant.chain.{i}.{key}" for i, entry in enumerate(chain) if key in entry]
    return ", ".join(owners) or {**ONLY_REVOLUTE, **ONLY_PRISMATIC}[key]


def build(config: Config, context: BuildContext) -> Robot:
    """Build the chain as a tree of bodies ``link_1``… with joints ``joint_1``… and initial positions.

    The frame of a link is at its joint, with +z along the link. The base is rotated by ``base.yaw_deg`` about +z.
    """
    yaw = np.deg2rad(config.base.yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    links: list[Link] = []
    motors: list[Drive] = []
    initial: list[float] = []
    nearest: list[str] = []
    reach = 0.0
    for group in config.chain:
        for _ in range(group.count):
            number = len(links) + 1
            first = not links
            links.append(
                Link(
                    name=f"link_{number}",
                    joint=f"joint_{number}",
                    parent=None if first else links[-1].name,
                    kind=group.kind,
                    axis=group.unit_axis(),
                    inertia=group.inertia(),
                    R_PJ=turn if first else np.eye(3),
                    p_PJ=np.array(config.base.position_m) if first else vector(0.0, 0.0, reach),
                    # The key of the other kind of joint is zero.
                    damping=group.damping_N_m_s_per_rad + group.damping_N_s_per_m,
                    friction=group.friction_N_m + group.friction_N,
                    lower=group.limits[0],
                    upper=group.limits[1],
                    radius=group.radius_m,
                    tip=vector(0.0, 0.0, group.length_m),
                )
            )
            if group.motor is not None:
                motors.append(families.build("motor", group.motor, context.at_joint(f"joint_{number}"), Drive))
            initial.append(group.initial)
            if initial[-1] and not group.placed:
                nearest.append(f"joint_{number}")
            reach = group.length_m
    if config.initial_deg is not None:
        initial, nearest = list(np.deg2rad(config.initial_deg)), []
    hand = (links[-1].name, vector(0.0, 0.0, reach))
    if config.hand is not None:
        hand = (config.hand.body, np.array(config.hand.point_m))
    return Robot(
        name="serial_arm",
        links=tuple(links),
        motors=tuple(motors),
        hand=hand,
        gravity=np.array(config.gravity_m_s2),
        q0=np.array(initial),
        nearest=tuple(nearest),
    )


def start_keys(config: Config, positions: Mapping[str, float]) -> dict[str, Any]:
    """Return the keys that start the chain at the given joint positions [rad or m]."""
    at = iter(range(1, sum(group.count for group in config.chain) + 1))
    groups = [(group, [positions[f"joint_{next(at)}"] for _ in range(group.count)]) for group in config.chain]
    if all(group.kind == "revolute" for group, _ in groups):
        return {"initial_deg": np.rad2deg([angle for _, values in groups for angle in values]).tolist()}
    chain = []
    for group, values in groups:
        entry = {key: value for key, value in group.model_dump(exclude_unset=True).items() if key != "count"}
        sliding = group.kind == "prismatic"
        chain += [entry | ({"initial_m": x} if sliding else {"initial_deg": float(np.rad2deg(x))}) for x in values]
    # The entries include the defaults of `link`.
    return {"chain": chain} | ({} if config.link is None else {"link": None})
