"""Start postures that a user changes: gaps, bodies below surfaces, torques at rest, and the scenario keys for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dynsim.compile.clearance import SLACK, axis_ends, axis_gaps
from dynsim.compile.hand_posture import hand_posture, hand_turn, hand_turns
from dynsim.compile.model import Model
from dynsim.compile.posture import HAND, Rest, holding_torques, load_forces, load_torques, on_surfaces, static_margin
from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import drawn_surface, snake_scene
from dynsim.compile.touching import gap_at, touch
from dynsim.engine import check, named
from dynsim.engine.recording import drawn_scene, pictured_parts, provenance
from dynsim.errors import DynsimError, ModelError, ScenarioError
from dynsim.library import families
from dynsim.model.base_pose import base_coordinates, base_pose
from dynsim.model.description import Array, Contact, Link, Load, Robot
from dynsim.model.drives import Servo, TorqueSource, continuous_torque
from dynsim.model.urdf.reader import rotation
from dynsim.record import Record
from dynsim.record.joint_motion import yaml_name
from dynsim.record.poses import add_body_poses, poses_at
from dynsim.record.quaternion import of_matrix, rotated
from dynsim.record.scene import WORLD, Scene
from dynsim.record.urdf_text import roll_pitch_yaw
from dynsim.record.urdf_text import rotation as quaternion_matrix
from dynsim.scenario import Scenario, build, scenario_from_resolved
from dynsim.scenario.build import START_TOLERANCE
from dynsim.scenario.reading import merged_with

REVOLUTE_RANGE, PRISMATIC_RANGE = 180.0, 1.0
"""Range of the slider of a joint without limits, in both directions [deg, m]."""
IK_TOLERANCE = 1e-9
"""Residual of a solved hand position [m or rad]."""
SAG = 1e-5
"""Distance of the hand at the start of a run from this posture that is reported [m]."""
SAME = 1e-7
"""Difference up to which a joint is at its first waypoint, and the hand has the orientation of its path [rad or m]."""
AXIS_POINTS = 17
"""Number of points on the axis of a body among which a new brace is chosen."""
PATH_SAMPLES = 200
"""Number of points of the drawn hand path."""
FLAT = 90
"""Maximum length of a mapping in one line of the copied text."""
DECIMALS = {"_deg": 8, "_m": 10, "_rad": 10, "initial_base_pose": 10}
"""Decimal places of positions in the copied text, by the end of the key; they change a gap by less than 1 nm."""


@dataclass(frozen=True)
class Slider:
    """One adjustable coordinate of the start posture.

    Attributes
    ----------
    name : str
        Name of the joint, or of the joint and a component, such as ``base.x``.
    unit : str
        ``deg`` or ``m``.
    low, high : float
        Range of the slider in ``unit``.
    limits : tuple of float or None
        Lower and upper limit of the joint in ``unit``; None if there is none.
    leader : str
        Joint that this joint follows; empty if it is free.
    index : int
        Index of the coordinate.
    part : str
        ``base`` for the pose of a mobile base, ``attitude`` for roll, pitch and yaw of a free body, otherwise empty.
    component : int
        Component of the pose or attitude.
    """

    name: str
    unit: str
    low: float
    high: float
    limits: tuple[float | None, float | None] = (None, None)
    leader: str = ""
    index: int = 0
    part: str = ""
    component: int = 0


class StartPosture:
    """Start posture of a scenario that a user changes; subclasses know the kind of robot.

    Parameters
    ----------
    scenario : Scenario
        Scenario whose start is changed.

    Attributes
    ----------
    sliders : dict of str to Slider
        Sliders for all adjustable coordinates.
    q : ndarray
        Coordinates [rad or m].
    note : str
        Message about the last change; empty if there is nothing to report.
    """

    sliders: dict[str, Slider]
    q: Array
    scene: Scene

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self._original = scenario, scenario
        self.note = ""
        self._past: list[tuple[Array, Scenario]] = []
        self._future: list[tuple[Array, Scenario]] = []
        self._last = ""

    def begin(self) -> None:
        """Store the present posture as the start, to which :meth:`reset` returns."""
        self._start = self.q.copy()

    def set(self, name: str, value: float) -> None:
        """Set a slider [deg or m], within the range of its joint."""
        if name not in self.sliders:
            raise ModelError(f"unknown slider {name!r}; sliders: {', '.join(self.sliders)}")
        slider, q = self.sliders[name], self.q.copy()
        if slider.leader:
            raise ModelError(f"{name} follows {slider.leader}; move {slider.leader}")
        lower, upper = slider.limits
        value = max(value, value if lower is None else lower)
        self._put(slider, min(value, value if upper is None else upper), q)
        self._change(q, name=name)

    def undo(self) -> None:
        """Return to the posture before the last change."""
        self._swap(self._past, self._future)

    def redo(self) -> None:
        """Repeat the change that was undone last."""
        self._swap(self._future, self._past)

    def reset(self) -> None:
        """Return to the start posture of the scenario, without new contact points."""
        self._change(self._start.copy(), self._original)

    @property
    def changed(self) -> bool:
        """True if the posture or its contact points differ from the start of the scenario."""
        return self.scenario is not self._original or not np.array_equal(self.q, self._start)

    def _swap(self, source: list[tuple[Array, Scenario]], other: list[tuple[Array, Scenario]]) -> None:
        if source:
            other.append((self.q, self.scenario))
            self._last = ""
            self._apply(*source.pop())

    def _change(self, q: Array, scenario: Scenario | None = None, name: str = "") -> None:
        """Replace the posture; successive changes of one slider are undone together."""
        before = self.q, self.scenario
        self._apply(q, scenario or self.scenario)
        if not name or name != self._last:
            self._past.append(before)
        self._future.clear()
        self._last = name

    def _apply(self, q: Array, scenario: Scenario) -> None:
        self.q, self.scenario = q, scenario

    def _put(self, slider: Slider, value: float, q: Array) -> None:
        q[slider.index] = np.deg2rad(value) if slider.unit == "deg" else value

    def _value(self, slider: Slider) -> float:
        value = float(self.q[slider.index])
        return float(np.rad2deg(value)) if slider.unit == "deg" else value

    def reach(self, target: Sequence[float], *, keep_braces: bool = True, keep_orientation: bool = False) -> None:
        """Move the hand to a point [m]."""
        raise ModelError("the hand of a snake follows its joints; move the sliders")

    def snap(self, name: str, *, keep_hand: bool = False) -> None:
        """Put a contact point onto its surface."""
        raise ModelError("the plant has no contact points to put onto a surface")

    def add_brace(self, body: str, surface: str) -> None:
        """Add the point of a body's axis that is nearest to a surface as a contact point."""
        raise ModelError("braces can be added to the bodies of an arm only")

    def positions(self) -> Mapping[str, Mapping[str, float]]:
        """Return the positions of the scene's joints by signal and label."""
        raise NotImplementedError

    def start_positions(self) -> dict[str, float]:
        """Return the value of each coordinate, for ``start_keys`` of the plant."""
        raise NotImplementedError

    def _details(self, poses: Array) -> dict[str, Any]:
        """Return the parts of the frame that depend on the kind of robot."""
        raise NotImplementedError

    def keys(self) -> dict[str, Any]:
        """Return the scenario keys of the posture: plant, path start and contact points.

        Merged into the scenario like a variant, they reproduce the posture.
        """
        plant = self._original.plant
        return {"plant": rounded(families.member("plant", plant.type).start_keys(plant, self.start_positions()))}

    def notes(self) -> dict[tuple[str, ...], str]:
        """Return comments for keys of the copied text."""
        return {}

    def text(self) -> dict[str, str]:
        """Return the keys as YAML text, by section."""
        notes = self.notes()
        return {key: yaml_text({key: value}, notes) for key, value in self.keys().items()}

    def posed(self) -> Scenario:
        """Return the scenario with the keys of this posture."""
        return with_keys(self._original, self.keys())

    def check(self) -> None:
        """Check the scenario with the keys of this posture, and report the result as a note."""
        try:
            start = check(self.posed())
        except DynsimError as error:
            self.note = f"check: {error}"
        else:
            off, hand = start.off_path or 0.0, np.array(self.frame()["hand"])
            notes = [f"hand {1e3 * off:.3g} mm from the start of its path"] if off > START_TOLERANCE else []
            if (sag := float(np.linalg.norm(start.hand - hand))) > SAG:
                at = _flow(np.round(start.hand, 4).tolist())
                notes.append(
                    f"the run starts with the hand at {at} m, {1e3 * sag:.3g} mm from here (sag, pressed contacts)"
                )
            self.note = "; ".join(["check: ok", *notes, *start.warnings])

    def frame(self) -> dict[str, Any]:
        """Return the state of the page: values of the sliders, poses, gaps, torques, and the text to copy."""
        poses = poses_at(self.scene, self.positions())
        hand = self.scene.hand
        at = None if hand is None else poses[hand.body, :3] + rotated(poses[hand.body, 3:], np.array(hand.position))
        return {
            "values": {name: round(self._value(slider), 6) for name, slider in self.sliders.items()},
            "poses": np.round(poses, 6).ravel().tolist(),
            "hand": None if at is None else np.round(at, 6).tolist(),
            "text": self.text(),
            "note": self.note,
            "undo": len(self._past),
            "redo": len(self._future),
            **self._details(poses),
        }

    def hello(self) -> dict[str, Any]:
        """Return the description for the page."""
        sliders = [asdict(slider) for slider in self.sliders.values()]
        reaches = type(self).reach is not StartPosture.reach
        return {
            "sliders": sliders,
            "reaches": reaches,
            "bodies": self._bodies(),
            "surfaces": [s.name for s in self.scene.surfaces],
        }

    def _bodies(self) -> list[str]:
        """Return the names of the bodies to which a brace can be added."""
        return []

    def still(self) -> Record:
        """Return a record of the start posture and the hand's path, from which the page is built."""
        path = self.path()
        times = np.linspace(0.0, self.scenario.duration_s, PATH_SAMPLES) if path is not None else np.zeros(1)
        record = Record(times, provenance=provenance(self.scenario))
        record.scene = self.scene
        for signal, values in self.positions().items():
            record.add(signal, np.tile([*values.values()], (len(times), 1)), "rad", labels=tuple(values))
        if path is not None:
            record.add("target_position", path.position(times), "m", labels=("x", "y", "z"))
        add_body_poses(record)
        record.complete = True
        return record

    def picture(self) -> Record:
        """Return a record of the start posture with the contact forces at rest, for a page without a server."""
        record, forces = self.still(), self._forces()
        if forces:
            normal = np.tile([*forces.values()], (len(record), 1))
            record.add("contact_normal_force", normal, "N", labels=tuple(forces))
        return record

    def _forces(self) -> dict[str, float]:
        """Return the normal force of each enabled contact point at rest [N]; NaN if it does not touch."""
        return {}

    def path(self) -> Any:
        """Return the path of the hand, or None."""
        return None


