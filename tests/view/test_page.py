"""Viewer pages in a real browser: poses, forces, wheels and plots equal the record; controls work."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.meshed_robot import meshed_robot
from support.messages import mentions, says

import dynsim
from dynsim.record import Record
from dynsim.record.poses import ORIENTATION, POSITION, add_body_poses
from dynsim.record.scene import HERE, Body, Joint, Scene, Shape
from dynsim.scenario import build_model, load_scenario

pytestmark = pytest.mark.long

Opens = Callable[..., Any]
NEAR = 1e-4


def short(name: str, variant: str | None = None, **options: Any) -> Record:
    return dynsim.simulate(load_scenario(name, variant, {"duration_s": 1.0, **options}))


@pytest.fixture(scope="module")
def braced() -> Record:
    return short("elbow_comparison", "two_elbows", duration_s=2.0)


@pytest.fixture(scope="module")
def snake() -> Record:
    return short("snake_circle", duration_s=2.0)


@pytest.fixture(scope="module")
def mobile() -> Record:
    return short("mobile_path")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return dynsim.simulate(load_scenario(meshed_robot(tmp_path_factory.mktemp("robot"))))


@pytest.mark.parametrize("kind", ["braced", "mobile", "snake", "robot"])
def test_bodies_are_where_the_record_has_them(kind: str, request: pytest.FixtureRequest, opened: Opens) -> None:
    record: Record = request.getfixturevalue(kind)
    page = opened({"one": record})
    rows = np.random.default_rng(1).integers(0, len(record), 12)
    for row in [0, len(record) - 1, *rows]:
        state = page.seek(float(record.time[row]))
        (shown,) = state["records"]
        assert state["time"] == pytest.approx(record.time[row], abs=1e-9)
        assert list(shown["bodies"]) == list(record.labels[POSITION])
        positions = np.array([body["p"] for body in shown["bodies"].values()])
        turn = np.array([body["q"] for body in shown["bodies"].values()])
        np.testing.assert_allclose(positions, record[POSITION][row], atol=NEAR)
        np.testing.assert_allclose(np.abs((turn * record[ORIENTATION][row]).sum(axis=1)), 1.0, atol=1e-8)
        # That of the kernels, not of the scene.
        hand = record["w"][row, :3] if kind == "snake" else record["hand_position"][row]
        np.testing.assert_allclose(shown["hand"], hand, atol=NEAR)


ROLLING = """
duration_s: 0.5
plant:
  type: serial_arm
  base: {position_m: [0, 0, 1]}
  chain: [{axis: y, length_m: 0.3, mass_kg: 0.1, initial_deg: 30}]
