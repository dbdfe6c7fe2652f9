"""Schema of a scenario: its keys with types, units, limits and defaults, as frozen data; the validated scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from dynsim.config.base import BodyPoint, NonNegative, Positive, StrictConfig, Vector3, error_at
from dynsim.config.problems import Origin, listed
from dynsim.library.families import engine, section_defaults, union
from dynsim.record import notebook
from dynsim.scenario.combinations import BILATERAL_KEYS, THETA, UNILATERAL_KEYS, check_keys
from dynsim.scenario.effect import idle_keys, is_set
from dynsim.scenario.loads import LoadConfig
from dynsim.scenario.nulls import write_nulls
from dynsim.scenario.objects import SceneObject
from dynsim.scenario.sensors import Sensors
from dynsim.scenario.ties import TieChoice

# Most bytes in the name of a folder on common file systems.
NAME_LIMIT = 255

Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Grip(StrictConfig):
    """Friction that differs along and across an axis of the body, as that of a wheel."""

    axis: Vector3 = Field(description="in the axes of the body or frame: along it, as far as it lies in the surface")
    ratio: Share = Field(description="friction along the axis as a fraction of that across; 0: it rolls freely")

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, value: list[float]) -> list[float]:
        if not any(value):
            raise ValueError("has no direction")
        return value


class ContactPoint(BodyPoint):
    """A point fixed on a body, or a sphere about it, held to a surface."""

    surface: str = "floor"
    radius_m: NonNegative = Field(default=0.0, description="of a sphere about the point, which touches instead of it")
    friction: NonNegative | None = Field(default=None, description="kinetic coefficient; default: that of contacts")
    static_friction: NonNegative | None = Field(default=None, description="default: that of contacts; unilateral law")
    restitution: Share | None = Field(default=None, description="default: that of contacts; unilateral law")
    grip: Grip | None = Field(default=None, description="anisotropic friction; only of integrator.method time_stepping")
    stiffness_N_per_m: Positive | None = Field(
        default=None, description="default: that of contacts; time_stepping only"
    )
    damping_N_s_per_m: NonNegative | None = Field(default=None, description="default: that of contacts")
    enabled: bool = True


class Contacts(StrictConfig):
    """Contact law and contact points."""

    law: Literal["bilateral", "unilateral"] = Field(
        default="bilateral",
        description="points stay on their surfaces, f_n of any sign; or they are pushed only, stick, slip and lift off",
    )
    friction: NonNegative = Field(default=0.1, description="kinetic coefficient μ")
    static_friction: NonNegative | None = Field(
        default=None, description="coefficient that holds at rest, at least friction (the default); unilateral law"
    )
    stribeck_m_s: Positive | None = Field(
        default=None,
        description="v_s of μ + (μ_s − μ) exp(−(v/v_s)²); default: μ from the first slip on; unilateral law",
    )
    viscous_friction_s_per_m: NonNegative = Field(
        default=0.0, description="what each m/s of slip adds to the coefficient; unilateral law"
    )
    restitution: Share = Field(
        default=0.0, description="share of the normal speed that an impact turns round; unilateral law"
    )
    stiffness_N_per_m: Positive | None = Field(
        default=None, description="of body and surface along the normal; default: rigid; time_stepping only"
    )
    damping_N_s_per_m: NonNegative = Field(default=0.0, description="along the normal, beside the stiffness")
    slip_smoothing_m_s: Positive = Field(default=1e-3, description="v_s of the slip direction v_t/√(v_t² + v_s²)")
    pulling_friction: Literal["signed", "dissipative"] = Field(
        default="dissipative", description="f_t = μ f_n as printed in the paper, or μ |f_n|"
    )
    reference_tolerance_m: Positive = Field(
        default=2e-3, description="references that take a contact point further off its surface than this are refused"
    )
    candidates: Literal["points", "joints", "links"] = Field(
        default="points",
        description="what can touch beside the points: nothing, all joints and the hand, or the links as capsules",
    )
    points: dict[str, ContactPoint] = {}

    def coefficients(self, point: ContactPoint | None = None) -> tuple[float, float]:
        """Kinetic and static coefficient of a point: its own, else those of contacts; static defaults to kinetic."""
        kinetic, static = (
            getattr(self, key) if point is None or getattr(point, key) is None else getattr(point, key)
            for key in ("friction", "static_friction")
        )
        return kinetic, kinetic if static is None else static

    def compliance(self, point: ContactPoint | None = None) -> tuple[float, float]:
        """Stiffness [N/m], 0 of a rigid one, and damping [N s/m] of a point: its own, else those of contacts."""
        stiffness, damping = (
            getattr(self, key) if point is None or getattr(point, key) is None else getattr(point, key)
            for key in ("stiffness_N_per_m", "damping_N_s_per_m")
        )
        return stiffness or 0.0, damping

    @property
    def other_keys(self) -> tuple[str, ...]:
        """Keys that only the other law reads."""
        return BILATERAL_KEYS if self.law == "unilateral" else UNILATERAL_KEYS

    @model_validator(mode="after")
    def _check_coefficients(self) -> Self:
        self._check_compliance()
        kinetic, static = self.coefficients()
        if static < kinetic:
            raise error_at("static_friction", f"is less than friction {self.friction:g}; it must hold as much or more")
        for name, point in self.points.items():
            kinetic, static = self.coefficients(point)
            if static < kinetic:
                key = "friction" if point.static_friction is None else "static_friction"
                raise error_at(
                    f"points.{name}.{key}",
                    f"static_friction {static:g} is less than friction {kinetic:g}; it must hold as much or more",
                )
        return self

    def _check_compliance(self) -> None:
        """Refuse damping where nothing gives way, and restitution where something does."""
        for where, point in {"": None, **{f"points.{name}.": point for name, point in self.points.items()}}.items():
            config = self if point is None else point
            soft = self.compliance(point)[0] > 0.0
            anywhere = soft or (point is None and not all(p.stiffness_N_per_m is None for p in self.points.values()))
            if config.damping_N_s_per_m and not anywhere:
                raise error_at(f"{where}damping_N_s_per_m", "is that of what gives way: give stiffness_N_per_m too")
            restitution = self.restitution if point is None or point.restitution is None else point.restitution
            if soft and restitution > 0.0:
                key = "restitution" if config.restitution else "stiffness_N_per_m"
                raise error_at(f"{where}{key}", f"what gives way has no restitution ({restitution:g}), but a damping")


class Initial(StrictConfig):
    """The start: what the initial posture is changed by, as little as possible, and what holds it."""

    on_surface: list[str] = Field(
        default=[], description="contact points, also disabled ones, that start exactly on their surfaces"
    )
    keep: list[str] = Field(default=[], description="joints that do not move for it, and `hand` for the hand's place")
    on_references: bool = Field(default=False, description="joints with waypoints start where those begin")
    equilibrium: bool = Field(
        default=False, description="currents that hold posture, weight, loads and braces at rest, with the least heat"
    )

    @model_validator(mode="after")
    def _check_effect(self) -> Self:
        if not self.on_surface and not self.equilibrium and not self.on_references:
            raise error_at(
                "on_surface",
                "names no contact point; name some, set equilibrium or on_references: true, or leave initial out",
            )
        if self.keep and not self.on_surface:
            raise error_at("keep", "has no effect without on_surface, for which joints move; remove it")
        return self


class SurfaceError(StrictConfig):
    """By what surfaces differ from those that the controller plans with: how well a plan bears it."""

    shift_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="of all surfaces, in the world")
    friction_factor: NonNegative = Field(default=1.0, description="times every coefficient of friction")


class Integrator(StrictConfig):
    """Time integration."""

    method: Literal["auto", "dopri5", "radau5", "time_stepping"] = Field(
        default="auto",
        description="auto: one of the adaptive ones, by the system; adaptive 5(4), adaptive implicit (where motors "
        "hold the steps of the other), or fixed step with contacts that open and close",
    )
    solver: Literal["articulated", "m_star"] = Field(default="articulated", description="O(n) sweeps or the dense M*")
    rtol: float = Field(default=1e-6, ge=1e-13, le=1e-1)
    atol: float | None = Field(
        default=None,
        ge=1e-16,
        le=1e-1,
        description="default: rtol/100, at most 1e-8, so that a smaller rtol has its effect",
    )
    step_s: Positive | None = Field(
        default=None, description="fixed step of time_stepping (default 0.001), else the first step"
    )
    theta: float = Field(
        default=THETA, ge=0.5, le=1.0, description="time_stepping: 0.5 is second order between events, 1 damps"
    )
    step_max_s: Positive | None = None
    wall_limit_s: Positive | None = Field(
        default=None, description="wall time that the integration may take; ten times as much by estimate is refused"
    )

    @field_validator("method", mode="before")
    @classmethod
    def _replaced(cls, value: object) -> object:
        if value in ("rk4", "rk43"):
            raise ValueError("is no longer there; take dopri5, or time_stepping where steps are to be fixed")
        return value

    @property
    def absolute_tolerance(self) -> float:
        """``atol``, or its default: a fixed one would limit the accuracy at small ``rtol``."""
        return min(1e-8, 1e-2 * self.rtol) if self.atol is None else self.atol


class RecordOptions(StrictConfig):
    """What is recorded."""

    rate_hz: Positive = 200.0
    size_limit_GB: Positive = 2.0


class Metrics(StrictConfig):
    """How the summary is computed."""

    settle_s: NonNegative = Field(default=2.0, description="tracking errors count from this time on")


def laid_under(defaults: Any, said: Any) -> Any:
    """``said`` with ``defaults`` where it says nothing; mappings merge."""
    if not (isinstance(defaults, Mapping) and isinstance(said, Mapping)):
        return said
    return {**defaults, **{key: laid_under(defaults.get(key), value) for key, value in said.items()}}


class ScenarioConfig(StrictConfig):
    """A dynsim scenario."""

    name: str = Field(default="", description="default: the name of the file")
    variant: str = Field(default="", description="written into resolved scenarios")
    description: str = ""
    duration_s: Positive
    plant: union("plant")  # type: ignore[valid-type]
    controller: union("controller") | None = None  # type: ignore[valid-type]
    surfaces: dict[str, union("surface")] = {}  # type: ignore[valid-type]
    contacts: Contacts = Contacts()
    surface_error: SurfaceError | None = Field(
        default=None, description="by what surfaces and friction differ from those that the controller plans with"
    )
    initial: Initial | None = Field(default=None, description="posture and currents of the start")
    loads: dict[str, LoadConfig] = Field(default={}, description="forces, torques and payloads by name")
    objects: dict[str, SceneObject] = Field(default={}, description="bodies beside the robot, by name")
    ties: dict[str, TieChoice] = Field(default={}, description="springs and dampers between two bodies, by name")
    sensors: Sensors | None = Field(default=None, description="what a sampled controller is told of the robot")
    integrator: Integrator = Integrator()
    record: RecordOptions = RecordOptions()
    metrics: Metrics = Metrics()

    @model_validator(mode="before")
    @classmethod
    def _of_plant(cls, data: Any) -> Any:
        """Some plants want other defaults in other sections."""
        if not isinstance(data, Mapping):
            return data
        return laid_under(section_defaults(data.get("plant"), data), data)

    @model_validator(mode="after")
    def _check_combinations(self) -> Self:
        check_keys(self)
        return self

    @field_validator("name", "variant")
    @classmethod
    def _check_folder(cls, value: str) -> str:
        """Both name folders of the results: neither may lead out of them."""
        if value in (".", "..") or any(sign in value for sign in "/\\\0"):
            raise ValueError("names a folder of the results, so it must not have slashes or be dots")
        if not value.isprintable():
            raise ValueError("names a folder of the results, so it must be printable in one line")
        if len(value.encode()) > NAME_LIMIT:
            raise ValueError(f"names a folder of the results, so it must not be longer than {NAME_LIMIT} bytes")
        return value


@dataclass(frozen=True)
class Scenario:
    """One validated simulation.

    Attributes
    ----------
    name, variant : str
        The variant is "" for a scenario without variants.
    config : ScenarioConfig
    source : Path or None
        The file it came from.
    origin : Origin or None
        Lines of its keys in that file.
    """

    name: str
    variant: str
    config: ScenarioConfig
    source: Path | None = None
    origin: Origin | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        config = self.config
        parts = [config.plant.type, config.controller.type if config.controller else "no controller"]
        parts.append(f"{config.duration_s:g} s")
        contacts = [name for name, point in config.contacts.points.items() if point.enabled]
        if contacts:
            parts.append(f"contacts {listed(contacts)}")
        return f"<Scenario {self.title}: {', '.join(parts)}>"

    def _repr_html_(self) -> str:
        config = self.config
        contacts = [name for name, point in config.contacts.points.items() if point.enabled]
        rows = [
            ("plant", config.plant.type),
            ("controller", config.controller.type if config.controller else "–"),
            ("duration", f"{config.duration_s:g} s"),
            ("surfaces", ", ".join(config.surfaces) or "–"),
            ("contacts", f"{', '.join(contacts)} ({config.contacts.law})" if contacts else "–"),
            ("loads", ", ".join(config.loads) or "–"),
            ("integrator", config.integrator.method),
        ]
        about = [("", " ".join(config.description.split()))] if config.description else []
        return notebook.table(self.title, [*about, *rows])

    @property
    def title(self) -> str:
        """Name and variant, for a line of text."""
        return f"{self.name} ({self.variant})" if self.variant else self.name

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return self.config.duration_s

    @property
    def plant(self) -> Any:
        """Configuration of the machine, the ``Config`` of its module."""
        return self.config.plant

    @property
    def controller(self) -> Any:
        """Configuration of the controller, None without one."""
        return self.config.controller

    @property
    def integrator(self) -> Integrator:
        """Method, solver and tolerances."""
        return self.config.integrator

    @property
    def record(self) -> RecordOptions:
        """Rate [Hz] and size limit [GB] of the record."""
        return self.config.record

    @property
    def metrics(self) -> Metrics:
        """How the summary is computed."""
        return self.config.metrics

    @property
    def engine(self) -> str:
        """What simulates the plant."""
        return engine(self.plant)

    @property
    def resolved(self) -> dict[str, Any]:
        """The scenario with defaults and overrides written out; reading it again gives the same simulation.

        Defaults that change nothing are left out.
        """
        resolved = self.config.model_dump(mode="json", exclude_none=True)
        write_nulls(self.config, resolved, section_defaults(resolved["plant"], resolved))
        for section in ("loads", "objects", "ties"):
            if not getattr(self.config, section):
                del resolved[section]
        contacts = self.config.contacts
        for part in (resolved["contacts"], *resolved["contacts"]["points"].values()):
            for key in contacts.other_keys:
                part.pop(key, None)
        # What changes nothing is not there, unless it was said.
        for keys in idle_keys(self.config):
            section, *inner = map(str, keys)
            if len(inner) == 1 and not is_set(self.config, keys) and isinstance(resolved.get(section), dict):
                resolved[section].pop(inner[0], None)
                if not resolved[section]:
                    del resolved[section]
        return resolved

    def location(self, keys: Sequence[int | str] = (), variant: str = "") -> str:
        """``file:line`` of a key, the text for ``variant``, and how the key was overridden."""
        line, overridden = 0, ""
        if keys and self.origin is not None:
            overridden = f": {self.origin.overriding}" if self.origin.sets(keys) else ""
            line = 0 if overridden else self.origin.line(keys)
        return f"{self.source or self.name}{f':{line}' if line else ''}{variant}{overridden}"
