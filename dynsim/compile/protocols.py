"""Interfaces of the families: a member is a module with ``Config`` and ``build(config, context)``.

A scenario names a member by ``type``. The member's ``Config`` validates the section; ``build`` turns it into the
object that the engines use.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

from dynsim.compile.control import BasePath, HandPath, JointControl
from dynsim.compile.model import Model
from dynsim.config.base import StrictConfig
from dynsim.errors import ModelError
from dynsim.model.description import Contact, Robot
from dynsim.model.drives import Drive
from dynsim.model.surfaces import Box, HeightField, Quadric

if TYPE_CHECKING:
    from dynsim.snake.description import SnakeDescription, TaskSpaceController


@dataclass(frozen=True)
class BuildContext:
    """Data of the scenario for the ``build`` of a member.

    Attributes
    ----------
    duration : simulated time [s]
    machine : what a controller, or the path of a base, is built for; None for the other families
    joint : the joint of a motor, "" for the other families
    contacts : contacts of the scenario by name, also disabled points
    declared : names of the enabled points; disabled : of the others, which a path may still follow along a surface
    progress : to be called with the time [s] that references have come to, when they take long; None: nobody listens
    """

    duration: float
    machine: Model | SnakeDescription | None = None
    joint: str = ""
    progress: Callable[[float], None] | None = None
    contacts: Mapping[str, Contact] = field(default_factory=dict)
    declared: Sequence[str] = ()
    disabled: Sequence[str] = ()

    def at_joint(self, joint: str) -> BuildContext:
        """The context of a motor on that joint."""
        return replace(self, joint=joint)

    @property
    def model(self) -> Model:
        """The rigid-body model to be controlled; ModelError where there is none."""
        if not isinstance(self.machine, Model):
            raise ModelError("there is no rigid-body model to build this for")
        return self.machine

    @property
    def snake(self) -> SnakeDescription:
        """The snake to be controlled; ModelError where there is none."""
        # Imported here: an arm needs nothing of a snake.
        from dynsim.snake.description import SnakeDescription

        if not isinstance(self.machine, SnakeDescription):
            raise ModelError("there is no snake to build this for")
        return self.machine


class Member(Protocol):
    """A module of any family; the first line of its docstring is what ``dynsim list`` shows."""

    @property
    def Config(self) -> type[StrictConfig]:
        """Keys of its section; ``type`` is ``Literal["name of the member"]``."""

    def build(self, config: Any, context: BuildContext) -> Any:
        """What the section describes.

        Raises
        ------
        ModelError
            It describes nothing that can be built.
        """


class PlantModule(Member, Protocol):
    """A machine; ``ENGINE`` is the engine that simulates it, "dynamics" (a Robot) or "kinematic" (a snake)."""

    @property
    def ENGINE(self) -> str: ...

    def build(self, config: Any, context: BuildContext) -> Robot | SnakeDescription: ...


class ControllerModule(Member, Protocol):
    """A controller of the plants of ``ENGINE``, built for ``context.model`` or ``context.snake``."""

    @property
    def ENGINE(self) -> str: ...

    def build(self, config: Any, context: BuildContext) -> JointControl | TaskSpaceController: ...


class PathModule(Member, Protocol):
    """A path of the hand."""

    def build(self, config: Any, context: BuildContext) -> HandPath: ...


class BasePathModule(Member, Protocol):
    """A path of a mobile base; built for ``context.model``, which has one."""

    def build(self, config: Any, context: BuildContext) -> BasePath: ...


class SurfaceModule(Member, Protocol):
    """A surface that can be touched."""

    def build(self, config: Any, context: BuildContext) -> Quadric | Box | HeightField: ...


class MotorModule(Member, Protocol):
    """A motor, built for ``context.joint``."""

    def build(self, config: Any, context: BuildContext) -> Drive: ...