objects: {ball: {mass_kg: 1, shape: sphere, radius_m: 0.2, position_m: [-0.12, 0, 0.16]}}
surfaces: {ramp: {type: plane, normal: [-0.6, 0, 0.8]}}
contacts: {law: unilateral, friction: 0.8}
"""


def test_a_ball_is_pushed_where_it_touches(opened: Opens, tmp_path: Path) -> None:
    """The arrow stands on the slope below the centre, wherever the ball has turned to."""
    (tmp_path / "rolling.yaml").write_text(ROLLING)
    record = dynsim.simulate(load_scenario(tmp_path / "rolling.yaml"))
    centre = record["q"][-1, [record.labels["q"].index(f"ball.{axis}") for axis in "xyz"]]
    assert centre[0] < -0.3
    page = opened({"one": record})
    page.seek(0.5)
    at = page.js("dynsim.app.actors[0].contacts.find((c) => c.name.startsWith('ball')).at.toArray()")
    np.testing.assert_allclose(at, centre - 0.2 * np.array([-0.6, 0.0, 0.8]), atol=NEAR)


def test_between_samples_bodies_are_where_the_model_has_them(braced: Record, opened: Opens) -> None:
    model = build_model(load_scenario("elbow_comparison", "two_elbows"))
    page = opened({"one": braced})
    for time in np.random.default_rng(2).uniform(0.0, 2.0, 10):
        (shown,) = page.seek(float(time))["records"]
        q = np.array([np.interp(time, braced.time, column) for column in braced["q"].T])
        for link in model.robot.links:
            np.testing.assert_allclose(shown["bodies"][link.name]["p"], model.body_pose(link.name, q)[1], atol=NEAR)


def test_arrows_have_the_sign_of_the_force(braced: Record, opened: Opens) -> None:
    """Blue away from the surface for a push, orange towards it for a pull; the head of both is seen above the floor."""
    page, signs, inclined = opened({"one": braced}), set(), 0
    colours = page.js("dynsim.app.colours")
    for row in range(5, len(braced), 37):
        (shown,) = page.seek(float(braced.time[row]))["records"]
        for k, contact in enumerate(shown["contacts"]):
            force = braced["contact_normal_force"][row, k]
            assert contact["name"] == braced.labels["contact_normal_force"][k]
            assert contact["force"] == pytest.approx(force, abs=1e-3 * np.abs(braced["contact_normal_force"]).max())
            if abs(force) < 0.01:
                continue
            signs.add(np.sign(force))
            assert contact["visible"]
            assert contact["colour"] == (colours["pull"] if force < 0.0 else colours["push"])
            assert contact["state"] == ("pulls" if force < 0.0 else "pushes")
            tail, head = page.js(
                """k => { const { push, at } = dynsim.app.actors[0].contacts[k], o = push.object;
                   o.updateMatrixWorld(true);
                   const p = new THREE.Vector3(0, 0, push.head.position.z).applyMatrix4(o.matrixWorld);
                   return [o.position.z, p.z].map((z) => z - at.z); }""",
                k,
            )
            assert (head - tail) * force > 0.0
            assert min(head, tail) == pytest.approx(0.0, abs=1e-6)
            along, seen = page.js(
                """k => { const { slide } = dynsim.app.actors[0].contacts[k], z = new THREE.Vector3(0, 0, 1);
                   return [z.applyQuaternion(slide.object.quaternion).toArray(), slide.object.visible]; }""",
                k,
            )
            whole = braced["contact_force"][row, k]
            if seen:
                np.testing.assert_allclose(along, whole / np.linalg.norm(whole), atol=2e-3)
                inclined += 1
    assert signs == {-1.0, 1.0}
    assert inclined > 5


def test_states_of_real_contacts_and_events(opened: Opens) -> None:
    record = short("bouncing_link")
    page, seen = opened({"one": record}), set()
    names = {0: "open", 1: "slips", 2: "sticks"}
    for row in range(0, len(record), 9):
        (shown,) = page.seek(float(record.time[row]))["records"]
        for contact in shown["contacts"]:
            k = record.labels["contact_mode"].index(contact["name"])
            assert contact["state"] == names[int(record["contact_mode"][row, k])]
            assert contact["visible"] == (contact["state"] != "open" and abs(contact["force"]) > 0.0)
            seen.add(contact["state"])
    assert "open" in seen
    assert len(seen) > 1
    marks = page.page.locator("#marks i")
    assert marks.count() == len(record.events) > 0
    marks.first.dispatch_event("click")
    assert page.state()["time"] == pytest.approx(record.events[0].time, abs=1e-6)


def test_joints_below_the_floor_are_marked(opened: Opens) -> None:
    """Where the record has them deeper than their radius, and nowhere else."""
    record = short("elbow_comparison", "no_elbow")
    page, deepest = opened({"one": record}), 0.0
    radius = 0.01
    for row in range(0, len(record), 20):
        (shown,) = page.seek(float(record.time[row]))["records"]
        height = dict(zip(record.labels[POSITION], record[POSITION][row, :, 2].astype(float), strict=True))
        joints = {body.name: body.joint.name for body in record.scene.bodies}
        # Links without a shape have no radius.
        thick = {body.name: radius if body.shapes else 0.0 for body in record.scene.bodies}
        expected = {joints[name]: -z for name, z in height.items() if z < -thick[name] - 1e-4}
        assert shown["sunk"] == pytest.approx(expected, abs=2e-5)
        deepest = max(deepest, *expected.values(), 0.0)
    assert deepest > 0.01
    texts = page.page.locator("#labels div:visible").all_inner_texts()
    assert any(text.startswith("↓") and text.endswith("mm") for text in texts)
    assert mentions(page.page.locator("#status").inner_text(), "floor")
    page.js("dynsim.set('depths', false)")
    assert not page.js("dynsim.app.actors[0].sunk.some((one) => one.mark.visible)")


def test_meshes_have_the_colours_of_their_files(tmp_path: Path, opened: Opens) -> None:
    """Unless the links are painted by their motors; the wedge from COLLADA is red on one of its sides."""
    path = meshed_robot(tmp_path)
    file = tmp_path / "wedges" / "meshes" / "wedge.dae"
    library = (
        "<library_effects><effect id='e'><profile_COMMON><technique sid='t'><phong><diffuse><color>1 0 0 1</color>"
        "</diffuse></phong></technique></profile_COMMON></effect></library_effects>"
        "<library_materials><material id='m'><instance_effect url='#e'/></material></library_materials>"
    )
    text = file.read_text().replace("<library_geometries>", library + "<library_geometries>")
    file.write_text(text.replace("<polylist ", "<polylist material='m' "))
    page = opened({"one": dynsim.simulate(load_scenario(path))})
    program = """dynsim.app.actors[0].bodies.map((b) => b.paint.filter((p) => p.role === 'body')
                 .map((p) => p.material.vertexColors))"""
    assert page.js(program)[:3] == [[False], [False], [True]]
    colours = page.js("Array.from(dynsim.app.actors[0].bodies[2].paint[0].mesh.geometry.attributes.color.array)")
    np.testing.assert_array_equal(np.reshape(colours, (-1, 3)), [[1, 0, 0]] * 12)
    page.js("dynsim.set('colouring', 'power')")
    assert page.js(program)[2] == [False]
    page.js("dynsim.set('colouring', '')")
    assert page.js(program)[2] == [True]


def test_heat_is_in_watts(braced: Record, opened: Opens) -> None:
    """R i² of each motor; over the run it is the heat of the energy ledger."""
    page = opened({"one": braced})
    page.js("dynsim.set('colouring', 'current')")
    rating = page.js("({ unit: dynsim.app.rating.unit, top: dynsim.app.rating.top, two: dynsim.app.rating.of(2) })")
    heat = 1.1 * braced["current"] ** 2
    assert rating["unit"] == "W"
    assert rating["two"] == pytest.approx(1.1 * 4.0)
    assert rating["top"] == pytest.approx(np.percentile(heat, 98), rel=0.02)
    assert np.trapezoid(heat.sum(axis=1), braced.time) == pytest.approx(braced["heat_joule"][-1], rel=0.02)
    assert "W" in page.page.locator("#scale").inner_text()


def test_a_measured_record_that_begins_earlier(braced: Record, opened: Opens) -> None:
    """The page begins where both are; the time before can still be gone to. No chip says the same twice."""
    earlier = Record(braced.time - 0.11, provenance={"robot": "arm"})
    for name in ("q", POSITION, ORIENTATION):
        earlier.add(name, braced[name], braced.units[name], labels=braced.labels[name])
    earlier.scene = braced.scene
    page = opened({"simulated": braced, "measured": earlier})
    assert page.state()["time"] == 0.0
    assert page.seek(-1.0)["time"] == pytest.approx(-0.11)
    chips = page.page.locator("#variants .chip").all_inner_texts()
    assert [chip.split() for chip in chips] == [["simulated"], ["measured"]]


def test_wheels_and_support_of_a_snake(snake: Record, opened: Opens) -> None:
    page = opened({"one": snake})
    for row in range(0, len(snake), 60):
        (shown,) = page.seek(float(snake.time[row]))["records"]
        assert list(shown["wheels"].values()) == snake["grounded"][row].astype(bool).tolist()
        assert shown["support"]["inside"] == (snake["support_margin"][row] > 0.0)
        assert shown["gripper"] == snake["gripper"][row]


def test_the_state_of_a_gripper_in_words(snake: Record, opened: Opens) -> None:
    states = Record(snake.time, provenance=snake.provenance)
    for name, signal in snake.signals.items():
        states.add(name, signal.data, signal.unit, labels=signal.labels)
    states.add("gripper_state", np.arange(len(snake)) * 4 // len(snake), "1")
    states.scene = snake.scene
    page = opened({"one": states})
    for part, state in enumerate(("soft", "hardening", "hardened", "softening")):
        (shown,) = page.seek(float(snake.time[(2 * part + 1) * len(snake) // 8]))["records"]
        assert shown["gripper"] == part
        assert f"gripper: {state}" in page.page.locator("#status").inner_text()


def test_centre_of_pressure_of_a_mobile_base(mobile: Record, opened: Opens) -> None:
    page = opened({"one": mobile})
    (shown,) = page.seek(0.5)["records"]
    assert shown["support"] == {"corners": 3, "inside": True}
    position = page.js("dynsim.app.actors[0].support.dot.position.toArray()")
    row = int(np.searchsorted(mobile.time, 0.5))
    np.testing.assert_allclose(position[:2], mobile["center_of_pressure"][row], atol=NEAR)


def test_play_slider_and_keys(braced: Record, opened: Opens) -> None:
    page = opened({"one": braced})
    keys = page.page.keyboard
    page.page.select_option("#speed", "0.05")
    page.page.click("#play")
    page.until("dynsim.state().time > 0.01")
    page.page.click("#play")
    state = page.state()
    assert not state["playing"]
    assert page.state()["time"] == state["time"]
    page.page.locator("#slider").evaluate("s => { s.value = 1.25; s.dispatchEvent(new Event('input')); }")
    assert page.state()["time"] == pytest.approx(1.25)
    assert "1.250 s" in page.page.inner_text("#clock")
    page.page.click("#scene", position={"x": 5, "y": 300})
    keys.press("Home")
    assert page.state()["time"] == 0.0
    keys.press("ArrowRight")
    first = page.state()["time"]
    assert first > 0.0
    keys.press("Shift+ArrowRight")
    assert page.state()["time"] == pytest.approx(11 * first, rel=1e-6)
    keys.press("End")
    assert page.state()["time"] == pytest.approx(2.0)
    keys.press("+")
    assert page.state()["speed"] == 0.1
    for key, camera in (("2", "side"), ("3", "front"), ("4", "top"), ("1", "iso")):
        keys.press(key)
        assert page.state()["camera"] == camera
    keys.press("f")
    assert page.state()["follow"]
    keys.press("d")
    assert page.state()["theme"] == "dark"
    # From the end it plays anew, and stops there again.
    page.page.select_option("#speed", "10")
    keys.press("Space")
    page.until("!dynsim.state().playing && dynsim.state().time === dynsim.app.span[1]")


def test_plots_show_the_signals(braced: Record, opened: Opens) -> None:
    page = opened({"one": braced})
    assert page.state()["plots"][0] == "contact_normal_force"
    page.seek(1.0)
    row = int(np.searchsorted(braced.time, 1.0))
    shown = page.page.locator(".plot .values").first.inner_text()
    for name, force in zip(braced.labels["contact_normal_force"], braced["contact_normal_force"][row], strict=True):
        assert f"{name} {force:.3g}".replace("-", "−")[:-1] in shown
    curve = page.page.locator(".plot .curves").first
    curve.click(position={"x": 44 + 20, "y": 40})
    clicked = page.state()["time"]
    assert 0.0 < clicked < 0.5
    # A drag shows what lies between its ends, a double click everything.
    box = curve.bounding_box()
    page.page.mouse.move(box["x"] + 100, box["y"] + 40)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 180, box["y"] + 40)
    page.page.mouse.up()
    low, high = page.js("dynsim.app.plots.range")
    assert 0.0 < low < high < 2.0
    curve.dblclick(position={"x": 100, "y": 40})
    assert page.js("dynsim.app.plots.range") is None
    page.page.locator(".plot select").first.select_option("torque")
    assert page.state()["plots"][0] == "torque"
    page.page.click("#add-plot")
    assert len(page.state()["plots"]) == 4
    page.page.locator(".plot .bar button").first.click()
    assert "torque" not in page.state()["plots"]
    # Every value of every signal, from the page's tables.
    for name in ("q", "voltage", "energy_electrical", "contact_force"):
        values = np.array(
            page.js("n => { const t = dynsim.app.actors[0].signals.get(n).table;"
                    " return Array.from({length: t.columns}, (_, k) => Array.from(t.column(k))); }", name)
        ).T  # fmt: skip
        data = braced[name].reshape(len(braced), -1)
        np.testing.assert_allclose(values, data, atol=1e-5 * np.ptp(data, axis=0).max())


def test_the_largest_curves_are_named(mobile: Record, opened: Opens) -> None:
    """Of twelve motors the six with the largest rms over what is shown; those of wheels by their side."""
    page = opened({"one": mobile})
    select = page.page.locator(".plot select").first
    select.select_option("torque")
    rms = np.sqrt((mobile["torque"] ** 2).mean(axis=0))
    largest = [mobile.labels["torque"][k] for k in np.sort(np.argsort(-rms)[:6])]
    named = mobile.scene.wheel_names
    drawn = page.js("dynsim.app.plots.plots[0].named.map((k) => dynsim.app.plots.plots[0].drawn[k].label)")
    assert drawn == [named.get(name, name) for name in largest]
    text = page.page.locator(".plot .values").first.inner_text()
    assert mentions(text, "… 6")
    assert all(name in text for name in drawn)
    # Zoomed in, those that are the largest there.
    page.js("dynsim.app.plots.zoom([0.0, 0.02])")
    early = np.sqrt((mobile["torque"][mobile.time <= 0.02] ** 2).mean(axis=0))
    largest = [mobile.labels["torque"][k] for k in np.sort(np.argsort(-early)[:6])]
    drawn = page.js("dynsim.app.plots.plots[0].named.map((k) => dynsim.app.plots.plots[0].drawn[k].label)")
    assert drawn == [named.get(name, name) for name in largest]
    choices = page.page.locator(".plot select").nth(1).locator("option").all_inner_texts()
    assert choices[1:3] == [named["base.left"], named["base.right"]]


def test_the_key_says_what_a_ball_below_the_floor_is(opened: Opens) -> None:
    page = opened({"one": short("elbow_comparison", "no_elbow")})
    page.page.click("#help")
    signs = page.page.inner_text("#signs")
    assert says(signs, "sunk sign")
    assert "↓" in signs
    colour = page.js("getComputedStyle(document.querySelector('[data-colour=sunk]')).color")
    paint = "(c => { const d = document.createElement('i'); d.style.color = c; return d.style.color; })"
    assert colour == page.js(f"{paint}(dynsim.app.colours.sunk)")
    # What this record does not have is not explained.
    assert not says(signs, "wheel sign")


def contrast(first: list[float], other: list[float]) -> float:
    """Of two colours (sRGB, 0 to 1), as WCAG 2 has it."""
    light = [float(np.dot([0.2126, 0.7152, 0.0722], np.power(c, 2.2))) for c in (first, other)]
    return (max(light) + 0.05) / (min(light) + 0.05)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("kind", ["box", "height_field"])
def test_solid_surfaces_are_seen_in_either_theme(kind: str, dark: bool, opened: Opens, tmp_path: Path) -> None:
    """Their edges stand out from the ground behind them by 3 : 1, and so do they from their own faces, nearly."""
    np.savetxt(tmp_path / "heights.csv", -0.2 + 0.01 * np.random.default_rng(1).random((6, 8)), delimiter=",")
    surfaces: dict[str, Any] = {
        "box": {"type": "box", "center_m": [0.7, 0.0, -0.3], "edges_m": [0.2, 1.0, 0.2]},
        "height_field": {"type": "height_field", "file": str(tmp_path / "heights.csv"), "spacing_m": [0.2, 0.2]},
    }
    changes = {"surfaces": {"pipe": surfaces[kind]}, "contacts.points.elbow.enabled": False}
    page = opened({"one": short("brace_on_cylinder", "real", **changes)}, dark=dark)
    colours = "(m => [m.children[0].material.color, m.material.color].map((c) => [c.r, c.g, c.b]))"
    edge, face = page.js(f"{colours}(dynsim.app.actors[0].surfaces[0])")
    fog = page.js("(c => [c.r, c.g, c.b])(dynsim.app.stage.scene.background)")
    assert page.js("dynsim.app.actors[0].surfaces[0].children[0].geometry.attributes.position.count") >= 24
    assert contrast(edge, fog) > 3.0
    assert contrast(edge, face) > 1.9


def test_variants_stand_across_what_is_long(opened: Opens) -> None:
    """The pipe lies along y: variants behind each other would stand on each other's; a wall goes on for all."""
    records = {name: short("brace_on_cylinder", name) for name in ("real", "glued", "free")}
    page = opened(records)
    offsets = np.array([record["offset"] for record in page.state()["records"]])
    radius = 0.1
    for k, offset in enumerate(np.diff(offsets, axis=0)):
        assert abs(offset[0]) > 2.0 * radius, k
        assert abs(offset[1]) < 0.01 * abs(offset[0])
    assert page.js("dynsim.app.actors.map((a) => a.surfaces[0].visible)") == [True] * 3
    page.page.keyboard.press("g")
    assert page.js("dynsim.app.actors.map((a) => a.surfaces[0].visible)") == [True, False, False]
    walls = {name: short("wall_push", name) for name in ("weak_hold", "strong_hold")}
    page = opened(walls)
    _, second = page.state()["records"]
    assert abs(second["offset"][1]) > 0.1
    assert page.js("dynsim.app.actors.map((a) => a.surfaces[0].visible)") == [True, False]