class ArmPosture(StartPosture):
    """Start posture of an arm, fixed or on a mobile base or a free body."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        try:
            robot = build.robot_and_contacts(scenario)[0]
        except ModelError as error:  # an unreachable posture is the reason to open the page
            robot, self.note = build.unposed(scenario), str(error)
        objects = {link.name for name, body in scenario.config.objects.items() for link in body.links(name)}
        self._whole, own = robot, tuple(link for link in robot.links if link.name not in objects)
        joints = {link.joint for link in own}
        # The objects, which are the last links, are drawn only.
        bare = replace(robot, links=own, motors=tuple(m for m in robot.motors if m.joint in joints), ties=(), q0=None)
        self.robot = replace(bare, q0=robot.initial[: bare.nq])
        self.model = Model(self.robot)
        self._index = dict(zip(self.robot.joint_names, self.robot.position_index, strict=True))
        self._apply(self.robot.initial.copy(), scenario)
        scene = drawn_scene(scenario, robot, self._enabled)
        if scene is None:
            raise ModelError(f"plant {scenario.plant.type!r} cannot be drawn; set its start in the scenario")
        self.scene = scene
        self.sliders = {slider.name: slider for slider in self._all_sliders()}

    def _apply(self, q: Array, scenario: Scenario) -> None:
        """Use a posture, and the contact points of a scenario that are on the robot, enabled or disabled."""
        if scenario is not self.scenario or not hasattr(self, "points"):
            contacts, disabled = build.contacts(scenario, self._whole), build.disabled_points(scenario, self._whole)
            self._enabled = [contact for contact in contacts if self._is_own(scenario, contact)]
            self.points = {c.name: c for c in [*self._enabled, *disabled] if self._is_own(scenario, c)}
            self._disabled = {contact.name for contact in disabled}
        super()._apply(q, scenario)

    def _is_own(self, scenario: Scenario, contact: Contact) -> bool:
        """Return whether a contact point is on the robot, and its surface not on an object.

        Raises ModelError for an unknown body. Contacts between bodies are not points that the user can move.
        """
        build.check_body(scenario, self._whole, contact)
        ends = [contact.body] if contact.surface.carrier is None else [contact.body, contact.surface.carrier]
        indices = [self._whole.attach(end, contact.point)[0] for end in ends]
        return not contact.is_between_bodies and max(indices) < len(self.robot.links)

    def _all_sliders(self) -> list[Slider]:
        sliders: list[Slider] = []
        leaders = {coupling.joint: coupling.leader for coupling in self.robot.couplings}
        for link in self.robot.links:
            k, joint = self._index[link.joint], link.joint_of_rows or ""
            if link.kind == "left_wheel":
                names = (("x", "m"), ("y", "m"), ("heading", "deg"))
                sliders += [_unlimited(f"{joint}.{name}", unit, k, "base", c) for c, (name, unit) in enumerate(names)]
            elif link.kind == "ball_x":
                turns = enumerate(("roll", "pitch", "yaw"))
                sliders += [_unlimited(f"{joint}.{name}", "deg", k, "attitude", c) for c, name in turns]
            elif len(link.row.neutral) == 1:
                sliders.append(_slider(link, k, leaders.get(link.joint, "")))
        return sliders

    def _put(self, slider: Slider, value: float, q: Array) -> None:
        k = slider.index
        if slider.part == "base":
            pose = base_pose(self.robot, q[None])[0]
            pose[slider.component] = np.deg2rad(value) if slider.unit == "deg" else value
            turn, at = base_coordinates(self.robot, pose)
            q[k : k + 4] = -0.5 * turn, 0.5 * turn, *at
        elif slider.part == "attitude":
            rpy = self._attitude(q[k : k + 4])
            rpy[slider.component] = np.deg2rad(value)
            q[k : k + 4] = of_matrix(rotation(*rpy))
        else:
            super()._put(slider, value, q)
        self._follow(q)

    def _value(self, slider: Slider) -> float:
        if slider.part == "base":
            value = float(base_pose(self.robot, self.q[None])[0, slider.component])
            return float(np.rad2deg(value)) if slider.unit == "deg" else value
        if slider.part == "attitude":
            return float(np.rad2deg(self._attitude(self.q[slider.index : slider.index + 4])[slider.component]))
        return super()._value(slider)

    @staticmethod
    def _attitude(q: Array) -> Array:
        """Return roll, pitch and yaw of a quaternion w, x, y, z [rad]."""
        return roll_pitch_yaw(quaternion_matrix(q))

    def _follow(self, q: Array) -> None:
        """Set the positions of the joints that follow others."""
        index = self._index
        # Repeat this, because a follower may lead another joint and couplings are not ordered.
        for _ in self.robot.couplings:
            for coupling in self.robot.couplings:
                q[index[coupling.joint]] = coupling.ratio * q[index[coupling.leader]] + coupling.offset

    def positions(self) -> Mapping[str, Mapping[str, float]]:
        """Return the positions of the scene's joints by signal and label."""
        q = [*self.q.tolist(), *self._whole.initial[len(self.q) :].tolist()]
        positions = {"q": dict(zip(self._whole.position_names, q, strict=True))}
        if self.robot.base is not None:
            pose = base_pose(self.robot, self.q[None])[0].tolist()
            positions["base_pose"] = dict(zip(("x", "y", "heading"), pose, strict=True))
        return positions

    def start_positions(self) -> dict[str, float]:
        """Return the value of each coordinate, without joints that follow others."""
        followers = {coupling.joint for coupling in self.robot.couplings}
        named = zip(self.robot.position_names, self.q.tolist(), strict=True)
        return {name: value for name, value in named if name not in followers}

    # Solutions: hand position, points on surfaces, and new braces.

    def gaps(self) -> dict[str, float]:
        """Return the gap of each contact point, enabled or disabled [m]."""
        return {name: gap_at(self.model, contact, self.q) for name, contact in self.points.items()}

    def _touching(self) -> list[str]:
        """Return the enabled points that touch and that a joint moves along the normal."""
        gaps = self.gaps()
        points = (c for c in self._enabled if c.tip is None and not c.left_out)
        return [contact.name for contact in points if abs(gaps[contact.name]) <= START_TOLERANCE]

    def _uncoupled(self) -> tuple[Robot, list[str]]:
        """Return the robot in this posture without couplings, and the coupled joints, which stay at rest."""
        coupled = {name for coupling in self.robot.couplings for name in (coupling.joint, coupling.leader)}
        return replace(self.robot, q0=self.q.copy(), couplings=()), sorted(coupled)

    def reach(self, target: Sequence[float], *, keep_braces: bool = True, keep_orientation: bool = False) -> None:
        """Move the hand to a point, with the touching braces on their surfaces and the base at rest.

        Parameters
        ----------
        target : sequence of float
            Position of the hand in the world, (3,) [m].
        keep_braces : bool, optional
            Keep the contact points that touch on their surfaces.
        keep_orientation : bool, optional
            Keep the orientation of the hand.

        Raises
        ------
        UnreachableReference
            If the hand cannot reach the point.
        """
        robot, coupled = self._uncoupled()
        orientation = hand_turn(self.model, self.q) if keep_orientation else None
        arm, columns = self._on_fixed_base(robot)
        bodies = {link.name for link in arm.links} | {frame.name for frame in arm.frames}
        touching = self._touching() if keep_braces else []
        braces = [self.points[name] for name in touching if self.points[name].body in bodies]
        moving = [name for name in arm.joint_names if name not in coupled]
        q = self.q.copy()
        q[columns] = hand_posture(
            Model(arm), np.array(target, dtype=np.float64), q[columns], orientation, braces, IK_TOLERANCE, moving
        )
        self._change(q)

    def _on_fixed_base(self, robot: Robot) -> tuple[Robot, list[int]]:
        """Return the arm with its base fixed where it is, and the indices of its coordinates."""
        rows = {link.joint_of_rows for link in robot.links if len(link.row.neutral) != 1}
        several = {link.name for link in robot.links if link.joint_of_rows in rows}
        own = {link.name for link in robot.links} - several
        links, columns = [], []
        for link, k in zip(robot.links, robot.position_index, strict=True):
            if link.name not in own:
                continue
            if link.parent in several:
                R, p = self.model.body_pose(link.parent, self.q)
                link = replace(link, parent=None, R_PJ=R @ link.R_PJ, p_PJ=p + R @ link.p_PJ)
            links.append(link)
            columns.append(k)
        if robot.hand[0] not in own:
            raise ModelError(f"no joint moves the hand on {robot.hand[0]!r}; move the sliders of the base")
        frames = tuple(frame for frame in robot.frames if frame.body in own)
        arm = replace(robot, links=tuple(links), motors=(), frames=frames, base=None, feet=(), q0=None)
        return arm, columns

    def snap(self, name: str, *, keep_hand: bool = False) -> None:
        """Put a contact point onto its surface; points that touch stay on their surfaces.

        Raises
        ------
        ModelError
            If the point cannot reach its surface.
        """
        robot, coupled = self._uncoupled()
        names = [*dict.fromkeys([*self._touching(), name])]
        keep = [*coupled, *([HAND] if keep_hand else [])]
        self._change(on_surfaces(Model(robot), self.points, names, keep))

    def add_brace(self, body: str, surface: str) -> None:
        """Add the point of a body's axis that is nearest to a surface as a contact point, with the radius of the body.

        Raises
        ------
        ModelError
            If the body or the surface does not exist.
        """
        surfaces = build.surfaces(self.scenario)
        if body not in self._bodies() or surface not in surfaces:
            raise ModelError(
                f"cannot add a brace of {body!r} to {surface!r}; bodies: {', '.join(self._bodies())}; "
                f"surfaces: {', '.join(surfaces) or 'none'}"
            )
        ends = [end for end in axis_ends(self.robot)[body] if np.linalg.norm(end) > 0.0] or [np.zeros(3)]
        candidates = [share * end for end in ends for share in np.linspace(0.0, 1.0, AXIS_POINTS)]
        positions = [self.model.point_position(body, point, self.q) for point in candidates]
        nearest = candidates[int(np.argmin([surfaces[surface].gap(position) for position in positions]))]
        name, count = f"{body}_{surface}", 1
        while name in self.points:
            count += 1
            name = f"{body}_{surface}_{count}"
        radius = self.robot.links[self.robot.attach(body, nearest)[0]].radius
        entry: dict[str, Any] = {"body": body, "surface": surface, "point_m": np.round(nearest, 6).tolist()}
        entry |= {"radius_m": radius} if radius else {}
        self._change(self.q, with_keys(self.scenario, {"contacts": {"points": {name: entry}}}))

    def _bodies(self) -> list[str]:
        return [*self.robot.bodies]

    # Page: contact points, bodies near surfaces, and torques.

    @cached_property
    def _ratings(self) -> dict[str, tuple[float, float]]:
        """Largest torque at rest and continuous rating of each motor [N m or N]; infinite if unknown."""
        return {
            motor.joint: (
                motor.torque_limit if isinstance(motor, TorqueSource) else motor.stall_torque,
                continuous_torque(motor),
            )
            for motor in self.robot.motors
        }

    @cached_property
    def _uncoupled_model(self) -> Model:
        """Model without couplings; a torque at each follower, without heat, replaces the force of its coupling."""
        couplings, driven = self.robot.couplings, {motor.joint for motor in self.robot.motors}
        forces = tuple(TorqueSource(coupling.joint) for coupling in couplings if coupling.joint not in driven)
        return (
            Model(replace(self.robot, couplings=(), motors=(*self.robot.motors, *forces))) if couplings else self.model
        )

    def _rest(self) -> tuple[Rest, str]:
        """Return the torques at rest, and the reason if no motors and braces can hold the posture."""
        model, q, loads = self._uncoupled_model, self.q, self._loads()
        able = [m.joint for m in model.robot.motors if not (isinstance(m, Servo) and m.velocity_mode)]
        real = self.scenario.config.contacts.law == "unilateral"
        try:
            balance, reason = holding_torques(model, q, self._enabled, loads, able, real), ""
        except ModelError as error:
            free = np.asarray(model.bias_forces(q, np.zeros(model.n))) + load_torques(model, q, loads)
            balance, reason = Rest(free, {}, []), str(error).removeprefix("initial.equilibrium: ")
        # The motor of a leader also holds its followers.
        leads, index = {coupling.joint: coupling for coupling in self.robot.couplings}, self.robot.joint_names.index
        for follower in leads:
            joint, torque = follower, balance.torques[index(follower)]
            while joint in leads:
                joint, torque = leads[joint].leader, leads[joint].ratio * torque
            balance.torques[index(joint)] += torque
        return balance, reason

    def _forces(self) -> dict[str, float]:
        """Return the normal force of each enabled contact point at rest [N]; NaN if it does not touch."""
        normal = self._rest()[0].normal_forces
        return {contact.name: normal.get(contact.name, np.nan) for contact in self._enabled}

    def _loads(self) -> list[Load]:
        loads = build.loads(self.scenario, self._whole)
        return [load for load in loads if load.body in self.robot.bodies]

    def _details(self, poses: Array) -> dict[str, Any]:
        balance, reason = self._rest()
        gaps, index = self.gaps(), self.robot.joint_names.index
        points = []
        for name, contact in self.points.items():
            body, point = self.robot.attach(contact.body, contact.point)
            at = self.model.point_position(contact.body, contact.point, self.q)
            force = balance.normal_forces.get(name)
            points.append(
                {
                    "name": name,
                    "surface": contact.surface_name,
                    "body": body,
                    "p": point.tolist(),
                    "radius": contact.radius,
                    "friction": contact.friction_at_rest,
                    "gap": round(gaps[name], 9),
                    "at": np.round(at, 6).tolist(),
                    "normal": np.round(touch(self.model, contact, self.q).normal, 5).tolist(),
                    "force": None if force is None else round(force, 4),
                    "enabled": name not in self._disabled,
                    "snaps": contact.tip is None and not contact.left_out,
                }
            )
        near = [
            {"body": link.name, "surface": surface, "gap": round(float(gap[0]), 6), "least": -link.radius - SLACK}
            for link, surface, gap in axis_gaps(self.robot, build.surfaces(self.scenario), self.q[None])
        ]
        torques = {
            joint: [
                round(float(balance.torques[index(joint)]), 6),
                *(round(x, 6) if np.isfinite(x) else None for x in most),
            ]
            for joint, most in self._ratings.items()
        }
        return {
            "points": points,
            "bilateral": self.scenario.config.contacts.law == "bilateral",
            "near": sorted(near, key=lambda entry: entry["gap"]),
            "torques": torques,
            "units": {link.joint: link.units[3] for link in self.robot.links},
            "rest": reason,
            "margin": self._margin(balance),
            "target": self._target(),
        }

    def _margin(self, balance: Rest) -> float | None:
        """Return the tip margin of a mobile base at rest, with its braces; None without a mobile base."""
        if self.robot.base is None:
            return None
        forces = load_forces(self.model, self.q, self._loads())
        return round(static_margin(self.model, self.q, [*forces, *balance.forces]), 4)

    # Keys of the scenario.

    def path(self) -> Any:
        """Return the path of the hand, or None."""
        hand = getattr(self.scenario.controller, "hand", None)
        return None if hand is None else hand.path_in_world(self._context())

    def _context(self) -> BuildContext:
        """Return the context in which paths begin at the hand in the present posture."""
        return BuildContext(self.scenario.duration_s, self.model, start=self.q)

    def keys(self) -> dict[str, Any]:
        """Return the scenario keys of the posture: plant, path start, ``initial`` and contact points."""
        config, controller = self._original.config, self._controller_keys()
        keys = super().keys() | ({"controller": controller} if controller else {})
        initial = config.initial
        if initial is not None and initial.on_surface:
            gaps = self.gaps()
            names = [name for name in initial.on_surface if abs(gaps.get(name, np.inf)) <= START_TOLERANCE]
            if names != list(initial.on_surface):
                others = initial.equilibrium or initial.on_references
                keys["initial"] = {"on_surface": names} if names else {"on_surface": [], "keep": []} if others else None
        points: dict[str, Any] = {}
        for name, point in self.scenario.config.contacts.points.items():
            if own := config.contacts.points.get(name):
                points |= {name: own.model_dump(exclude_unset=True)} if own.enabled else {}
            else:
                points[name] = point.model_dump(include={"body", "surface", "point_m", "radius_m"})
        if points:
            keys["contacts"] = {"points": points}
        return keys

    def _controller_keys(self) -> dict[str, Any]:
        """Return the keys that start the references of the hand and of joints with waypoints in this posture."""
        controller, keys = self.scenario.controller, dict[str, Any]()
        positions = self.positions()["q"]
        for name, path in getattr(controller, "joints", {}).items():
            key, to_key = ("positions_m", float) if path.angles_deg is None else ("angles_deg", np.rad2deg)
            if name in positions and abs(path.values[0] - positions[name]) > SAME:
                waypoints = [float(to_key(positions[name])), *getattr(path, key)[1:]]
                keys.setdefault("joints", {})[name] = rounded({key: waypoints})
        hand = getattr(controller, "hand", None)
        if hand is None or hand.from_start:
            return keys
        starting_at = getattr(families.member("path", hand.path.type), "starting_at", None)
        keys["hand"], off, origin = {}, self._off_path(), np.array(hand.path.origin_m)
        if np.linalg.norm(off) > hand.tolerance_m:
            if starting_at is None:
                keys["hand"]["path"] = rounded({"origin_m": (origin - off).tolist()})
            else:
                at = self.model.point_position(*self.robot.hand, self.q) - origin
                keys["hand"]["path"] = rounded(starting_at(hand.path, at.tolist()))
        if hand.orientation is not None:
            rpy = np.rad2deg(roll_pitch_yaw(hand_turn(self.model, self.q))).tolist()
            if hand_turns(self.model, self.q[None], hand.orientation.matrix())[0] > SAME:
                keys["hand"]["orientation"] = rounded({"rpy_deg": rpy})
        return {key: value for key, value in keys.items() if value}

    def notes(self) -> dict[tuple[str, ...], str]:
        """Return comments for keys of the copied text: positions and gaps of contact points, start of the path."""
        notes: dict[tuple[str, ...], str] = {}
        for name, gap in self.gaps().items():
            contact = self.points[name]
            at = self.model.point_position(contact.body, contact.point, self.q)
            notes["contacts", "points", name] = (
                f"at {_flow((np.round(at, 6) + 0.0).tolist())} m, gap {1e3 * round(gap, 7) + 0.0:+.4f} mm"
            )
        off = 1e3 * float(np.linalg.norm(self._off_path()))
        return notes | {("controller", "hand", "path"): f"moved by {off:.4g} mm, to start at the hand"}

    def _target(self) -> list[float]:
        """Return points of the hand path with the copied keys, flattened x, y, z [m]; empty without a path."""
        if self.path() is None:
            return []
        hand = self.scenario.controller.hand
        moved = self._controller_keys().get("hand", {}).get("path", {})
        copied = hand.model_copy(update={"path": hand.path.model_copy(update=moved)})
        path = copied.path_in_world(self._context())
        times = np.linspace(0.0, self.scenario.duration_s, PATH_SAMPLES)
        return np.round(path.position(times), 4).ravel().tolist()

    def _off_path(self) -> Array:
        """Return the vector from the hand to the start of its path, (3,) [m]; zero without a path."""
        path = self.path()
        at = self.model.point_position(*self.robot.hand, self.q)
        return np.zeros(3) if path is None else path.position(np.zeros(1))[0] - at


