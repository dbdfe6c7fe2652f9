"""The posture page: its process, its messages, and its sliders, tables and copied text in a real browser."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML
from support.teleop_clients import PATIENCE_S, Teleop

from dynsim import load_scenario
from dynsim.engine import check
from dynsim.teleop.posture import with_keys

pytestmark = pytest.mark.long


@pytest.fixture
def posed(teleop: Callable[..., Teleop]) -> Callable[..., Teleop]:
    """Starts ``dynsim pose``."""
    return partial(teleop, command=("pose",), writes=False)


def test_changes_reach_all_pages_and_ctrl_c_prints_the_keys(posed: Callable[..., Teleop], tmp_path: Path) -> None:
    command = posed("elbow_comparison", "--variant", "elbow_4", "--set", "plant.base.yaw_deg=30")
    host = {"Host": f"127.0.0.1:{command.port}"}
    assert command.ask(command.path, host)[0] == 200
    assert command.ask(f"/{'x' * 32}/", host)[0] == 403
    assert command.ask(f"{command.path}drive", command.upgrade(Origin="http://example.org"))[0] == 403
    first, second = command.connect(), command.connect()
    assert [slider["name"] for slider in first.hello["sliders"]] == [f"joint_{k}" for k in range(1, 11)]
    for client in (first, second):  # the first frame, without a change
        assert client.until("values")["values"]["joint_2"] == pytest.approx(45.0)
    first.say(do="set", name="joint_10", value=12.5)
    for client in (first, second):
        client.until("values", lambda values: values["joint_10"] == pytest.approx(12.5))
    first.say(do="set", name="joint_10")
    assert "value" in first.until("refused")["refused"]
    second.say(do="snap", name="nowhere", hand=False)
    assert "nowhere" in second.until("note", bool)["note"]
    assert command.interrupt() == 0
    keys = YAML(typ="safe").load(command.said.partition("Keys of the posture:\n")[2])
    assert keys["plant"]["initial_deg"] == pytest.approx([0, 45, 90, -90, 45, 45, -90, 45, -45, 12.5])
    assert list(tmp_path.iterdir()) == []


def test_unchanged_posture_prints_no_keys_when_its_page_closes(posed: Callable[..., Teleop]) -> None:
    command = posed("snake_operator", "--until-closed")
    client = command.connect()
    client.until("values")
    client.close()
    assert command.finish() == 0
    assert "initial_joints_rad" not in command.said


class User:
    """The posture page in a browser."""

    def __init__(self, page: Any, command: Teleop) -> None:
        self.page, self.complaints = page, list[str]()
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)
        page.goto(command.address)
        self.until("window.dynsim?.pose?.frames > 0")

    def js(self, program: str) -> Any:
        return self.page.evaluate(program)

    def until(self, program: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while not self.js(program):
            assert time.monotonic() < end, (program, self.complaints)
            self.page.wait_for_timeout(30)

    def button(self, name: str) -> None:
        self.page.locator(f"#pose-{name}").click()

    def type(self, name: str, value: float) -> None:
        """Type a value next to a slider."""
        box = self.page.locator(f"input[type=number][data-name='{name}']")
        box.fill(str(value))
        box.press("Enter")
        box.blur()


@pytest.fixture
def user(browser: Any) -> Iterator[Callable[[Teleop], User]]:
    """Opens the page; at the end it has complained of nothing."""
    contexts, users = list[Any](), list[User]()

    def opens(command: Teleop) -> User:
        context = browser.new_context(viewport={"width": 1300, "height": 900})
        context.grant_permissions(["clipboard-read", "clipboard-write"])
        context.set_default_timeout(1e3 * PATIENCE_S)
        contexts.append(context)
        users.append(User(context.new_page(), command))
        return users[-1]

    yield opens
    for opened in users:
        assert opened.complaints == []
    for context in contexts:
        context.close()


def test_posture_found_on_the_page_passes_the_check(
    posed: Callable[..., Teleop], user: Callable[[Teleop], User]
) -> None:
    command = posed("brace_on_shapes", "--variant", "flat")
    page = user(command)
    text = "document.querySelector('#pose textarea').value"
    page.type("joint_3", 55)
    page.until(f"{text}.includes('55')")
    # The brace has left its surface: its gap is shown, and the button puts it back.
    page.until("dynsim.pose.last.points[0].gap > 0.01 && !document.querySelector('#pose .touch')")
    slider = page.page.locator("input[type=range][data-name='joint_2']")
    slider.focus()
    for _ in range(3):
        slider.press("ArrowRight")
    page.until("dynsim.pose.last.values.joint_2 > 60.001")
    page.button("snap-elbow")
    page.until("Math.abs(dynsim.pose.last.points[0].gap) < 1e-9 && document.querySelector('#pose .touch')")
    # The hand moves up by 30 mm along its circle, and the brace stays.
    before = page.js("dynsim.pose.last.hand")
    page.type("hand.z", round(before[2] + 0.03, 4))
    page.until(f"dynsim.pose.last.hand[2] > {before[2] + 0.025}")
    assert page.js("dynsim.pose.last.points[0].gap") == pytest.approx(0.0, abs=1e-9)
    line = "dynsim.app.actors[0].paths.find((path) => path.kind === 'target').line"
    target = page.js(f"{line}.geometry.attributes.instanceStart.array.slice(0, 3)")
    assert target == pytest.approx(page.js("dynsim.pose.last.hand"), abs=1e-4)
    shown = page.js("dynsim.state().records[0].hand")
    assert shown == pytest.approx(page.js("dynsim.pose.last.hand"), abs=1e-5)
    page.button("check")
    page.until("dynsim.pose.note.textContent.startsWith('check: ok')")
    page.button("copy")
    page.until("document.querySelector('#pose-copy').textContent === 'copied'")
    copied = page.js("navigator.clipboard.readText()")
    assert copied == page.js(text)
    posed_scenario = with_keys(load_scenario("brace_on_shapes", "flat"), YAML(typ="safe").load(copied))
    start = check(posed_scenario)
    assert start.hand == pytest.approx(page.js("dynsim.pose.last.hand"), abs=1e-6)
    assert start.gaps["elbow"] == pytest.approx(0.0, abs=1e-9)
    assert start.off_path == pytest.approx(0.0, abs=1e-9)
    for _ in range(page.js("dynsim.pose.last.undo")):
        page.page.keyboard.press("Control+z")
    page.until("dynsim.pose.last.undo === 0 && dynsim.pose.last.values.joint_3 === 60")
    assert command.interrupt() == 0
    page.until("document.querySelector('#pose .note').textContent.includes('the command has ended')")


def test_bodies_below_a_surface_are_red_and_a_new_brace_is_drawn(
    posed: Callable[..., Teleop], user: Callable[[Teleop], User]
) -> None:
    page = user(posed("elbow_comparison_floor", "--variant", "no_elbow"))
    red = (
        "dynsim.app.actors[0].bodies.filter((b) => b.paint[0].material.color.getHex() === 0xc0202a).map((b) => b.name)"
    )
    assert page.js(red) == []
    page.type("joint_2", 60)
    page.until("dynsim.pose.last.values.joint_2 === 60")
    page.until("document.querySelectorAll('#pose td.bad').length > 0")
    below = page.js("dynsim.pose.last.near.filter((one) => one.gap < one.least).map((one) => one.body)")
    assert sorted(page.js(red)) == sorted(set(below))
    assert "link_7" in below
    page.button("reset")
    page.until(f"dynsim.pose.last.values.joint_2 === 45 && ({red}).length === 0")
    page.page.locator("#pose select").first.select_option("link_8")
    page.button("brace")
    page.until("dynsim.state().records[0].contacts.some((one) => one.name === 'link_8_floor')")
    page.button("undo")
    page.until("!dynsim.state().records[0].contacts.some((one) => one.name === 'link_8_floor')")


def test_page_of_check_shows_the_start_of_every_variant(browser: Any, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "dynsim", "check", "elbow_comparison", "--view"]
    environment = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "BROWSER")}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    page = browser.new_page(viewport={"width": 1000, "height": 600})
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto((tmp_path / "results" / "elbow_comparison" / "start.html").as_uri())
    page.evaluate("dynsim.ready")
    shown = {record["name"]: record for record in page.evaluate("dynsim.state().records")}
    hand = check(load_scenario("elbow_comparison")).hand
    assert list(shown) == ["two_elbows", "elbow_7", "elbow_4", "no_elbow"]
    for record in shown.values():
        assert record["hand"] == pytest.approx(hand, abs=1e-5)
    # Bilateral contact: elbow 4 pulls.
    forces = {point["name"]: point["force"] for point in shown["two_elbows"]["contacts"]}
    assert forces["elbow_4"] < 0.0 < forces["elbow_7"]
    assert not page.locator("#side").is_visible()
    assert complaints == []
    page.close()