def test_a_phone(mobile: Record, opened: Opens) -> None:
    page = opened({"one": mobile}, size=(390, 844), dark=True)
    assert page.js("document.documentElement.scrollWidth") <= 390
    for name in ("#scene", "#play", "#slider", "#speed", "#theme"):
        box = page.page.locator(name).bounding_box()
        assert box is not None
        assert box["x"] >= 0.0
        assert box["x"] + box["width"] <= 390.0
    # The whole way of the base, and the hand above it, are in the picture.
    for time in (0.0, 0.5, 1.0):
        page.seek(time)
        places = page.js(
            "dynsim.app.actors[0].bodies.map(b => dynsim.app.stage.project(b.object.position, new THREE.Vector3()))"
        )
        width, height = page.js("dynsim.app.stage.size")
        assert all(0.0 < x < width and 0.0 < y < height for x, y in places)
    page.page.click("#play")
    page.until("dynsim.state().time > 0.02")


def test_the_picture_is_not_blank(robot: Record, opened: Opens) -> None:
    page = opened({"one": robot})
    image = page.js("dynsim.image()")
    _, _, text = image.partition(",")
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("L"), dtype=float)
    assert pixels.std() > 5.0
    assert page.js("dynsim.app.actors[0].bodies.flatMap(b => b.paint).length") == 4  # a hub for the lost mesh


