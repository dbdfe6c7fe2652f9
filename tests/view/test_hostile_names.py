"""Hostile names of joints, bodies, points, scenarios and variants: refused when read, or harmless in every output."""

from __future__ import annotations

import csv
import io
import json
import sys
import unicodedata
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import pytest
import yaml
from PIL import Image

from dynsim import cli, load_scenario
from dynsim.errors import DynsimError
from dynsim.record import Record
from dynsim.scenario import build_model
from dynsim.system.terminal import plain

from .conftest import Opened

NAMES = {
    "quotes": "a\"b'c`d",
    "equals": '=HYPERLINK("http://evil.example","x")',
    "end of script": "</script><script>alert(1)</script><img src=x onerror=alert(2)>",
    "html": "<!--<script>alert(3)//--> &lt;b&gt; ]]>",
    "newline": "a\nb",
    "tab and comma": "a,b\t;c",
    "up": "../../evil",
    "absolute": "/tmp/evil",
    "terminal": "\x1b[31mred\x1b]0;title\x07",
    "right to left": "a\u202egnp\u2066.exe",
    "line separator": "a\u2028b",
    "long": "x" * 3000,
    "zero": "a\0b",
    "surrogate": "a\ud800b",
    "template": "${alert(4)}{{7*7}}%s%n{0}",
    "markup": "[red]x[/red][/]",
    "formula": r"$\frac{$ a_b^c \n",
    "yaml": "- a: [b, {c: &d *e #f",
    "number": "1e5",
    "word": "null",
    "spaces": " a  b ",
    "dots": "..",
}
SOME = ("equals", "end of script", "newline", "terminal", "right to left", "formula")
"""Names of the long tests; the slow tests have all."""
ROLES = ("robot", "body", "joint", "point", "surface", "scenario", "variant")


@dataclass
class Scene:
    """A small arm with a brace; some of its names are hostile.

    Attributes
    ----------
    names : name for each role
    """

    names: dict[str, str] = field(default_factory=lambda: {role: f"usual_{role}" for role in ROLES})

    def write(self, folder: Path) -> Path:
        """Write the files of the scene; return the scenario."""
        robot, body, joint = (quoteattr(self.names[name], {"\n": "&#10;", "\t": "&#9;"}) for name in ROLES[:3])
        inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
        inertial = f'<inertial><mass value="0.5"/><origin xyz="0 0 0.1"/>{inertia}</inertial>'
        visual = '<visual><geometry><cylinder radius="0.02" length="0.2"/></geometry></visual>'
        limit = '<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="100" velocity="10"/>'
        urdf = (
            f'<robot name={robot}><link name="base"/><link name={body}>{inertial}{visual}</link>'
            f'<link name="tip">{inertial}{visual}</link>'
            f'<joint name={joint} type="revolute"><parent link="base"/><child link={body}/>'
            f'<origin xyz="0 0 0.3"/>{limit}</joint>'
            f'<joint name="second" type="revolute"><parent link={body}/><child link="tip"/>'
            f'<origin xyz="0 0 0.3"/>{limit}</joint></robot>'
        )
        (folder / "robot.urdf").write_bytes(urdf.encode("utf-8", "surrogatepass"))
        motor = {"type": "dc", "torque_constant_N_m_per_A": 0.1, "resistance_ohm": 0.5, "inductance_H": 5e-4}
        motor |= {"rotor_inertia_kg_m2": 5e-5, "gear_ratio": 100}
        surface, point = self.names["surface"], self.names["point"]
        scenario = {
            "name": self.names["scenario"],
            "duration_s": 0.1,
            "plant": {"type": "urdf_arm", "file": "robot.urdf", "motor": motor},
            "controller": {"type": "joint_pd", "k_p_V_per_rad": 200, "k_d_V_s_per_rad": 10},
            "surfaces": {surface: {"type": "plane", "point_m": [0, 0, -0.5], "normal": [0, 0, 1]}},
            "contacts": {"law": "unilateral", "points": {point: {"body": "tip", "surface": surface}}},
            "variants": {self.names["variant"]: {}},
        }
        path = folder / "scene.yaml"
        path.write_text(json.dumps(scenario), encoding="utf-8")
        return path


