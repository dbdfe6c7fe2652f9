"""The teleop page in a real browser: keys, a simulated gamepad, touch stick, and loss of focus."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from support.messages import PHRASES, says
from support.teleop_clients import PATIENCE_S, Teleop

pytestmark = pytest.mark.long

# Until what is held is let go and held again, where it drives nothing [s].
ANEW_S = 2.0
# A gamepad of the standard layout, whose axes and buttons a test sets.
GAMEPAD = """
window.pad = { connected: true, mapping: "standard", axes: [0, 0, 0, 0],
  buttons: Array.from({ length: 17 }, () => ({ pressed: false, value: 0 })) };
navigator.getGamepads = () => [window.pad, null, null, null];
"""


class Pilot:
    """The page of a drive in a browser."""

    def __init__(self, page: Any, teleop: Teleop) -> None:
        self.page, self.requests, self.complaints = page, [], []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)
        page.add_init_script(GAMEPAD)
        page.goto(teleop.address)
        page.evaluate("dynsim.ready")
        self.until("dynsim.drive?.role === 'pilot' && dynsim.drive.frames > 0")

    def js(self, program: str) -> Any:
        return self.page.evaluate(program)

    def until(self, program: str, anew: Callable[[], None] | None = None) -> None:
        """Wait; ``anew`` lets go and holds again, where a busy machine was silent for too long and all was let go."""
        end, due = time.monotonic() + PATIENCE_S, time.monotonic() + ANEW_S
        while not self.js(program):
            if anew is not None and time.monotonic() > due and self.js("dynsim.drive.last.state !== 'driving'"):
                anew()
                due = time.monotonic() + ANEW_S
            assert time.monotonic() < end, (program, self.js("dynsim.drive?.state"), self.complaints)
            self.page.wait_for_timeout(20)

    def hand(self) -> list[float]:
        return list(self.js("dynsim.drive.last.hand"))

    def space(self) -> None:
        """Hold the dead-man's key, after letting it go."""
        self.page.keyboard.up(" ")
        self.page.wait_for_timeout(100)
        self.page.keyboard.down(" ")

    def button(self) -> None:
        """The same on the gamepad."""
        self.js("pad.buttons[5].pressed = false")
        self.page.wait_for_timeout(100)
        self.js("pad.buttons[5].pressed = true")

    def moved(self, axis: int, direction: float, anew: Callable[[], None]) -> None:
        """Wait until the hand has moved along an axis."""
        before = self.hand()[axis]
        sign = 1 if direction > 0 else -1
        self.until(f"{sign} * (dynsim.drive.last.hand[{axis}] - {before}) > {abs(direction)}", anew)

    def rests(self) -> None:
        """Wait until nothing is asked for, and the hand has come to rest."""
        self.until("dynsim.drive.last.state !== 'driving'")
        begun = self.js("dynsim.drive.last.time")
        self.until(f"dynsim.drive.last.time > {begun} + 0.3")
        before = self.hand()
        self.until(f"dynsim.drive.last.time > {begun} + 0.6")
        assert self.hand() == pytest.approx(before, abs=1e-4)


@pytest.fixture
def pilot(browser: Any) -> Iterator[Callable[..., Pilot]]:
    """Opens the page of a drive; at the end it has asked for nothing else and complained of nothing."""
    pilots: list[tuple[Pilot, Teleop]] = []
    contexts: list[Any] = []

    def opens(teleop: Teleop, **screen: Any) -> Pilot:
        context = browser.new_context(**{"viewport": {"width": 700, "height": 500}} | screen)
        context.set_default_timeout(1e3 * PATIENCE_S)
        contexts.append(context)
        opened = Pilot(context.new_page(), teleop)
        pilots.append((opened, teleop))
        return opened

    yield opens
    for opened, teleop in pilots:
        asked = [url for url in opened.requests if not url.startswith(("data:", "blob:", "ws:"))]
        assert [url for url in asked if not url.endswith("/favicon.ico")] == [teleop.address]
        assert opened.complaints == []
    for context in contexts:
        context.close()