def test_links_are_painted_by_their_motors(robot: Record, opened: Opens) -> None:
    page = opened({"one": robot})
    page.page.select_option("#colour", "torque")
    painted = page.js("dynsim.app.actors[0].bodies.map(b => '#' + b.paint[0].material.color.getHexString())")
    scale = page.page.inner_text("#scale")
    assert "N m" in scale
    torque = np.abs(robot["torque"])
    shares = torque[0] / max(np.sort(torque.ravel())[int(0.98 * torque.size)], 1e-12)
    expected = [page.js("x => '#' + App.heat(x).getHexString()", float(share)) for share in shares]
    distance = [
        max(abs(int(a[k : k + 2], 16) - int(b[k : k + 2], 16)) for k in (1, 3, 5))
        for a, b in zip(painted, expected, strict=True)
    ]
    assert max(distance) <= 3
    page.page.select_option("#colour", "")
    plain = page.js("dynsim.app.actors[0].bodies.map(b => '#' + b.paint[0].material.color.getHexString())")
    assert plain != painted


def test_variants_beside_and_over_each_other(braced: Record, opened: Opens) -> None:
    free = short("elbow_comparison", "no_elbow", duration_s=2.0)
    page = opened({"braced": braced, "free": free})
    first, second = page.seek(1.0)["records"]
    assert (first["name"], second["name"]) == ("braced", "free")
    assert first["offset"] == [0.0, 0.0, 0.0]
    assert np.linalg.norm(second["offset"]) > 0.3
    np.testing.assert_allclose(second["bodies"]["link_10"]["p"], free[POSITION][200, 9], atol=NEAR)
    page.page.keyboard.press("g")
    assert page.state()["ghost"]
    assert [record["offset"] for record in page.state()["records"]] == [[0.0, 0.0, 0.0]] * 2
    ghost = page.js("dynsim.app.actors.map(a => a.bodies[3].paint[0].material.opacity)")
    assert ghost[0] == 1.0 > ghost[1]
    page.page.click("#variants .chip >> nth=0")
    assert [record["name"] for record in page.state()["records"]] == ["free"]


