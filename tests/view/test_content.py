"""Data of viewer pages, without a browser: blocks of numbers, frames, meshes, HTML text, commands."""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import os
import re
import subprocess
import sys
import zipfile
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from support.meshed_robot import CORNERS, FACES, dae, meshed_robot, obj, stl, stl_text
from support.messages import raises, says

import dynsim
from dynsim import cli
from dynsim.draw.geometry.meshes import Meshes, simplified, welded
from dynsim.draw.geometry.robot import knots
from dynsim.draw.page import content, page, viewable, write
from dynsim.draw.page.content import Blocks, three
from dynsim.draw.page.content import packed_mesh as packed
from dynsim.errors import RecordError
from dynsim.record import Record, meshes
from dynsim.record.meshes import Mesh, read_mesh
from dynsim.record.poses import ORIENTATION, POSITION, add_body_poses
from dynsim.record.scene import SceneSurface
from dynsim.scenario import build_model, load_scenario, variant_names

pytestmark = pytest.mark.long

SHORT = {"duration_s": 0.5, "metrics.settle_s": 0.1}


@pytest.fixture(scope="module")
def braced() -> Record:
    return dynsim.simulate(load_scenario("elbow_comparison", "two_elbows", SHORT))


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return dynsim.simulate(load_scenario(meshed_robot(tmp_path_factory.mktemp("robot"))))


def unpacked(text: str) -> tuple[dict[str, Any], bytes]:
    content = gzip.decompress(base64.b64decode(text))
    size = int.from_bytes(content[:4], "little")
    return json.loads(content[4 : 4 + size]), content[4 + size :]


def data_of(text: str) -> tuple[dict[str, Any], bytes]:
    match = re.search(r'<script id="data"[^>]*>([^<]*)</script>', text)
    assert match is not None
    return unpacked(match[1])


def values(block: dict[str, Any], content: bytes) -> np.ndarray:
    """A second reader of blocks, beside that of the page."""
    rows, columns, size = block["rows"], block["columns"], block["bits"] // 8
    raw = np.frombuffer(content, np.uint8, rows * columns * size, block["at"]).reshape(size, columns, rows)
    steps = sum(raw[k].astype(np.uint64) << np.uint64(8 * k) for k in range(size))
    codes = np.cumsum(steps, axis=1, dtype=np.uint64) % np.uint64(2 ** block["bits"])
    known = np.array(block["offset"])[:, None] + np.array(block["scale"])[:, None] * codes.astype(float)
    return np.where(codes == 2 ** block["bits"] - 1, np.nan, known).T


@given(st.lists(st.lists(st.floats(-1e6, 1e6) | st.just(np.nan), min_size=3, max_size=3), min_size=1, max_size=30))
def test_blocks_come_back(rows: list[list[float]]) -> None:
    data = np.array(rows)
    blocks = Blocks()
    blocks.raw(np.arange(7))
    coarse, fine = blocks.add(data), blocks.add(data, 1e-6)
    _, content = unpacked(blocks.packed({}))
    spans = [np.ptp(column[np.isfinite(column)]) if np.isfinite(column).any() else 0.0 for column in data.T]
    for block, error in ((coarse, 0.51 * np.array(spans) / 65534 + 1e-9), (fine, np.full(3, 1e-3))):
        decoded = values(block, content)
        assert (np.isnan(decoded) == np.isnan(data)).all()
        assert (np.nan_to_num(np.abs(decoded - data)) <= error).all()
    assert np.nan_to_num(np.abs(values(fine, content) - data)).max() <= max(1e-6, 1e-9 * max(spans))