def test_keys_gamepad_and_sticks_drive_a_snake(teleop: Callable[..., Teleop], pilot: Callable[[Teleop], Pilot]) -> None:
    drive = teleop("snake_operator", "--speed", "0.2")
    user = pilot(drive)
    keyboard = user.page.keyboard
    assert [user.page.locator(f"kbd:text-is('{key}')").count() for key in "GMN"] == [1, 1, 1]
    # Keys of axes alone do nothing, with space they drive.
    keyboard.down("w")
    before = user.hand()
    user.page.wait_for_timeout(500)
    assert user.hand() == pytest.approx(before, abs=1e-6)
    user.space()
    user.moved(0, 0.02, user.space)
    keyboard.up(" ")
    user.rests()
    keyboard.up("w")
    # The page's own keys are still: w drives, and space plays nothing.
    assert user.js("dynsim.state().playing") is False

    user.js("pad.axes[3] = 1")
    user.page.wait_for_timeout(300)
    user.rests()
    user.button()
    user.moved(2, -0.01, user.button)
    user.js("pad.buttons[0].pressed = true")
    user.until("dynsim.drive.last.gripper === 1", user.button)
    user.js("pad.buttons[5].pressed = false; pad.buttons[0].pressed = false; pad.axes[3] = 0")
    user.rests()

    box = user.page.locator(".stick").first.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def stick() -> None:
        user.page.mouse.up()
        user.page.mouse.move(*middle)
        user.page.mouse.down()
        user.page.mouse.move(middle[0] - 40, middle[1])

    stick()
    user.moved(1, 0.01, stick)
    user.page.mouse.up()
    user.rests()

    # A mode is taken with the key held.
    user.page.select_option("#mode", "3")
    user.page.wait_for_timeout(200)
    assert user.js("dynsim.drive.last.mode") == 1
    user.space()
    user.until("dynsim.drive.last.mode === 3", user.space)
    keyboard.up(" ")
    user.page.click("#end")
    assert drive.finish() == 0
    assert says(drive.said, "by pilot")
    user.until("dynsim.drive.ended")
    assert says(user.page.inner_text(".state"), "by pilot")
    assert not any(user.page.locator(part).is_visible() for part in ("#end", "#hold", "#role", ".stick >> nth=0"))


def test_the_page_says_what_is_in_the_way(teleop: Callable[..., Teleop], pilot: Callable[[Teleop], Pilot]) -> None:
    """The edge of reach, which is not driving as usual; silence, until the key is let go; the end."""
    drive = teleop("elbow_comparison", "--variant", "two_elbows")
    user = pilot(drive)
    user.page.keyboard.down("r")
    user.space()
    user.until("document.querySelector('.state.hindered')?.textContent.includes('joint_10')", user.space)
    # The page is too busy to say a word.
    user.js("dynsim.drive.transmit = (said) => { dynsim.drive.unsaid = said; }")
    user.until(f"document.querySelector('.state.silent')?.textContent.includes('{PHRASES['release key']}')")
    assert drive.interrupt() == 0
    user.until("document.querySelector('.state.over')?.textContent.includes('interrupted')")


def test_focus_that_is_lost_lets_everything_go(teleop: Callable[..., Teleop], pilot: Callable[[Teleop], Pilot]) -> None:
    drive = teleop("mobile_path")
    user = pilot(drive)
    keyboard = user.page.keyboard
    user.space()
    keyboard.down("ArrowUp")
    user.until("dynsim.drive.last.state === 'driving' && dynsim.drive.command.axes[3] === 1", user.space)
    begun = user.js("dynsim.drive.last.poses[0]")
    user.until(f"dynsim.drive.last.poses[0] > {begun} + 0.02", user.space)
    user.js("window.dispatchEvent(new Event('blur'))")
    # Keys are still down: they count only when they are pressed anew.
    user.until("dynsim.drive.command.held === false")
    user.rests()
    # What is drawn is what the simulation has.
    drawn = user.js("Object.values(dynsim.state().records[0].bodies).flatMap((body) => [...body.p, ...body.q])")
    assert drawn == pytest.approx(user.js("dynsim.drive.last.poses"), abs=1e-4)
    keyboard.up("ArrowUp")
    keyboard.up(" ")
    assert drive.interrupt() == 0
    assert drive.group_is_gone()


