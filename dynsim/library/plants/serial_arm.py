"""A serial chain of links on a fixed base; each joint may have a motor (Wang and Minami, section IV)."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import BodyPoint, NonNegative, Positive, StrictConfig, Vector3, error_at, unit_vector
from dynsim.library import families
from dynsim.model.description import Inertia, Link, Robot, vector
from dynsim.model.drives import Drive

ENGINE = "dynamics"

MotorChoice: Any = families.union("motor")
AXES = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}


Limits = Annotated[list[float], Field(min_length=2, max_length=2)]

# Links of a chain; each takes some kilobytes before anything is simulated.
LINKS_MAX = 100_000


class LinkKeys(StrictConfig):
    """Keys of one joint and the link it carries. The link lies along its own +z from the joint."""

    count: int = Field(default=1, ge=1, le=LINKS_MAX, description="so many equal links")
    kind: Literal["revolute", "prismatic"] = "revolute"
    axis: Literal["x", "y", "z"] | Vector3 = Field(default="y", description="joint axis in the link's frame")
    length_m: NonNegative = 0.3
    radius_m: Positive = Field(
        default=0.01, description="of the solid cylinder that gives the inertia; a link deeper below a surface sinks"
    )
    mass_kg: NonNegative = 0.1
    com_m: Vector3 | None = Field(default=None, description="default: the middle of the link")
    inertia_kg_m2: list[float] | None = Field(
        default=None, min_length=6, max_length=6, description="xx xy xz yy yz zz about the com; default: solid cylinder"
    )
    damping_N_m_s_per_rad: NonNegative = Field(default=0.0, description="viscous loss of a revolute joint")
    damping_N_s_per_m: NonNegative = Field(default=0.0, description="viscous loss of a prismatic joint")
    friction_N_m: NonNegative = Field(
        default=0.0, description="dry friction of a revolute joint, which holds at rest; unilateral law"
    )
    friction_N: NonNegative = Field(default=0.0, description="the same of a prismatic joint")
    motor: MotorChoice | None = Field(default=None, description="motor of the joint; none: the joint swings free")
    limit_deg: Limits | None = Field(default=None, description="stops of a revolute joint; default: it turns freely")
    limit_m: Limits | None = Field(default=None, description="stops of a prismatic joint")
    initial_deg: float = Field(default=0.0, description="initial angle of a revolute joint")
    initial_m: float = Field(default=0.0, description="initial position of a prismatic joint")

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, axis: str | list[float]) -> str | list[float]:
        if not isinstance(axis, str):
            unit_vector(axis, "axis")
        return axis


# Keys that only one kind of joint has → their counterpart for the other kind.
ONLY_REVOLUTE = {
    "damping_N_m_s_per_rad": "damping_N_s_per_m",
    "friction_N_m": "friction_N",
    "initial_deg": "initial_m",
    "limit_deg": "limit_m",
}
ONLY_PRISMATIC = {angular: linear for linear, angular in ONLY_REVOLUTE.items()}


def _of_other_kind(kind: object) -> dict[str, str]:
    """Keys that a joint of this kind does not have → what it has instead."""
    return ONLY_REVOLUTE if kind == "prismatic" else ONLY_PRISMATIC


class LinkConfig(LinkKeys):
    """One joint and the link it carries, or ``count`` equal ones."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for key, instead in _of_other_kind(self.kind).items():
            if getattr(self, key) not in (0.0, None):
                raise error_at(key, f"a {self.kind} joint has {instead} instead")
        for key in ("limit_deg", "limit_m"):
            limits = getattr(self, key)
            if limits is not None and not limits[0] < limits[1]:
                raise error_at(key, f"the lower limit {limits[0]:g} is not below the upper one {limits[1]:g}")
        return self

    @property
    def damping(self) -> float:
        """Viscous loss D of the joint [N m s/rad, or N s/m when prismatic]."""
        return self.damping_N_s_per_m if self.kind == "prismatic" else self.damping_N_m_s_per_rad

    @property
    def friction(self) -> float:
        """Dry friction of the joint [N m, or N when prismatic]."""
        return self.friction_N if self.kind == "prismatic" else self.friction_N_m

    @property
    def initial(self) -> float:
        """Initial position [rad, or m when prismatic]."""
        return self.initial_m if self.kind == "prismatic" else float(np.deg2rad(self.initial_deg))

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit [rad, or m when prismatic], infinite without."""
        if self.limit_deg is not None:
            low, high = np.deg2rad(self.limit_deg).tolist()
            return low, high
        return (self.limit_m[0], self.limit_m[1]) if self.limit_m is not None else (-np.inf, np.inf)

    def unit_axis(self) -> np.ndarray:
        """Joint axis, (3,), of length one."""
        return unit_vector(AXES[self.axis] if isinstance(self.axis, str) else self.axis, "axis")

    def inertia(self) -> Inertia:
        """Mass properties of one link."""
        solid = Inertia.solid_cylinder(self.mass_kg, self.radius_m, self.length_m)
        com = solid.com if self.com_m is None else np.array(self.com_m)
        tensor = solid.tensor
        if self.inertia_kg_m2 is not None:
            xx, xy, xz, yy, yz, zz = self.inertia_kg_m2
            tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return Inertia(self.mass_kg, com, tensor)


class BaseConfig(StrictConfig):
    """Where the chain stands."""

    position_m: Vector3 = [0.0, 0.0, 0.0]
    yaw_deg: float = 0.0


class Config(StrictConfig):
    """A serial chain: ``chain`` lists its links from the base on; ``link`` gives what all of them share."""

    type: Literal["serial_arm"]
    base: BaseConfig = BaseConfig()
    gravity_m_s2: Vector3 = [0.0, 0.0, -9.81]
    # Not written into resolved scenarios: there every entry of the chain has it all.
    link: LinkKeys | None = Field(default=None, exclude=True, description="defaults for every entry of chain")
    chain: list[LinkConfig] = Field(min_length=1, description="links from the base to the hand")
    initial_deg: list[float] | None = Field(default=None, description="initial angles of all joints")
    hand: BodyPoint | None = Field(default=None, description="controlled point; default: the end of the last link")

    @model_validator(mode="before")
    @classmethod
    def _check_shared(cls, data: Any) -> Any:
        """Refuse a key of ``link`` that no entry takes, as in a resolved scenario, where every entry has its own."""
        link, chain = (data.get("link"), data.get("chain")) if isinstance(data, dict) else (None, None)
        if isinstance(link, dict) and isinstance(chain, list) and chain and all(isinstance(e, dict) for e in chain):
            taken = {key for entry in chain for key in _lay_under(link, entry) if key not in entry}
            for key in link:
                if key in LinkKeys.model_fields and key not in taken:
                    fix = f"set {_places(key, chain)} instead, or take it away"
                    raise error_at(f"link.{key}", f"has no effect on any entry of plant.chain; {fix}")
        return data

    @field_validator("chain", mode="before")
    @classmethod
    def _share(cls, chain: Any, info: ValidationInfo) -> Any:
        """Lay ``link`` under every entry; a ``link`` that is not valid has its own error and is not here."""
        link = info.data.get("link")
        if link is None or not isinstance(chain, list):
            return chain
        shared = {key: getattr(link, key) for key in link.model_fields_set}
        return [_lay_under(shared, entry) if isinstance(entry, dict) else entry for entry in chain]

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = sum(link.count for link in self.chain)
        if n > LINKS_MAX:
            raise error_at("chain", f"{n} links; at most {LINKS_MAX}")
        if self.initial_deg is not None:
            if len(self.initial_deg) != n:
                raise error_at("initial_deg", f"{len(self.initial_deg)} angles, the chain has {n} joints")
            if any(link.kind == "prismatic" for link in self.chain):
                raise error_at("initial_deg", "only for revolute chains; give initial_m and initial_deg per link")
        return self


def _lay_under(shared: dict[str, Any], entry: dict[str, Any]) -> dict[str, Any]:
    """An entry of the chain with the shared keys that it lacks and that its kind of joint has."""
    merged = {**shared, **entry}
    foreign = _of_other_kind(merged.get("kind"))
    return {key: value for key, value in merged.items() if key in entry or key not in foreign}


def _places(key: str, chain: list[dict[str, Any]]) -> str:
    """Where entries of the chain give a key, else its counterpart for their kind of joint."""
    owners = [f"plant.chain.{i}.{key}" for i, entry in enumerate(chain) if key in entry]
    return ", ".join(owners) or {**ONLY_REVOLUTE, **ONLY_PRISMATIC}[key]


def build(config: Config, context: BuildContext) -> Robot:
    """The chain as a tree of bodies ``link_1``…, with joints ``joint_1``… and initial positions.

    The link's own frame sits in its joint, +z along the link; the base is turned by ``base.yaw_deg`` about +z.
    """
    yaw = np.deg2rad(config.base.yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    links: list[Link] = []
    motors: list[Drive] = []
    initial: list[float] = []
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
                    damping=group.damping,
                    friction=group.friction,
                    lower=group.limits[0],
                    upper=group.limits[1],
                    radius=group.radius_m,
                    tip=vector(0.0, 0.0, group.length_m),
                )
            )
            if group.motor is not None:
                motors.append(families.build("motor", group.motor, context.at_joint(f"joint_{number}"), Drive))
            initial.append(group.initial)
            reach = group.length_m
    if config.initial_deg is not None:
        initial = list(np.deg2rad(config.initial_deg))
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
    )