def test_a_measured_record_beside_the_simulated_one(braced: Record, opened: Opens) -> None:
    measured = Record(braced.time[::7] + 0.1, provenance={"robot": "arm"})
    measured.add("q", braced["q"][::7] + 0.01, "rad", labels=braced.labels["q"])
    measured.scene = braced.scene
    assert add_body_poses(measured)
    page = opened({"simulated": braced, "robot": measured}, ghost=True)
    assert "measured" in page.page.locator("#variants .chip").nth(1).locator("em").inner_text()
    row = 30
    _, shown = page.seek(float(measured.time[row]))["records"]
    positions = [body["p"] for body in shown["bodies"].values()]
    np.testing.assert_allclose(positions, measured[POSITION][row], atol=NEAR)


def test_frames_from_elsewhere(braced: Record, opened: Opens) -> None:
    """What a live drive sends is shown as it is, and the record comes back when the time is chosen again."""
    page = opened({"one": braced})
    poses = np.concatenate([braced[POSITION][50] + 0.25, braced[ORIENTATION][50]], axis=1)
    state = page.js("f => { dynsim.frame(f); return dynsim.state(); }", {"time": 77.0, "poses": poses.ravel().tolist()})
    positions = [body["p"] for body in state["records"][0]["bodies"].values()]
    np.testing.assert_allclose(positions, braced[POSITION][50] + 0.25, atol=1e-6)
    assert state["time"] == 77.0
    seen = "(a => [a.grown.count, a.grown.line.visible, a.paths[0].path.whole.visible])(dynsim.app.actors[0])"
    assert page.js(seen) == [1, True, False]
    (shown,) = page.seek(float(braced.time[50]))["records"]
    np.testing.assert_allclose([b["p"] for b in shown["bodies"].values()], braced[POSITION][50], atol=NEAR)
    assert page.js(seen) == [1, False, True]