class SnakePosture(StartPosture):
    """Start posture of a snake: joint angles, and the pose of its base part on the ground."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        kinematic = scenario
        if scenario.plant.level != "kinematic":
            # The keys of a dynamic snake are the commanded angles; it settles from them before the run.
            plant = scenario.plant.model_copy(update={"level": "kinematic"})
            kinematic = replace(scenario, config=scenario.config.model_copy(update={"plant": plant}))
            self.note = "commanded posture; the servos sag before the run starts: `check` reports by how much"
        description = build.machine(kinematic)
        assert not isinstance(description, Robot)
        self._names, self._wheels = description.joint_names, description.wheel_names
        self._radius = description.wheel_radius
        self.q = np.concatenate([description.initial_joints, description.initial_base_pose])
        self.scene = pictured_parts(snake_scene(description), scenario)
        surfaces = build.surfaces(scenario)
        if scenario.plant.level != "kinematic":
            drawn = tuple(drawn_surface(name, surface) for name, surface in surfaces.items())
            self.scene = replace(self.scene, surfaces=drawn)
        # Angles at a limit must not exceed it after they are rounded.
        scale = 10.0 ** DECIMALS["_rad"]
        limits = np.rad2deg(np.trunc(scale * np.array([description.lower, description.upper])) / scale).T.tolist()
        joints = [
            Slider(name, "deg", low, high, (low, high), index=k)
            for k, (name, (low, high)) in enumerate(zip(self._names, limits, strict=True))
        ]
        n = len(joints)
        base = [_unlimited(f"base.{name}", unit, n + k) for k, (name, unit) in enumerate(_SNAKE_BASE)]
        self.sliders = {slider.name: slider for slider in [*joints, *base]}

    def positions(self) -> Mapping[str, Mapping[str, float]]:
        """Return the positions of the scene's joints by signal and label."""
        angles, pose = self.q[:-3].tolist(), self.q[-3:].tolist()
        return {
            "phi": dict(zip(self._names, angles, strict=True)),
            "base_pose": dict(zip(("x", "y", "yaw"), pose, strict=True)),
            "rho": dict.fromkeys(self._wheels, 0.0),
        }

    def start_positions(self) -> dict[str, float]:
        """Return the joint angles, and the pose of the base part."""
        positions = self.positions()
        return {**positions["phi"], **{f"base.{name}": x for name, x in positions["base_pose"].items()}}

    def _details(self, poses: Array) -> dict[str, Any]:
        wheels = {k for k, body in enumerate(self.scene.bodies) if body.joint.signal == "rho"}
        origins = {body.name: poses[k, :3] for k, body in enumerate(self.scene.bodies) if k not in wheels}
        if (hand := self.scene.hand) is not None and hand.body != WORLD:
            origins["head"] = poses[hand.body, :3] + rotated(poses[hand.body, 3:], np.array(hand.position))
        near = [
            {"body": name, "surface": surface.name, "gap": round(float(surface.gap(origin)), 6), "least": 0.0}
            for surface in self.scene.surfaces
            for name, origin in origins.items()
        ]
        return {"points": [], "near": sorted(near, key=lambda entry: entry["gap"]), "torques": {}, "rest": ""}


