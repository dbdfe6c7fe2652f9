"""Every family member in the package fulfils the protocol of its family, statically and at run time."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, Protocol, get_args

import pytest

from dynsim.compile.control import BasePath, HandPath, JointControl
from dynsim.compile.protocols import BuildContext, Member
from dynsim.config.base import StrictConfig
from dynsim.errors import ModelError
from dynsim.library import families
from dynsim.library.base_paths import arc, hold, straight
from dynsim.library.base_paths import csv as base_csv
from dynsim.library.base_paths import waypoints as base_waypoints
from dynsim.library.controllers import joint_pd, task_space
from dynsim.library.motors import catalogue, dc, servo, torque, wang_minami
from dynsim.library.paths import circle, csv, line, waypoints
from dynsim.library.plants import pws_arm, serial_arm, snake, urdf_arm
from dynsim.library.surfaces import box, cylinder, height_field, plane, sphere
from dynsim.model.description import Robot
from dynsim.model.drives import Drive
from dynsim.model.surfaces import Box, HeightField, Quadric
from dynsim.snake.description import SnakeDescription, TaskSpaceController


class PlantModule(Member, Protocol):
    """A machine; ``ENGINE`` is the engine that simulates it, "dynamics" (a Robot) or "kinematic" (a snake)."""

    @property
    def ENGINE(self) -> str: ...

    def build(self, config: Any, context: BuildContext) -> Robot | SnakeDescription: ...


class ControllerModule(Member, Protocol):
    """A controller for plants of ``ENGINE``, built for ``context.model`` or ``context.snake``."""

    @property
    def ENGINE(self) -> str: ...

    def build(self, config: Any, context: BuildContext) -> JointControl | TaskSpaceController: ...


class PathModule(Member, Protocol):
    """A path of the hand."""

    def build(self, config: Any, context: BuildContext) -> HandPath: ...


class BasePathModule(Member, Protocol):
    """A path of a mobile base, built for ``context.model`` with a base."""

    def build(self, config: Any, context: BuildContext) -> BasePath: ...


class SurfaceModule(Member, Protocol):
    """A surface that can be touched."""

    def build(self, config: Any, context: BuildContext) -> Quadric | Box | HeightField: ...


class MotorModule(Member, Protocol):
    """A motor, built for ``context.joint``."""

    def build(self, config: Any, context: BuildContext) -> Drive: ...


PLANTS: Sequence[PlantModule] = (pws_arm, serial_arm, snake, urdf_arm)
CONTROLLERS: Sequence[ControllerModule] = (joint_pd, task_space)
PATHS: Sequence[PathModule] = (circle, csv, line, waypoints)
BASE_PATHS: Sequence[BasePathModule] = (arc, base_csv, hold, straight, base_waypoints)
SURFACES: Sequence[SurfaceModule] = (box, cylinder, height_field, plane, sphere)
MOTORS: Sequence[MotorModule] = (dc, servo, torque, wang_minami)

FAMILIES: dict[str, Sequence[Member]] = {
    "plant": PLANTS,
    "controller": CONTROLLERS,
    "path": PATHS,
    "base_path": BASE_PATHS,
    "surface": SURFACES,
    "motor": MOTORS,
}


@pytest.mark.parametrize("family", families.FAMILIES)
def test_these_are_all_members_and_each_has_what_its_family_asks_for(family: str) -> None:
    modules = [*FAMILIES[family], *(map(catalogue.member, catalogue.NAMES) if family == "motor" else ())]
    types = [get_args(module.Config.model_fields["type"].annotation) for module in modules]
    assert sorted(types) == [(name,) for name in families.shipped(family)]
    for (name,), module in zip(types, modules, strict=True):
        assert families._defect(module, family, name) == ""


@pytest.mark.parametrize("family", ["surface", "motor", "path", "base_path"])
def test_a_member_that_gives_something_else_is_named(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module = FAMILIES[family][0]
    name = families.shipped(family)[0]
    config = SimpleNamespace(type=name)
    monkeypatch.setattr(module, "build", lambda config, context: "nothing")
    with pytest.raises(ModelError) as caught:
        families.build(family, config, BuildContext(1.0), StrictConfig)
    assert all(word in str(caught.value) for word in (family, f"'{name}'", "'nothing'"))


def test_a_context_without_a_machine_says_so() -> None:
    with pytest.raises(ModelError) as caught:
        joint_pd.build(joint_pd.Config(type="joint_pd"), BuildContext(1.0))
    assert "snake" not in str(caught.value)
    with pytest.raises(ModelError) as caught:
        task_space.build(task_space.Config(), BuildContext(1.0))
    assert "snake" in str(caught.value)
