"""The teleop server: access, control by one pilot, stopping the robot, and files of a drive."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest
from support.messages import check_message, mentions, says
from support.teleop_clients import Client, Teleop

from dynsim import Record, load_scenario, simulate

pytestmark = pytest.mark.long

SNAKE, ARM = ("snake_operator",), ("six_axis_arm",)


@pytest.fixture(scope="module")
def compiled() -> None:
    """The kernels of these drives are compiled before anyone waits for them."""
    simulate(load_scenario("snake_operator", None, {"duration_s": 0.1}))


def test_only_the_page_gets_in(teleop: Callable[..., Teleop], compiled: None) -> None:
    server = teleop(*SNAKE)
    host = {"Host": f"127.0.0.1:{server.port}"}
    drive, wrong = f"{server.path}drive", f"/{'x' * 32}/"
    status, body = server.ask(server.path, host)
    assert (status, b"<!DOCTYPE html>" in body) == (200, True)
    assert server.ask(server.path, {"Host": f"localhost:{server.port}"})[0] == 200
    refused = [
        (wrong, host),
        ("/", host),
        (server.path[:-1] + "x/", host),
        (server.path, {"Host": f"example.org:{server.port}"}),
        (server.path, {"Host": "127.0.0.1"}),
        (server.path, {}),
        (f"{wrong}drive", server.upgrade()),
        (drive, server.upgrade(Origin="http://example.org")),
        (drive, server.upgrade(Origin=f"https://127.0.0.1:{server.port}")),
        (drive, server.upgrade(Origin="null")),
        (drive, server.upgrade(Origin=None)),
        (drive, server.upgrade(Host=f"example.org:{server.port}")),
        (drive, server.upgrade(Host=f"example.org:{server.port}", Origin=f"http://example.org:{server.port}")),
    ]
    for path, headers in refused:
        status, body = server.ask(path, headers)
        # What has no Host is no request at all.
        assert status == 403 or (status == 400 and not headers), (path, headers)
        assert b"dynsim" not in body
    assert server.ask(drive, server.upgrade())[0] == 101
    assert server.interrupt() == 0


def test_it_listens_on_loopback_only(teleop: Callable[..., Teleop], compiled: None) -> None:
    server = teleop(*SNAKE)
    with open("/proc/net/tcp", encoding="utf-8") as table:
        listening = [line.split()[1] for line in table if line.split()[3] == "0A"]
    assert [entry for entry in listening if int(entry.split(":")[1], 16) == server.port] == [
        f"0100007F:{server.port:04X}"
    ]
    assert server.interrupt() == 0


def test_one_drives_and_others_watch(teleop: Callable[..., Teleop], compiled: None) -> None:
    server = teleop(*SNAKE)
    first, second = server.connect(), server.connect()
    first.take()
    second.say(do="take")
    second.wish({}, held=False)
    second.drive({"x": -1.0}, 0.5)
    # The first one's key, which was let go half a second ago, and not that of the second, who holds it.
    second.until("state", lambda state: state == "silent")
    first.wish({}, held=False)
    first.drive({"x": 1.0}, 0.8)
    first.until("hand", lambda hand: hand[0] > 0.36)
    first.close()
    second.until("free", bool)
    second.take()
    second.drive({"z": 1.0}, 0.3)
    second.until("state", lambda state: state == "driving")
    second.say(do="end")
    assert server.finish() == 0
    record = Record.load(server.folder / "record.h5")
    assert (np.diff(record["w_target"][:, 0]) >= 0.0).all(), "who watches moves nothing"


def test_silence_stops_the_robot(teleop: Callable[..., Teleop], compiled: None) -> None:
    server = teleop(*ARM)
    client = server.connect()
    client.take()
    client.drive({"y": 1.0}, 0.5)
    client.until("state", lambda state: state == "silent")
    # At 0.5 m/s² it takes 0.2 s from full speed.
    at = client.until("time")["time"]
    stopped = client.until("time", lambda now: now > at + 0.25)
    # Words with the key held do not wake it; a key that was let go and pressed again does.
    client.drive({"y": 1.0}, 0.3)
    again = client.until("time", lambda now: now > stopped["time"] + 0.2)
    assert again["state"] == "silent"
    assert again["hand"] == stopped["hand"]
    client.wish({}, held=False)
    client.drive({"y": 1.0}, 0.3)
    client.until("state", lambda state: state == "driving")
    assert server.interrupt() == 0
    commands = load_scenario(server.folder / "scenario.yaml").controller.operator.commands
    begin, end = commands[0], commands[1]
    assert begin.hand == [0.0, 0.1, 0.0]
    assert end.hand == [0.0, 0.0, 0.0]
    # It drove for as long as it was told to, and for a quarter of a second more; ticks do not hurry.
    assert end.at_s - begin.at_s < 0.5 + 0.25 + 0.15


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("{", "JSON"),
        ('{"n": 1, "axes": [NaN, 0, 0], "held": true}', "NaN"),
        ('{"n": 1, "axes": [0, 0], "held": true}', "axes 3"),
        ('{"n": 1, "axes": [0, 0, 0], "held": true, "mode": 3}', "mode"),
    ],
)
def test_what_is_no_wish_is_refused_by_name(
    teleop: Callable[..., Teleop], compiled: None, text: str, names: str
) -> None:
    server = teleop(*ARM)
    client = server.connect()
    client.take()
    client.socket.send(text)
    check_message(client.until("refused")["refused"], *names.split())
    client.drive({"x": 1.0}, 0.2)
    client.until("state", lambda state: state == "driving")
    assert server.interrupt() == 0


def test_long_many_and_senseless_messages_end_a_connection(teleop: Callable[..., Teleop], compiled: None) -> None:
    from websockets.exceptions import ConnectionClosed

    server = teleop(*ARM)

    def code_after(send: Callable[[Client], None]) -> int:
        client = server.connect()
        with pytest.raises(ConnectionClosed) as closed:  # noqa: PT012 (whichever of them meets it)
            send(client)
            while True:
                client.hear()
        assert closed.value.rcvd is not None
        return int(closed.value.rcvd.code)

    assert code_after(lambda client: client.socket.send('{"n": 1' + " " * 4100 + "}")) == 1009
    assert code_after(lambda client: [client.socket.send("{") for _ in range(30)] and None) == 1008
    assert code_after(lambda client: [client.wish({}) for _ in range(1000)] and None) == 1008
    # Others drive on.
    client = server.connect()
    client.take()
    client.drive({"x": 1.0}, 0.2)
    client.until("state", lambda state: state == "driving")
    assert server.interrupt() == 0


@pytest.mark.parametrize("scenario", [SNAKE, ("mobile_path",), ("elbow_comparison_floor",)])
def test_a_drive_leaves_its_record_and_a_script_that_repeats_it(
    teleop: Callable[..., Teleop], scenario: tuple[str, ...], compiled: None
) -> None:
    server = teleop(*scenario)
    client = server.connect()
    client.take()
    names = [axis["name"] for axis in client.hello["axes"]]
    client.drive(dict.fromkeys(names, 0.5), 0.6)
    client.drive({names[0]: -0.33}, 0.4, closed=True)
    client.until("state", lambda state: state == "driving")
    assert server.interrupt() == 0
    assert mentions(server.said, str(server.folder))
    assert "dynsim run" in server.said
    assert server.group_is_gone()
    assert sorted(file.name for file in server.folder.iterdir()) == [
        "record.h5",
        "scenario.yaml",
        "summary.json",
        "view.html",
    ]
    record, again = Record.load(server.folder / "record.h5"), simulate(load_scenario(server.folder / "scenario.yaml"))
    assert record.complete
    assert set(record) == set(again)
    for name in record:
        assert np.array_equal(record[name], again[name], equal_nan=True), name


def test_nobody_left_ends_a_drive_that_is_told_so(teleop: Callable[..., Teleop], compiled: None) -> None:
    server = teleop(*SNAKE, "--until-closed")
    client = server.connect()
    client.take()
    client.drive({"x": 1.0}, 0.2)
    client.close()
    assert server.finish() == 0
    assert says(server.said, "last browser")
    assert server.group_is_gone()


def test_a_port_that_is_taken_is_an_error(teleop: Callable[..., Teleop], compiled: None) -> None:
    server = teleop(*SNAKE)
    command = [sys.executable, "-m", "dynsim", "teleop", *SNAKE, "--no-open", "--http-port", str(server.port)]
    other = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=server.folder.parent, check=False)
    assert other.returncode == 2
    assert mentions(" ".join(other.stderr.split()), str(server.port), "--http-port")
    begun = time.monotonic()
    assert server.interrupt() == 0
    assert time.monotonic() - begun < 60
