"""Interfaces of the plug-in families: a member is a module with ``Config`` and ``build(config, context)``.

A scenario selects a member by ``type``. The member's ``Config`` validates the section; ``build`` turns it into the
object that the engines use.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

from dynsim.compile.model import Model
from dynsim.config.base import StrictConfig
from dynsim.errors import ModelError
from dynsim.model.description import Array, Contact

if TYPE_CHECKING:
    from dynsim.snake.description import SnakeDescription


@dataclass(frozen=True)
class BuildContext:
    """Scenario data that is passed to a member's ``build``.

    Attributes
    ----------
    duration : float
        Simulated time [s].
    machine : Model, SnakeDescription or None
        Machine that a controller or a base path is built for; None for other families.
    joint : str
        Joint that a motor drives; "" for other families.
    progress : callable or None
        Called during slow computations of references with the reference time reached so far [s].
    contacts : mapping of str to Contact
        Contacts of the scenario, including disabled points.
    declared : sequence of str
        Names of the enabled points.
    disabled : sequence of str
        Names of the disabled points, which a path may still follow along a surface.
    start : (nq,) ndarray or None
        Planned start of the model, if it differs from the simulated start [rad or m].
    """

    duration: float
    machine: Model | SnakeDescription | None = None
    joint: str = ""
    progress: Callable[[float], None] | None = None
    contacts: Mapping[str, Contact] = field(default_factory=dict)
    declared: Sequence[str] = ()
    disabled: Sequence[str] = ()
    start: Array | None = None

    @property
    def planned_start(self) -> Array:
        """Coordinates at the planned start, (nq,) [rad or m]."""
        return self.model.robot.initial if self.start is None else self.start

    def at_joint(self, joint: str) -> BuildContext:
        """Return the context for a motor on this joint."""
        return replace(self, joint=joint)

    @property
    def model(self) -> Model:
        """Rigid-body model to control; raises ModelError if the machine is not a model."""
        if not isinstance(self.machine, Model):
            raise ModelError("requires a plant with a rigid-body model")
        return self.machine

    @property
    def snake(self) -> SnakeDescription:
        """Snake to control; raises ModelError if the machine is not a snake."""
        # Imported here because an arm does not need the snake modules.
        from dynsim.snake.description import SnakeDescription

        if not isinstance(self.machine, SnakeDescription):
            raise ModelError("requires a snake plant")
        return self.machine


class Member(Protocol):
    """A module of any family; ``dynsim list`` shows the first line of its docstring."""

    @property
    def Config(self) -> type[StrictConfig]:
        """Configuration class of the member's section; ``type`` is ``Literal["name of the member"]``."""

    def build(self, config: Any, context: BuildContext) -> Any:
        """Build the object that the section describes.

        Raises
        ------
        ModelError
            If the object cannot be built.
        """