def test_names_are_text(braced: Record, opened: Opens) -> None:
    """What a file calls its things is never taken for HTML or a program."""
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    record = Record(braced.time, provenance={"scenario": {"name": evil, "variant": evil}})
    record.add("q", braced["q"], "rad", labels=braced.labels["q"])
    record.add(evil.replace("/", "|"), braced["q"][:, 0], evil, description=evil)
    record.add_event(1.0, evil, evil)
    record.scene = braced.scene
    assert add_body_poses(record)
    page = opened({evil: record, "two": record})
    assert evil in page.page.inner_text("#variants")
    assert evil in page.page.title()
    assert page.page.locator("img").count() == 0


def test_a_file_that_the_command_wrote(
    braced: Record, opened: Opens, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dynsim.cli import main

    path = braced.save(tmp_path / "record.h5")
    monkeypatch.setattr("sys.argv", ["dynsim", "view", str(path), "--no-open"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    page = opened(tmp_path / "view.html")
    assert page.page.title() == "elbow_comparison"


def test_what_is_under_the_pointer(robot: Record, opened: Opens) -> None:
    page = opened({"one": robot})
    page.seek(0.25)
    x, y = page.js(
        "(() => { const b = dynsim.app.actors[0].bodies[0].object; b.updateMatrixWorld(true);"
        " return dynsim.app.stage.project(new THREE.Vector3(0.02, 0.02, 0.05).applyMatrix4(b.matrixWorld),"
        " new THREE.Vector3()); })()"
    )
    page.page.mouse.move(5, 300)
    page.page.wait_for_timeout(100)
    page.page.locator("#scene").hover(position={"x": x, "y": y})
    page.until("!document.getElementById('hover').hidden")
    text = page.page.inner_text("#hover")
    assert "l0" in text
    assert "torque" in text


def test_a_screenshot(robot: Record, opened: Opens) -> None:
    page = opened({"one": robot})
    with page.page.expect_download() as waited:
        page.page.click("#shot")
    assert waited.value.suggested_filename.endswith(".png")
    pixels = np.asarray(Image.open(waited.value.path()).convert("L"), dtype=float)
    assert pixels.std() > 5.0


def test_motors_at_their_voltage_limit(tmp_path: Path, opened: Opens) -> None:
    path = meshed_robot(tmp_path)
    path.write_text(path.read_text().replace("voltage_limit_V: 48", "voltage_limit_V: 0.2"))
    record = dynsim.simulate(load_scenario(path))
    page, seen = opened({"one": record}), set()
    for row in range(0, len(record), 7):
        (shown,) = page.seek(float(record.time[row]))["records"]
        at_limit = [
            name
            for name, u in zip(record.labels["voltage"], record["voltage"][row], strict=True)
            if abs(u) >= 0.9999 * 0.2
        ]
        assert shown["saturated"] == at_limit
        assert says(page.page.inner_text("#status"), "at voltage limit") == bool(at_limit)
        seen.add(bool(at_limit))
    assert True in seen


def test_a_single_sample_and_a_stranger(opened: Opens) -> None:
    """A record of one instant, without a name, with numbers that JSON does not know."""
    record = Record([0.5])
    record.add("q", [[0.3]], "rad", labels=("j",))
    record.add("odd", [np.inf], "1")
    record.add_event(0.5, "odd", "\ud800", value=np.inf)
    joint = Joint("j", "revolute", (0.0, 1.0, 0.0), (0.0, 0.0, 0.1), HERE, "q", ("j",))
    shape = Shape("capsule", (0.01, 0.2), (0.0, 0.0, 0.1))
    record.scene = Scene((Body("b", -1, joint, (shape,)),))
    assert add_body_poses(record)
    page = opened({"\ud800": record})
    (shown,) = page.seek(3.0)["records"]
    np.testing.assert_allclose(shown["bodies"]["b"]["p"], [0.0, 0.0, 0.1], atol=NEAR)
    assert page.state()["time"] == 0.5


def test_a_notebook_shows_the_page(braced: Record, browser: Any, tmp_path: Path) -> None:
    (tmp_path / "notebook.html").write_text(
        f"<!DOCTYPE html><body>{dynsim.view.show(braced)._repr_html_()}</body>", "utf-8"
    )
    context = browser.new_context(offline=True)
    page = context.new_page()
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.goto((tmp_path / "notebook.html").as_uri())
    frame = page.frames[1]
    frame.evaluate("dynsim.ready")
    frame.evaluate("dynsim.seek(1.0)")
    assert frame.evaluate("dynsim.state().time") == 1.0
    assert complaints == []
    context.close()


CELLS = "[...document.querySelectorAll('#contacts tbody tr')].map((r) => [...r.cells].map((c) => c.textContent))"


def test_contact_table_shows_the_record(braced: Record, opened: Opens) -> None:
    page = opened({"one": braced})
    for row in (100, 250):
        page.seek(float(braced.time[row]))
        cells = page.js(CELLS)
        assert [cell[0] for cell in cells] == list(braced.labels["contact_normal_force"])
        for k, (_, normal, tangential, ratio, state) in enumerate(cells):
            force = braced["contact_normal_force"][row, k]
            slip = np.linalg.norm(braced["contact_force"][row, k, :2])
            assert float(normal.replace("−", "-")) == pytest.approx(force, rel=5e-3, abs=0.01)
            assert float(tangential) == pytest.approx(slip, rel=5e-3, abs=0.01)
            assert float(ratio) == pytest.approx(slip / (0.1 * abs(force)), abs=0.02)
            assert state == ("pulls" if force < 0.0 else "pushes")


def test_open_contacts_have_no_force_in_the_table(opened: Opens) -> None:
    record = short("bouncing_link")
    page = opened({"one": record})
    row = int(np.flatnonzero(~record["contact_mode"].any(axis=1))[0])
    page.seek(float(record.time[row]))
    states = page.js(CELLS)
    assert states
    assert all(cells[1:] == ["–", "–", "–", "open"] for cells in states)


def test_first_four_variants_are_shown_and_labelled(braced: Record, opened: Opens) -> None:
    page = opened({f"variant {k}": braced for k in range(9)})

    def shown() -> list[str]:
        return [record["name"] for record in page.seek(1.0)["records"]]

    labelled = "dynsim.app.labelled.map((a) => a.name)"
    assert shown() == page.js(labelled) == [f"variant {k}" for k in range(4)]
    page.page.click("#choose")
    ticks = page.page.locator("#chooser input")
    assert ticks.count() == 18
    # Label the seventh variant: it is shown too, and the variant that was labelled first loses its labels.
    ticks.nth(2 * 6 + 1).check()
    assert shown() == ["variant 0", "variant 1", "variant 2", "variant 3", "variant 6"]
    assert page.js(labelled) == ["variant 1", "variant 2", "variant 3", "variant 6"]
    colours = page.js("dynsim.app.actors.filter((a) => a.object.visible).map((a) => dynsim.app.colourOf(a))")
    assert len(set(colours)) == 5
    ticks.nth(2 * 1).uncheck()
    assert page.js(labelled) == ["variant 2", "variant 3", "variant 6"]
    titles = page.page.locator("#contacts tbody th").all_inner_texts()
    assert titles == ["variant 2", "variant 3", "variant 6"]
    page.page.locator("#chooser button").nth(1).click()
    assert len(shown()) == 9
    assert len(page.js(labelled)) == 4
    # Nine robots are in several rows, each with its name, and no two at the same place.
    offsets = np.array([record["offset"] for record in page.state()["records"]])
    distance = np.linalg.norm(offsets[:, None] - offsets, axis=-1) + np.eye(9)
    assert distance.min() > 0.3
    assert np.linalg.matrix_rank(offsets, tol=0.1) == 2
    page.until("[...document.querySelectorAll('#labels .name')].filter((n) => !n.hidden).length > 6")
    # No label covers another.
    boxes = page.js(
        """[...document.querySelectorAll('#labels div')].filter((n) => !n.hidden).map((n) => n.getBoundingClientRect())
           .map((b) => [b.left, b.top, b.right, b.bottom])"""
    )
    left, top, right, bottom = np.array(boxes).T
    wide = np.minimum(right[:, None], right) - np.maximum(left[:, None], left) > 3.0
    high = np.minimum(bottom[:, None], bottom) - np.maximum(top[:, None], top) > 3.0
    assert (wide & high).sum() == len(boxes) > 6


def test_brace_radius_and_payload_are_drawn(opened: Opens) -> None:
    loads = {"loads": {"tool": {"type": "payload", "body": "link_5", "point_m": [0, 0, 0.1], "mass_kg": 0.3}}}
    page = opened({"one": short("brace_on_shapes", "block", **loads)})
    parts = """dynsim.app.actors[0].bodies.flatMap((b) => b.paint.map(({ role, mesh }) => ({ body: b.name, role,
        radius: mesh.geometry.parameters.radius, p: mesh.position.toArray(), text: mesh.userData.text })))
        .filter((p) => ['pad', 'load'].includes(p.role))"""
    pad, load = page.js(parts)
    assert (pad["body"], pad["radius"], pad["p"]) == ("link_4", 0.02, [0.0, 0.0, 0.0])
    assert (load["body"], load["p"]) == ("link_5", [0.0, 0.0, 0.1])
    assert load["radius"] == pytest.approx((0.75 * 0.3 / (np.pi * 7850.0)) ** (1.0 / 3.0))
    assert mentions(load["text"], "0.3 kg")
    # The pad touches the block where the force acts.
    page.seek(0.5)
    apart = page.js(
        "(a => { const c = a.contacts[0]; return c.at.distanceTo(a.bodies[3].object.position); })(dynsim.app.actors[0])"
    )
    assert apart == pytest.approx(0.02, abs=1e-4)


def pixels_of(page: Any) -> np.ndarray:
    _, _, text = page.js("dynsim.image()").partition(",")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB"), dtype=float)


def test_robot_behind_a_box_is_seen_through_it(opened: Opens) -> None:
    """From below, the block hides a part of the arm, which appears as a translucent silhouette within the block."""
    page = opened({"one": short("brace_on_shapes", "block")})
    page.js("for (const name of ['forces', 'trace', 'target', 'cones']) dynsim.set(name, false)")
    page.js(
        """(s => { const c = dynsim.app.actors[0].surfaces[0].position; s.preset = null; s.controls.target.copy(c);
           s.camera.position.set(c.x + 0.5, c.y - 0.5, c.z - 0.6); s.controls.update(); })(dynsim.app.stage)"""
    )
    behind = "on => dynsim.app.actors[0].bodies.forEach((b) => b.paint.forEach((p) => { p.behind.visible = on; }))"
    images = []
    for on in (True, False):
        page.js(behind, on)
        images.append(pixels_of(page))
    page.js("() => dynsim.app.actors[0].bodies.forEach((b) => { b.object.visible = false; })")
    bare = pixels_of(page)
    through = np.abs(images[0] - images[1]).max(axis=-1) > 8.0
    assert through.sum() > 100
    # Without silhouettes, these pixels show only the block.
    np.testing.assert_allclose(images[1][through], bare[through], atol=3.0)


def test_wall_between_viewer_and_robot_is_translucent(opened: Opens) -> None:
    page = opened({"one": short("wall_push", "weak_hold")})
    opacity = "dynsim.app.actors[0].surfaces[0].material.opacity"
    pixels_of(page)
    assert page.js(opacity) == 1
    page.js("(s => { s.preset = null; s.camera.position.set(5, 0, 1); s.controls.update(); })(dynsim.app.stage)")
    pixels_of(page)
    assert 0.0 < page.js(opacity) < 0.5


def test_motors_above_their_rating_have_another_colour(robot: Record, opened: Opens) -> None:
    largest = np.abs(robot["torque"]).max(axis=0)
    record = Record(robot.time, provenance=robot.provenance)
    for name, signal in robot.signals.items():
        record.add(name, signal.data, signal.unit, labels=signal.labels)
    record.scene = robot.scene
    names = robot.labels["torque"]
    ratings = largest * np.where(np.arange(len(names)) == 0, 0.5, 2.0)
    record.summary = {
        "motors": [{"joint": n, "nominal_torque_N_m": float(r)} for n, r in zip(names, ratings, strict=True)]
    }
    page = opened({"one": record})
    assert not page.js("[...document.getElementById('colour').options].some((o) => o.value === 'stall')")
    page.page.select_option("#colour", "rating")
    row = int(np.abs(record["torque"][:, 0]).argmax())
    page.seek(float(record.time[row]))
    painted = "(a => a.data.motors.map(([, k]) => '#' + a.bodies[k].paint[0].material.color.getHexString()))"
    colours = page.js(f"{painted}(dynsim.app.actors[0])")
    above = page.js("'#' + new THREE.Color(dynsim.app.colours.saturated).getHexString()")
    assert colours[0] == above
    assert above not in colours[1:]
    assert mentions(page.page.inner_text("#scale"), "rating")