def call(*arguments: object) -> tuple[int, str, str]:
    """Run a command in this process; return its exit code and what it printed, which must not command a terminal."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["dynsim", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            cli.main()
    printed = out.getvalue() + err.getvalue()
    unfit = {sign for sign in printed if sign != "\n" and unicodedata.category(sign) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    assert not unfit, printed
    return int(leaving.value.code or 0), out.getvalue(), err.getvalue()


def accepted(name: str, folder: Path) -> Scene:
    """Return the scene with this name in all roles that accept it; the other roles refuse it with one error."""
    scene = Scene()
    for role in ROLES:
        single = Scene()
        single.names[role] = name
        refusal = ""
        try:
            build_model(load_scenario(single.write(folder)))
        except DynsimError as error:
            refusal = plain(error)
        assert len(refusal.splitlines()) <= 1
        assert len(refusal) < 1000
        if not refusal:
            scene.names[role] = f"{name}." if role == "joint" else name
    return scene


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=pytest.mark.long if name in SOME else pytest.mark.slow) for name in NAMES],
)
def ran(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Path]:
    """The scene of each name, in a folder with its run and nothing outside."""
    root = tmp_path_factory.mktemp("hostile")
    (folder := root / "a" / "b" / "c").mkdir(parents=True)
    scene = accepted(NAMES[request.param], folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        code, _, err = call("run", scene.write(folder), "--out", "out")
    assert code == 0, err
    assert [path.name for path in root.iterdir()] == ["a"]
    return scene, folder


def test_every_export_is_well_formed(ran: tuple[Scene, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    scene, folder = ran
    monkeypatch.chdir(folder)
    record = Record.load(folder / "out" / "record.h5")
    joints = [scene.names["joint"], "second"]
    assert list(record.labels["q"]) == joints
    for kind in ("csv", "joint-trajectory", "urdf-log", "mcap"):
        code, _, err = call("export", "out/record.h5", "--format", kind)
        assert code == 0, err
    before = set(folder.iterdir())
    for kind in ("urdf", "mjcf"):
        code, _, err = call("export", "scene.yaml", "--format", kind)
        assert code == 0, err
    written = {path.suffix: path for path in set(folder.iterdir()) - before}
    urdf, mjcf = written[".urdf"], written[".xml"]
    check_csv(folder / "out" / "record.csv", record)
    check_trajectory(folder / "out", joints)
    check_log(folder / "out", joints)
    check_mcap(folder / "out" / "record.mcap", scene, record)
    check_urdf(urdf, scene)
    check_mjcf(mjcf, scene)
    assert {path.name for path in folder.parent.iterdir()} == {"c"}
    assert {path.name for path in folder.parents[1].iterdir()} == {"b"}


def check_csv(path: Path, record: Record) -> None:
    with path.open(newline="", encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    assert {len(row) for row in rows} == {len(head)}
    assert len(rows) == len(record)
    assert not [cell for cell in head if cell.startswith(("=", "+", "-", "@", "\t", "\r"))]
    assert len(set(head)) == len(head)


def check_trajectory(folder: Path, joints: list[str]) -> None:
    (path,) = folder.glob("record*.yaml")
    tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert tree["joint_names"] == joints
    assert {len(point["positions"]) for point in tree["points"]} == {2}


def check_log(folder: Path, joints: list[str]) -> None:
    (path,) = folder.glob("record*.jsonl")
    for line in path.read_text(encoding="utf-8").split("\n")[:-1]:
        assert list(json.loads(line)["position"]) == joints


def check_mcap(path: Path, scene: Scene, record: Record) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    topics: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, content in reader.iter_decoded_messages():
            topics.setdefault(channel.topic, []).append(content)
    assert len(topics["/joint_states"]) == len(record)
    assert tuple(topics["/joint_states"][0].name) == record.labels["q"]
    assert {topic.count("/") for topic in topics if topic.startswith("/contacts/")} <= {2}
    description = ElementTree.fromstring(topics["/robot_description"][0].data)
    assert {scene.names["body"], "tip"} <= {link.get("name") for link in description.iter("link")}


def check_urdf(path: Path, scene: Scene) -> None:
    tree = ElementTree.parse(path).getroot()
    assert {scene.names["body"], "tip"} <= {link.get("name") for link in tree.findall("link")}
    assert [joint.get("name") for joint in tree.findall("joint") if joint.get("type") == "revolute"] == [
        scene.names["joint"],
        "second",
    ]


def check_mjcf(path: Path, scene: Scene) -> None:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(path))
    assert [model.joint(k).name for k in range(model.njnt)] == [scene.names["joint"], "second"]
    assert {scene.names["body"], "tip"} <= {model.body(k).name for k in range(model.nbody)}


def test_no_script_runs_in_the_page(ran: tuple[Scene, Path], opened: Callable[..., Opened]) -> None:
    """The fixture finds dialogs, errors and requests of the page."""
    scene, folder = ran
    page = opened(folder / "out" / "view.html")
    assert page.page.locator("img").count() == 0
    assert page.js("document.scripts.length") == 3
    assert {scene.names["body"], "tip"} <= set(page.seek(0.05)["records"][0]["bodies"])


def test_films_and_figures_have_the_names(ran: tuple[Scene, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    _, folder = ran
    monkeypatch.chdir(folder)
    small = ("--size", "320x240", "--fps", "10", "--hold", "0", "--quiet")
    code, _, err = call("animate", "out/record.h5", "--out", "film.gif", *small)
    assert code == 0, err
    for picture in (Path("film.gif"), *Path("out").rglob("*.png")):
        with Image.open(picture) as image:
            image.load()