_SNAKE_BASE = (("x", "m"), ("y", "m"), ("yaw", "deg"))


def open_posture(scenario: Scenario) -> StartPosture:
    """Open the start posture of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Scenario whose start is changed.

    Returns
    -------
    StartPosture
        Posture with sliders.

    Raises
    ------
    ScenarioError
        If the plant does not define which keys set its start.
    ModelError
        If the plant cannot be built.
    """
    with named(scenario):
        plant = scenario.plant
        if not hasattr(families.member("plant", plant.type), "start_keys"):
            raise ScenarioError(
                f"plant {plant.type!r} does not support posing; add start_keys to its module (docs/extending.md)"
            )
        posture = SnakePosture(scenario) if hasattr(plant, "initial_joints_rad") else ArmPosture(scenario)
        posture.begin()
        return posture


def with_keys(scenario: Scenario, keys: Mapping[str, Any]) -> Scenario:
    """Return the scenario with other keys, merged like a variant."""
    return scenario_from_resolved(merged_with(scenario.resolved, keys))


def _slider(link: Link, index: int, leader: str) -> Slider:
    """Return the slider of a joint with one coordinate."""
    angle = link.units[0] == "rad"
    scale = 180.0 / np.pi if angle else 1.0
    default = REVOLUTE_RANGE if angle else PRISMATIC_RANGE
    lower, upper = (float(scale * limit) if np.isfinite(limit) else None for limit in (link.lower, link.upper))
    low = min(-default, upper or 0.0) if lower is None else lower
    high = max(default, lower or 0.0) if upper is None else upper
    return Slider(link.joint, "deg" if angle else "m", low, high, (lower, upper), leader, index)