def test_frames_are_thinned_only_as_far_as_poses_allow(braced: Record) -> None:
    head, blocks = data_of(page({"one": braced}))
    (part,) = head["records"]
    times = values(part["frames"], blocks)[:, 0]
    assert times[[0, -1]] == pytest.approx(braced.time[[0, -1]])
    position, turn = values(part["position"], blocks), values(part["orientation"], blocks)
    truth = braced[POSITION].reshape(len(braced), -1)
    between = np.stack([np.interp(braced.time, times, column) for column in position.T], axis=1)
    assert np.abs(between - truth).max() <= 1.5 * content.POSE_ERROR  # and the rounding of the codes
    turns = np.stack([np.interp(braced.time, times, column) for column in turn.T], axis=1)
    assert np.abs(turns - braced[ORIENTATION].reshape(len(braced), -1)).max() <= 1e-4
    # A record that stands still needs two.
    still = Record(braced.time)
    still.add("q", np.repeat(braced["q"][:1], len(braced), axis=0), "rad", labels=braced.labels["q"])
    still.scene = braced.scene
    assert add_body_poses(still)
    assert data_of(page({"one": still}))[0]["records"][0]["frames"]["rows"] <= 5


@pytest.mark.parametrize("most", [None, 60])
def test_knots_reproduce_all_rows(most: int | None) -> None:
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.5, 1.5, 3000))
    data = np.stack(
        [20.0 * np.sin(time / 200.0), 5.0 * (time > 1500.0), np.cumsum(rng.normal(0.0, 0.05, 3000))], axis=1
    )
    data[100:105, 0] = np.nan
    rows = knots(time, data, most)
    assert rows[[0, -1]].tolist() == [0, 2999]
    assert len(rows) < (400 if most is None else most + 2)
    between = np.stack([np.interp(time, time[rows], column[rows]) for column in data.T], axis=1)
    if most is None:
        known = np.isfinite(between).all(axis=1)
        assert np.abs(between - data)[known].max() <= 1.0 + 1e-9
        assert known.sum() >= 2990
        # A step is between neighbouring samples.
        step = int(np.argmax(time > 1500.0))
        assert {step - 1, step} <= set(rows.tolist())


def test_page_of_18_dynamic_snakes_is_small() -> None:
    """Records that differ in all signals; three.js takes 0.63 MB."""
    record = dynsim.simulate(load_scenario("snake_positioning_dynamic", "x", {"duration_s": 4.0}))
    records: dict[str, Record] = {}
    for k in range(18):
        other = Record(record.time, provenance=record.provenance)
        for name, signal in record.signals.items():
            data = signal.data if name in (POSITION, ORIENTATION) else signal.data * (1.0 + 0.01 * k)
            axis = signal.axis
            other.add(
                name, data, signal.unit, labels=signal.labels, description=signal.description
            ) if axis == "time" else None
        other.scene = record.scene
        records[f"variant {k}"] = other
    assert len(page(records).encode()) < 5_000_000


def test_plane_through_the_robot_is_a_plate_at_its_contact_points(braced: Record) -> None:
    record = Record(braced.time, provenance=braced.provenance)
    for name in (POSITION, ORIENTATION):
        record.add(name, braced[name], braced.units[name], labels=braced.labels[name])
    assert braced.scene is not None
    elbow = braced.scene.contacts[0]
    x = float(braced[POSITION][0, elbow.body, 0])
    sizes = []
    for normal in ([0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]):
        plane = SceneSurface.of_quadric(elbow.surface, np.zeros((3, 3)), normal, -x * normal[0])
        record.scene = replace(braced.scene, surfaces=(plane,))
        (part,) = data_of(page({"one": record}))[0]["records"]
        sizes.append(max(part["surfaces"][0]["size"]))
    reach = np.ptp(braced[POSITION][0, :, 0])
    assert sizes[0] > reach
    assert 0.05 * reach < sizes[1] < 0.4 * reach


def test_signals_have_names_and_units(braced: Record) -> None:
    """Lengths below 0.1 m are in millimetres, in all records of a page or in none."""
    head, blocks = data_of(page({"one": braced}))
    signals = {signal["name"]: signal for signal in head["records"][0]["signals"]}
    assert not any("_" in signal["words"] for signal in signals.values())
    assert signals["contact_normal_force"]["words"] == "normal force of contacts"
    assert signals["contact_gap"]["unit"] == "mm"
    gap = values(signals["contact_gap"]["data"], blocks)
    np.testing.assert_allclose(gap, 1e3 * braced["contact_gap"], atol=1e-3)
    assert signals["hand_position"]["unit"] == "m"
    far = Record(braced.time)
    for name in (POSITION, ORIENTATION, "contact_gap"):
        far.add(
            name, braced[name] + (0.5 if name == "contact_gap" else 0.0), braced.units[name], labels=braced.labels[name]
        )
    far.scene = braced.scene
    head, _ = data_of(page({"one": braced, "far": far}))
    units = [{s["name"]: s["unit"] for s in record["signals"]}["contact_gap"] for record in head["records"]]
    assert units == ["m", "m"]