def test_page_shows_contacts_that_close_later(teleop: Callable[..., Teleop], pilot: Callable[[Teleop], Pilot]) -> None:
    """The hand reaches the box after the start; before that the page shows only the box on its table."""
    drive = teleop("push_box", "--variant", "pushes")
    user = pilot(drive)

    def shows(name: str) -> str:
        return f"dynsim.state().records[0].contacts.some((one) => one.name === '{name}' && one.shown)"

    user.until(shows("box1.table"))
    assert not user.js(shows("link_3-box"))
    assert "link_3-box: open" not in user.page.inner_text("#status")
    user.page.keyboard.down("w")
    user.space()
    user.until(shows("link_3-box"), user.space)
    assert user.js(shows("link_3-box on box"))
    assert "link_3-box: " in user.page.inner_text("#status")
    assert not user.js(shows("link_3-box_2"))
    assert drive.interrupt() == 0


PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}


def test_a_phone_has_all_axes_beside_the_scene(teleop: Callable[..., Teleop], pilot: Callable[..., Pilot]) -> None:
    """Sticks for all six axes of a gripper within 390 pixels, below the scene; one drives what had none."""
    drive = teleop("snake_operator", "--speed", "0.2")
    user = pilot(drive, **PHONE)
    user.until(f"document.querySelector('.state').textContent.includes('{PHRASES['hold stick']}')")
    axes = user.js("[...dynsim.drive.sticks.values()].flatMap((s) => [s.across, s.up]).filter(Boolean)")
    assert sorted(axes) == sorted(user.js("dynsim.drive.names"))
    assert len(axes) == 6
    assert user.js("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]") == [390, 844]
    view = user.page.locator("#view").bounding_box()
    assert view["height"] > 300
    for part in (".stick >> nth=0", ".stick >> nth=2", "#end", "#role", ".state"):
        box = user.page.locator(part).bounding_box()
        assert box["y"] >= view["y"] + view["height"]
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
        assert box["y"] + box["height"] <= 844
    box = user.page.locator(".stick[data-name=beta]").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = user.page.context.new_cdp_session(user.page)

    def finger(kind: str, *points: tuple[float, float]) -> None:
        touches = [{"x": x, "y": y} for x, y in points]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})

    def turn() -> None:
        finger("touchStart", middle)
        finger("touchMove", (middle[0], middle[1] - 0.3 * box["height"]))

    def anew() -> None:
        finger("touchEnd")
        user.page.wait_for_timeout(100)
        turn()

    turn()
    beta = user.js("dynsim.drive.names.indexOf('beta')")
    asked = f"dynsim.drive.command.held && dynsim.drive.command.axes[{beta}] > 0.8"
    user.until(f"{asked} && dynsim.drive.last.state === 'driving'", anew)
    finger("touchEnd")
    user.until("dynsim.drive.command.held === false")
    assert drive.interrupt() == 0


def test_a_watcher_is_told_nothing_that_the_pilot_is_to_do(
    teleop: Callable[..., Teleop], pilot: Callable[..., Pilot], browser: Any
) -> None:
    drive = teleop("elbow_comparison", "--variant", "two_elbows")
    user = pilot(drive)
    context = browser.new_context(**PHONE)
    watcher = context.new_page()
    watcher.goto(drive.address)
    watcher.evaluate("dynsim.ready")
    user.space()
    user.until("dynsim.drive.last.state === 'driving'", user.space)
    user.js("dynsim.drive.transmit = () => {}")
    end = time.monotonic() + PATIENCE_S
    while watcher.evaluate("dynsim.drive?.last?.state") != "silent":
        assert time.monotonic() < end
        watcher.wait_for_timeout(20)
    assert watcher.evaluate("dynsim.drive.role") == "watching"
    assert says(watcher.inner_text(".state"), "pilot silent")
    assert not any(watcher.locator(part).is_visible() for part in (".stick >> nth=0", "#hold", "#end"))
    user.until(f"document.querySelector('.state.silent')?.textContent.includes('{PHRASES['release key']}')")
    context.close()
    assert drive.interrupt() == 0