def _unlimited(name: str, unit: str, index: int, part: str = "", component: int = 0) -> Slider:
    span = REVOLUTE_RANGE if unit == "deg" else 2.0 * PRISMATIC_RANGE
    return Slider(name, unit, -span, span, index=index, part=part, component=component)


# Text of scenario keys.


def rounded(value: Any, key: str = "") -> Any:
    """Return keys with positions and angles rounded to ``DECIMALS``, without negative zeros."""
    if isinstance(value, Mapping):
        return {name: rounded(item, str(name) if not _decimals(key) else key) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item, key) for item in value]
    decimals = _decimals(key)
    return round(value, decimals) + 0.0 if isinstance(value, float) and decimals else value


def _decimals(key: str) -> int:
    return next((decimals for end, decimals in DECIMALS.items() if key.endswith(end)), 0)


def yaml_text(keys: Mapping[str, Any], notes: Mapping[tuple[str, ...], str], above: tuple[str, ...] = ()) -> str:
    """Return keys as YAML text; ``notes`` are comments above keys. Mappings at the third level are in one line."""
    lines = []
    for key, value in keys.items():
        at, indent = (*above, str(key)), "  " * len(above)
        flow, start = _flow(value), f"{indent}{yaml_name(key)}:"
        lines += [f"{indent}# {notes[at]}\n"] if at in notes else []
        nested = isinstance(value, Mapping) and any(isinstance(item, Mapping) for item in value.values())
        if isinstance(value, Mapping) and value and (len(at) == 1 or (len(at) == 2 and (nested or len(flow) > FLAT))):
            lines += [f"{start}\n", yaml_text(value, notes, at)]
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            lines += [f"{start}\n", *(f"{indent}  - {_flow(item)}\n" for item in value)]
        else:
            lines.append(f"{start} {flow}\n")
    return "".join(lines)


def _flow(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{yaml_name(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, float):
        return np.format_float_positional(value, trim="-")
    return str(value) if isinstance(value, int) else yaml_name(value)