def test_long_signals_keep_their_extremes() -> None:
    time = np.linspace(0.0, 100.0, 50_001)
    data = np.stack([np.sin(time), np.zeros_like(time)], axis=1)
    data[12_345, 1], data[33_333, 1] = 7.0, -5.0
    at, kept = content._thinned(time, data)
    assert len(at) == len(kept) <= content.PLOTTED + 1
    assert (np.diff(at) > 0.0).all()
    assert kept[:, 1].max() == 7.0
    assert kept[:, 1].min() == -5.0
    assert abs(at[kept[:, 1].argmax()] - time[12_345]) < 100.0 / content.PLOTTED * 2


@pytest.mark.parametrize(
    ("name", "text"), [("a.stl", stl()), ("b.STL", stl_text()), ("c.obj", obj()), ("d.dae", dae())]
)
def test_mesh_files(name: str, text: bytes | str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    corners, triangles, _ = read_mesh(tmp_path / name)
    wanted = {tuple(map(tuple, np.round(CORNERS[face], 6))) for face in FACES}
    faces = {tuple(map(tuple, np.round(corners[face], 6) + 0.0)) for face in triangles}
    assert faces == wanted


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.stl", "solid nothing"),
        ("a.stl", "vertex 1 2 x"),
        ("a.obj", "v 0 0 0\nf 1 2 3"),
        ("a.obj", "f 1 2"),
        ("a.obj", "v 0 0 0\nv 1\nv 1 0 0\nv 0 1 0\nf 1 2 3"),
        ("a.dae", "<COLLADA"),
        ("a.dae", '<!DOCTYPE a [<!ENTITY b "c">]><COLLADA/>'),
        ("a.dae", "<COLLADA/>"),
        ("a.wrl", "#VRML"),
    ],
)
def test_broken_meshes_are_refused(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with raises(RecordError, name):
        read_mesh(tmp_path / name)


# Copies of the wedge by nodes that instantiate the previous one ten times: 10^8 in 3.7 kB.
COPIES = "".join(f'<node id="k{k}">' + f'<instance_node url="#k{k - 1}"/>' * 10 + "</node>" for k in range(1, 9))
LIBRARY = f'<library_nodes><node id="k0"><instance_geometry url="#g"/></node>{COPIES}</library_nodes>'
LOOP = '<library_nodes><node id="k8"><instance_node url="#k8"/></node></library_nodes>'
ENTITIES = '<!DOCTYPE COLLADA [<!ENTITY a "lol"><!ENTITY b "&a;&a;">]>'
BODY = dae().partition("?>")[2]


def with_nodes(library: str) -> str:
    """The wedge, and a second instance of it by the node k8 of a library."""
    scenes, end = "<library_visual_scenes>", "</visual_scene>"
    return dae().replace(scenes, library + scenes).replace(end, f'<node><instance_node url="#k8"/></node>{end}')


def zipped() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("wedge.dae", dae() + " " * 1_000_000)
    return stream.getvalue()


HOSTILE = {
    "copies.dae": (with_nodes(LIBRARY), "4e+08 triangles"),
    "empty.dae": (with_nodes(LIBRARY.replace('<instance_geometry url="#g"/>', "")), "nodes"),
    "loop.dae": (with_nodes(LOOP), "k8 itself"),
    "zip.dae": (zipped(), "zip"),
    "bomb.dae": (f'<?xml version="1.0" encoding="utf-16"?>{ENTITIES}{BODY}'.encode("utf-16"), "XML entities"),
    "code.dae": (f'<?xml version="1.0" encoding="utf-7"?>{BODY}', "utf-7"),
    "deep.dae": (dae().replace("<node>", "<node>" * 20_000, 1), "nested"),
    "large.stl": (bytes(80) + (2_100_000).to_bytes(4, "little") + bytes(50 * 2_100_000), "MB"),
    "many.obj": ("v 0 0 0\nf" + " 1" * 2_100_000, "triangles"),
}
READ = """
import resource, sys
from pathlib import Path
from dynsim.record import meshes
from dynsim.record.meshes import read_mesh
from dynsim.errors import RecordError
resource.setrlimit(resource.RLIMIT_CPU, (8, 9))
resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
try:
    read_mesh(Path(sys.argv[1]))
except RecordError as error:
    print(error)
"""


@pytest.mark.parametrize("name", HOSTILE)
def test_every_command_warns_of_a_hostile_mesh(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text, names = HOSTILE[name]
    file = meshed_robot(tmp_path)
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    command = [sys.executable, "-c", READ, str(tmp_path / name)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.count("\n") == 1
    for word in (str(tmp_path / name), *names.split()):
        assert word in done.stdout
    robot = next(tmp_path.glob("*.urdf"))
    robot.write_text(re.sub(r'(<mesh filename=")[^"]*', rf"\g<1>{name}", robot.read_text()))
    folder = tmp_path / "run"
    for words in (
        ("check", file),
        ("run", file, "--quiet", "--out", folder, "--set", "duration_s=0.02"),
        ("view", folder, "--no-open"),
        ("animate", folder, "--out", tmp_path / "a.gif", "--fps", "5", "--quiet"),
    ):
        assert run(monkeypatch, *words) == 0
        assert "".join(done.stdout.split()) in "".join(capsys.readouterr().err.split())
    notes = data_of((folder / "view.html").read_text())[0]["notes"]
    assert any(note.startswith(done.stdout.strip()) for note in notes)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1", "us-ascii"])
def test_encodings_of_collada_files(encoding: str, tmp_path: Path) -> None:
    text = f'<?xml version="1.0" encoding="{encoding.removesuffix("-sig")}"?>{BODY}'
    (tmp_path / "a.dae").write_bytes(text.encode(encoding))
    assert len(read_mesh(tmp_path / "a.dae").triangles) == len(FACES)


def test_copies_of_a_mesh_within_the_budget_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of triangles in the scan equals the number in the mesh."""
    (tmp_path / "a.dae").write_text(with_nodes(LIBRARY).replace("#k8", "#k2"))
    count = len(read_mesh(tmp_path / "a.dae").triangles)
    assert count == 101 * len(FACES)
    monkeypatch.setattr(meshes, "TRIANGLES_MAX", count)
    read_mesh(tmp_path / "a.dae")
    monkeypatch.setattr(meshes, "TRIANGLES_MAX", count - 1)
    with raises(RecordError, "a.dae", f"{count} triangles"):
        read_mesh(tmp_path / "a.dae")


def painted(text: str) -> str:
    """The wedge in COLLADA with a red effect on its first two triangles, through a symbol of the instance."""
    first, remainder = '<polylist count="4">', "<vcount>3 3 3 3</vcount>"
    index = re.search(r"<p>([^<]*)</p>", text)
    assert index is not None
    words = index[1].split()
    inputs = re.search(r"<polylist[^>]*>(.*?)<vcount>", text, re.DOTALL)
    assert inputs is not None
    halves = "".join(
        f'<polylist count="2" material="{symbol}">{inputs[1]}<vcount>3 3</vcount><p>{" ".join(part)}</p></polylist>'
        for symbol, part in (("coat", words[:12]), ("bare", words[12:]))
    )
    assert first in text
    assert remainder in text
    text = re.sub(r"<polylist.*</polylist>", halves, text, flags=re.DOTALL)
    library = (
        '<library_effects><effect id="e"><profile_COMMON><technique sid="c"><phong><diffuse>'
        "<color>0.8 0.1 0.2 1</color></diffuse></phong></technique></profile_COMMON></effect></library_effects>"
        '<library_materials><material id="red"><instance_effect url="#e"/></material></library_materials>'
    )
    bind = (
        '<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="coat" target="#red"/>'
        "</technique_common></bind_material></instance_geometry>"
    )
    return text.replace("<library_geometries>", f"{library}<library_geometries>").replace(
        '<instance_geometry url="#g"/>', bind
    )


def test_colours_of_collada_files(tmp_path: Path) -> None:
    (tmp_path / "a.dae").write_text(painted(dae()))
    mesh = read_mesh(tmp_path / "a.dae")
    wanted = {tuple(map(tuple, np.round(CORNERS[face], 6))) for face in FACES[:2]}
    assert mesh.colours is not None
    red = np.isfinite(mesh.colours).all(axis=1)
    np.testing.assert_allclose(mesh.colours[red], [[0.8, 0.1, 0.2]] * 2)
    assert {tuple(map(tuple, np.round(mesh.corners[face], 6) + 0.0)) for face in mesh.triangles[red]} == wanted
    # Simplified and packed they keep them.
    (few,) = simplified([welded(mesh)])
    assert few.colours is not None
    assert np.isfinite(few.colours).all(axis=1).sum() == 2
    blocks = Blocks()
    head = packed(mesh, blocks)
    assert sorted(map(str, head["palette"])) == ["None", "[0.8, 0.1, 0.2]"]
    for broken in ("red", "0.8 0.1", "nan 0 0", ""):
        (tmp_path / "c.dae").write_text(painted(dae()).replace("0.8 0.1 0.2 1", broken))
        assert read_mesh(tmp_path / "c.dae").colours is None
    (tmp_path / "b.dae").write_text(dae())
    assert read_mesh(tmp_path / "b.dae").colours is None
    assert "palette" not in packed(read_mesh(tmp_path / "b.dae"), blocks)


def test_colours_of_a_published_robot() -> None:
    """The foot of Franka's Panda is of light and dark parts."""
    places = [
        Path(str(file.locate())) for file in metadata.files("example-robot-data") or () if file.name == "link0.dae"
    ]
    mesh = read_mesh(next(path for path in places if "panda_description" in path.parts))
    assert mesh.colours is not None
    assert np.isfinite(mesh.colours).all()
    colours = {tuple(row) for row in np.round(mesh.colours, 3)}
    assert {(0.902, 0.922, 0.929), (0.251, 0.251, 0.251)} <= colours


def ball() -> Mesh:
    """A closed ball of 88 800 triangles, every one with corners of its own as in STL, and 600 that are lines."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 301)[:-1], np.linspace(0, np.pi, 150))
    corners = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    i = np.arange(149 * 300)
    right = i - i % 300 + (i + 1) % 300
    triangles = np.concatenate([np.stack([i, i + 300, right], 1), np.stack([right, i + 300, right + 300], 1)])
    return Mesh(corners[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3))


def edges(mesh: Mesh) -> tuple[int, int]:
    """How many edges of a mesh have one triangle, and how many more than two."""
    a, b, c = mesh.triangles.T
    _, count = np.unique(
        np.sort(np.concatenate([[a, b], [b, c], [c, a]], axis=1).T, axis=1), axis=0, return_counts=True
    )
    return int((count == 1).sum()), int((count > 2).sum())


def test_meshes_are_merged_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    (few,) = simplified([welded(ball())], 3000)
    assert 500 < len(few.triangles) < 4500
    # All corners remain on the ball.
    assert np.linalg.norm(few.corners, axis=1) == pytest.approx(1.0, rel=1e-9)


def test_meshes_are_simplified_together() -> None:
    """The largest come down, to solids of the same size without a hole; small ones stay as they are."""
    large, small = welded(ball()), welded(Mesh(CORNERS, FACES))
    assert [len(mesh.triangles) for mesh in simplified([large, small], 100_000)] == [88_800, 4]
    few, same = simplified([large, small], 3000)
    assert same is small
    assert 2000 < len(few.triangles) <= 2996
    assert edges(few) == edges(large) == (0, 0)
    volume = [np.linalg.det(mesh.corners[mesh.triangles]).sum() / 6.0 for mesh in (few, large)]
    assert volume[0] == pytest.approx(volume[1], rel=5e-3)


@pytest.mark.parametrize("file", ["panda_description/meshes/visual/link5.dae", "ur5/visual/shoulder.dae"])
def test_simplified_links_of_published_robots_are_not_torn(file: str) -> None:
    """To a seventh: nowhere further from what they were than a hundredth of their size, and with no new open edge."""
    places = [
        Path(str(path.locate())) for path in metadata.files("example-robot-data") or () if str(path).endswith(file)
    ]
    whole = welded(read_mesh(places[0]))
    (few,) = simplified([whole], len(whole.triangles) // 7)
    assert len(few.triangles) < len(whole.triangles) / 4.5
    assert edges(few)[0] <= edges(whole)[0]
    size = np.ptp(whole.corners, axis=0).max()
    for first, other in ((whole, few), (few, whole)):
        distance, _ = cKDTree(sampled(other)).query(first.corners)
        assert distance.max() < 0.01 * size
    assert whole.colours is not None
    assert few.colours is not None
    assert set(map(tuple, few.colours)) == set(map(tuple, whole.colours))


@pytest.mark.parametrize("part", ["panda_description/meshes/visual/", "ur_description/meshes/ur5/visual/"])
def test_a_published_robot_is_a_page_of_less_than_two_megabytes(part: str) -> None:
    files = [path for path in metadata.files("example-robot-data") or () if part in str(path) and path.suffix == ".dae"]
    meshes = [welded(read_mesh(Path(str(path.locate())))) for path in files]
    assert len(meshes) >= 7
    few = simplified(meshes)
    triangles = [sum(len(mesh.triangles) for mesh in some) for some in (meshes, few)]
    assert min(triangles[0], 95_000) <= triangles[1] <= 110_000
    blocks = Blocks()
    head = {"meshes": [packed(mesh, blocks) for mesh in few]}
    # Three.js and the program take 0.75 MB.
    assert len(blocks.packed(head)) < 1_200_000


def sampled(mesh: Mesh) -> np.ndarray:
    """Points on a mesh, some hundred thousand, where its area is."""
    corners = mesh.corners[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(1)
    rows = rng.choice(len(area), 200_000, p=area / area.sum())
    share = rng.dirichlet(np.ones(3), len(rows))
    return np.concatenate([np.einsum("nk,nkx->nx", share, corners[rows]), mesh.corners])


def test_meshes_are_found_where_the_robot_is(robot: Record) -> None:
    head, _ = data_of(page({"one": robot}))
    (part,) = head["records"]
    kinds = [[shape["kind"] for shape in body["shapes"]] for body in part["bodies"]]
    assert kinds[:3] == [["mesh"]] * 3
    assert len(head["meshes"]) == 3
    assert "no.stl" in head["notes"][0]
    # No path of this machine is in a page.
    assert os.sep + "wedges" not in json.dumps(head)


def test_a_mesh_is_packed_once(robot: Record) -> None:
    meshes = Meshes()
    meshes.of_robot(robot.scene)
    file = "package://wedges/meshes/wedge.stl"
    assert meshes.index(file) == meshes.index(file) == 0
    assert len(meshes.unique) == 1


def test_the_page_is_one_file_without_a_network(braced: Record, tmp_path: Path) -> None:
    text = page({"one": braced})
    assert "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:" in text
    assert "connect-src" not in text
    own_text = text.replace(three().replace("</script", "<\\/script"), "")
    assert len(own_text) < len(text)
    assert not re.search(r"https?://|\bsrc=|href=\"|@import|url\(", own_text)
    # Each script that begins ends, and none earlier than meant.
    assert len(re.findall(r"<script", text)) == len(re.findall(r"</script>", text)) == 3
    assert page({"one": braced}) == text
    assert write({"one": braced}, tmp_path / "p.html").read_text(encoding="utf-8") == text
    assert "SPDX-License-Identifier: MIT" in text


def test_an_arm_of_ten_seconds_is_small() -> None:
    record = dynsim.simulate(load_scenario("elbow_comparison", "two_elbows", {"integrator.rtol": 1e-4}))
    assert len(record) == 2001
    assert len(page({"one": record}).encode()) < 2_000_000


def test_what_has_nothing_to_be_seen(braced: Record) -> None:
    bare = Record(braced.time)
    bare.add("q", braced["q"], "rad", labels=braced.labels["q"])
    assert not viewable(bare)
    with raises(RecordError):
        page({"bare": bare})
    assert [part["name"] for part in data_of(page({"bare": bare, "one": braced}))[0]["records"]] == ["one"]


def test_a_run_that_diverged_is_shown_as_far_as_it_came(braced: Record) -> None:
    record = Record(braced.time, provenance=braced.provenance)
    for name in ("q", POSITION, ORIENTATION, "contact_normal_force", "contact_force"):
        data = braced[name].astype(float)
        data[-3:] = np.nan
        record.add(name, data, braced.units[name], labels=braced.labels[name])
    record.scene = braced.scene
    head, blocks = data_of(page({"one": record}))
    (part,) = head["records"]
    assert np.isnan(values(part["position"], blocks)[-1]).all()
    assert np.isfinite(np.array(head["box"])).all()


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr("sys.argv", ["dynsim", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    code = stop.value.code
    assert isinstance(code, int)
    return code


def test_commands_write_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``run`` and ``compare`` write a page unless told not to, and none opens a browser by itself."""
    opened: list[str] = []
    monkeypatch.setenv("DISPLAY", ":7")
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    short = ("--set", "duration_s=0.2", "--set", "metrics.settle_s=0.1")
    assert run(monkeypatch, "run", "single_pendulum", *short, "--out", tmp_path / "run") == 0
    path = tmp_path / "run" / "view.html"
    assert data_of(path.read_text(encoding="utf-8"))[0]["records"][0]["name"] == "single_pendulum"
    assert "view.html" in capsys.readouterr().out
    # A later run without figures leaves no page of the earlier record.
    assert run(monkeypatch, "run", "single_pendulum", *short, "--no-figures", "--out", tmp_path / "run") == 0
    assert not path.exists()
    assert opened == []
    assert run(monkeypatch, "run", "single_pendulum", *short, "--view", "--no-figures", "--out", tmp_path / "run") == 0
    assert opened == [path.as_uri()]
    assert run(monkeypatch, "compare", "elbow_comparison", *short, "-q", "--out", tmp_path / "all") == 0
    head, _ = data_of((tmp_path / "all" / "view.html").read_text(encoding="utf-8"))
    assert [part["name"] for part in head["records"]] == variant_names("elbow_comparison")
    records = [tmp_path / "all" / name / "record.h5" for name in ("elbow_4", "elbow_7")]
    assert run(monkeypatch, "view", *records, "--ghost", "--out", tmp_path / "two.html", "--no-open") == 0
    head, _ = data_of((tmp_path / "two.html").read_text(encoding="utf-8"))
    assert head["ghost"]
    assert len(opened) == 1
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("BROWSER", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if os.name == "posix" and os.uname().sysname == "Linux":
        assert run(monkeypatch, "view", records[0], "--out", tmp_path / "one.html") == 0
        assert len(opened) == 1
        assert says(capsys.readouterr().out, "no browser")
    assert run(monkeypatch, "view", tmp_path / "none.h5", "--no-open") != 0


def test_notebooks(braced: Record, tmp_path: Path) -> None:
    shown = dynsim.view.show(braced, braced, ghost=True, height=400)
    frame = shown._repr_html_()
    match = re.search(r'srcdoc="([^"]*)"', frame)
    assert match is not None
    assert html.unescape(match[1]) == shown.page
    assert 'sandbox="allow-scripts allow-downloads"' in frame
    assert "height:400px" in frame
    assert [part["name"] for part in data_of(shown.page)[0]["records"]] == ["two_elbows", "two_elbows 2"]
    assert shown.save(tmp_path / "p.html").read_text(encoding="utf-8") == shown.page
    scenario = load_scenario("elbow_comparison", "two_elbows")
    assert "serial_arm" in scenario._repr_html_()
    assert "joint_10" in build_model(scenario)._repr_html_()
    evil = Record(braced.time, provenance={"scenario": {"name": "<script>"}})
    assert "<script>" not in evil._repr_html_()
    assert "contact_gap" in braced._repr_html_()
