"""A URDF robot with a mesh of each file kind, and with one missing file."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

# A wedge: corners [m] and outward triangles.
CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.3]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])

SCENARIO = """\
duration_s: 0.5
plant:
  type: urdf_arm
  file: robot.urdf
  motor:
    {type: dc, torque_constant_N_m_per_A: 0.1, resistance_ohm: 0.5, inductance_H: 0.0005, rotor_inertia_kg_m2: 5.0e-5,
     gear_ratio: 100, gear_damping_N_m_s_per_rad: 1.0e-4, voltage_limit_V: 48}
  initial_deg: {j1: 30, j2: 40}
controller: {type: joint_pd, k_p_V_per_rad: 2000, k_d_V_s_per_rad: 20}
"""


def meshed_robot(folder: Path) -> Path:
    """Write the files of a robot of four links to a folder; return the scenario."""
    meshes = folder / "wedges" / "meshes"
    meshes.mkdir(parents=True)
    (meshes / "wedge.stl").write_bytes(stl())
    (meshes / "wedge.obj").write_text(obj())
    (meshes / "wedge.dae").write_text(dae())
    files = (
        "package://wedges/meshes/wedge.stl",
        "wedges/meshes/wedge.obj",
        "package://wedges/meshes/wedge.dae",
        "no.stl",
    )
    links = "".join(
        f'<link name="l{k}"><inertial><mass value="0.5"/><origin xyz="0 0 0.1"/>'
        '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
        f'<visual><geometry><mesh filename="{file}" scale="1 1 0.5"/></geometry></visual></link>'
        for k, file in enumerate(files)
    )
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="{"base" if k == 0 else f"l{k - 1}"}"/><child link="l{k}"/>'
        f'<origin xyz="0 0 {0.1 if k == 0 else 0.3}"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="100" velocity="10"/></joint>'
        for k in range(len(files))
    )
    (folder / "robot.urdf").write_text(f'<robot name="wedges"><link name="base"/>{links}{joints}</robot>')
    scenario = folder / "wedges.yaml"
    scenario.write_text(SCENARIO)
    return scenario


def stl() -> bytes:
    """Return the wedge in binary STL."""
    faces = b"".join(struct.pack("<12fH", 0, 0, 0, *CORNERS[face].ravel(), 0) for face in FACES)
    return bytes(80) + struct.pack("<I", len(FACES)) + faces


def stl_text() -> str:
    """Return the wedge in ASCII STL."""
    loops = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:g} {y:g} {z:g}\n" for x, y, z in CORNERS[face])
        + "endloop\nendfacet\n"
        for face in FACES
    )
    return f"solid wedge\n{loops}endsolid wedge\n"


def obj() -> str:
    """Return the wedge as OBJ, with indices from either end."""
    corners = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in CORNERS)
    first, *others = FACES
    faces = "f " + " ".join(f"{k - len(CORNERS)}" for k in first) + "\n"
    return corners + faces + "".join("f " + " ".join(f"{k + 1}/1/1" for k in face) + "\n" for face in others)


def dae() -> str:
    """Return the wedge as COLLADA: in centimetres, rotated and translated by its node, with normals between indices."""
    numbers = " ".join(f"{x:g}" for x in (100.0 * (CORNERS @ np.diag([-1.0, -1.0, 1.0]) - [0.0, 0.0, 0.05])).ravel())
    index = " ".join(f"{k} 0" for face in FACES for k in face)
    parts = "".join(f'<param name="{name}" type="float"/>' for name in "XYZ")
    accessor = (
        '<technique_common><accessor source="#{}" count="{}" stride="3">' + parts + "</accessor></technique_common>"
    )
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="12">{numbers}</float_array>{accessor.format("pa", 4)}</source>
<source id="n"><float_array id="na" count="3">0 0 1</float_array>{accessor.format("na", 1)}</source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="4"><input semantic="VERTEX" source="#v" offset="0"/><input semantic="NORMAL" source="#n" offset="1"/>
<vcount>3 3 3 3</vcount><p>{index}</p></polylist>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><translate>0 0 5</translate><node><rotate>0 0 1 180</rotate>
<instance_geometry url="#g"/></node></node></visual_scene></library_visual_scenes>
</COLLADA>
"""
