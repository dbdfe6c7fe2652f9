"""Arms from URDF with gears of ratio 100, over a bench: geometry of common seven- and six-axis arms, rounded masses.

The reflected inertia of a rotor, 0.5 kg m², exceeds the inertia of most links. The motors are assumed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from dynsim.scenario import Scenario
from dynsim.scenario.reading import scenario_from_resolved

HALF = 1.5707963267948966


class Axis(NamedTuple):
    """Joint and the link that it moves: frame in the parent's frame, axis, limits [rad], mass [kg], centre [m]."""

    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    axis: str
    limits: tuple[float, float]
    mass: float
    com: tuple[float, float, float]


SEVEN_AXES = (
    Axis((0, 0, 0.333), (0, 0, 0), "0 0 1", (-2.9, 2.9), 4.0, (0, -0.03, -0.1)),
    Axis((0, 0, 0), (-HALF, 0, 0), "0 0 1", (-1.76, 1.76), 3.0, (0, -0.1, 0.03)),
    Axis((0, -0.316, 0), (HALF, 0, 0), "0 0 1", (-2.9, 2.9), 3.2, (0.03, 0.03, -0.07)),
    Axis((0.0825, 0, 0), (HALF, 0, 0), "0 0 1", (-3.07, -0.07), 3.5, (-0.05, 0.1, 0.03)),
    Axis((-0.0825, 0.384, 0), (-HALF, 0, 0), "0 0 1", (-2.9, 2.9), 1.2, (0, 0.03, -0.1)),
    Axis((0, 0, 0), (HALF, 0, 0), "0 0 1", (0.0, 3.75), 1.7, (0.06, 0, 0)),
    Axis((0.088, 0, 0), (HALF, 0, 0), "0 0 1", (-2.9, 2.9), 0.8, (0, 0, 0.08)),
)
SIX_AXES = (
    Axis((0, 0, 0.089), (0, 0, 0), "0 0 1", (-3.1, 3.1), 3.7, (0, 0, 0)),
    Axis((0, 0.136, 0), (0, HALF, 0), "0 1 0", (-3.1, 3.1), 8.4, (0, 0, 0.28)),
    Axis((0, -0.12, 0.425), (0, 0, 0), "0 1 0", (-2.8, 2.8), 2.3, (0, 0, 0.25)),
    Axis((0, 0, 0.392), (0, HALF, 0), "0 1 0", (-3.1, 3.1), 1.2, (0, 0, 0)),
    Axis((0, 0.093, 0), (0, 0, 0), "0 0 1", (-3.1, 3.1), 1.2, (0, 0, 0)),
    Axis((0, 0, 0.095), (0, 0, 0), "0 1 0", (-3.1, 3.1), 0.2, (0, 0, 0)),
)
MOTOR = {
    "type": "dc", "torque_constant_N_m_per_A": 0.1, "resistance_ohm": 0.5, "inductance_H": 5e-4,
    "rotor_inertia_kg_m2": 5e-5, "gear_ratio": 100, "gear_damping_N_m_s_per_rad": 1e-4,
}  # fmt: skip


def urdf(axes: tuple[Axis, ...], hand: tuple[float, float, float]) -> str:
    """Return the URDF of an arm; a link has the inertia of a sphere with a radius of gyration of 8 cm."""
    parts = ['<robot name="arm">', '<link name="base"/>']
    for k, a in enumerate(axes, 1):
        inertia = 0.0064 * a.mass
        x, y, z = a.com
        parts.append(
            f'<link name="link_{k}"><inertial><origin xyz="{x} {y} {z}"/><mass value="{a.mass}"/>'
            f'<inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint_{k}" type="revolute"><parent link="{"base" if k == 1 else f"link_{k - 1}"}"/>'
            f'<child link="link_{k}"/><origin xyz="{" ".join(map(str, a.xyz))}" rpy="{" ".join(map(str, a.rpy))}"/>'
            f'<axis xyz="{a.axis}"/><limit lower="{a.limits[0]}" upper="{a.limits[1]}" effort="300" velocity="3"/>'
            '<dynamics damping="5"/></joint>'
        )
    parts.append(
        f'<link name="hand"/><joint name="flange" type="fixed"><parent link="link_{len(axes)}"/><child link="hand"/>'
        f'<origin xyz="{" ".join(map(str, hand))}"/></joint></robot>'
    )
    return "\n".join(parts)


def geared_arm(folder: Path, joints: int, payload_kg: float = 0.0) -> Scenario:
    """Return an arm of 7 or 6 joints whose hand moves back and forth over a bench in 8 s; its elbow has a pad."""
    axes, hand = (SEVEN_AXES, (0.0, 0.0, 0.107)) if joints == 7 else (SIX_AXES, (0.0, 0.082, 0.0))
    file = folder / f"arm_{joints}.urdf"
    file.write_text(urdf(axes, hand), encoding="utf-8")
    start = (0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0) if joints == 7 else (0.0, -60.0, 90.0, -30.0, 0.0, 0.0)
    body, point, top, z = (
        ("link_5", [0.0, 0.0, -0.3], 0.2, 0.3) if joints == 7 else ("link_3", [0.0, 0.0, 0.0], -0.1, 0.4)
    )
    ends = [[0.5, -0.15, z], [0.55, 0.15, z + 0.05]]
    content: dict[str, Any] = {
        "name": f"geared_{joints}",
        "duration_s": 8.0,
        "plant": {
            "type": "urdf_arm", "file": str(file), "motor": MOTOR,
            "initial_deg": {f"joint_{k + 1}": angle for k, angle in enumerate(start)},
        },
        "controller": {
            "type": "joint_pd",
            "hand": {
                "joints": ["joint_1", "joint_2", "joint_4" if joints == 7 else "joint_3"],
                "path": {"type": "waypoints", "times_s": [0.0, 4.0, 8.0], "points_m": [*ends, ends[0]]},
            },
        },
        "surfaces": {"bench": {"type": "box", "center_m": [0.45, 0.0, top - 0.1], "edges_m": [0.5, 1.2, 0.2]}},
        "contacts": {
            "law": "unilateral", "friction": 0.2,
            "points": {"pad": {"body": body, "point_m": point, "radius_m": 0.06, "surface": "bench"}},
        },
    }  # fmt: skip
    if payload_kg:
        body, point = f"link_{joints}", [0.0, 0.0, 0.1]
        content["loads"] = {"tool": {"type": "payload", "body": body, "point_m": point, "mass_kg": payload_kg}}
    return scenario_from_resolved(content)
