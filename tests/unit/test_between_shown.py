"""Contacts between bodies in the output of ``check``, MCAP files and films."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import dynsim
from dynsim.cli.commands import app
from dynsim.draw.film.film import Film, Strip
from dynsim.record import Record
from dynsim.record.mcap_file import write_mcap
from dynsim.teleop.snake import Command, begin
from dynsim.teleop.web.live import LiveDrive

ARM = """duration_s: 0.1
plant: {type: serial_arm, link: {axis: y, length_m: 0.2, mass_kg: 0.2, radius_m: 0.02}, chain: [{count: COUNT}],
  initial_deg: ANGLES}
contacts: {law: unilateral, between: [{bodies: self}]}
integrator: {method: time_stepping}
"""


def printed(tmp_path: Path, angles: list[float]) -> list[str]:
    file = tmp_path / "arm.yaml"
    file.write_text(ARM.replace("COUNT", str(len(angles))).replace("ANGLES", str(angles)), encoding="utf-8")
    result = CliRunner().invoke(app, ["check", str(file)])
    assert result.exit_code == 0, result.output
    return [line.strip() for line in result.output.splitlines()]


def test_check_lists_pairs_by_gap(tmp_path: Path) -> None:
    """Links 1 and 3 are parallel, 0.2 m apart; link 4 passes the start of link 1 at 0.2 sin 30°."""
    lines = printed(tmp_path, [0.0, 90.0, 90.0, 60.0])
    gaps = {line.split()[2]: float(line.split()[3]) for line in lines if "gap of" in line}
    assert list(gaps.values()) == sorted(gaps.values())
    assert gaps == pytest.approx({"link_1-link_4": 0.06, "link_1-link_3": 0.16, "link_2-link_4": 0.16}, abs=1e-4)
    assert not any("contact" in line for line in lines)


def test_check_counts_pairs_beyond_twenty(tmp_path: Path) -> None:
    lines = printed(tmp_path, [10.0 * (-1) ** k for k in range(10)])
    assert sum("gap of" in line for line in lines) == 20
    assert any(line.startswith("16 more pairs") for line in lines)


@pytest.fixture(scope="module")
def pushed() -> Record:
    return dynsim.simulate(dynsim.load_scenario("push_box", "shoves", {"duration_s": 0.6}))


def test_mcap_has_the_opposite_force_on_the_other_body(pushed: Record, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    path = write_mcap(pushed, tmp_path / "run.mcap")
    forces: dict[str, list[list[float]]] = {}
    with path.open("rb") as stream:
        for _, channel, _, content in reader.make_reader(
            stream, decoder_factories=[decoder.DecoderFactory()]
        ).iter_decoded_messages():
            if channel.topic.startswith("/contacts/"):
                force = content.wrench.force
                forces.setdefault(channel.topic, []).append([force.x, force.y, force.z])
                assert content.header.frame_id.startswith("contact_")
    own, other = (np.array(forces[f"/contacts/{name}"]) for name in ("link_3_box", "link_3_box_on_box"))
    assert np.abs(own).max() > 10.0
    np.testing.assert_array_equal(own, -other)
    # No body carries the table.
    assert not any("on_table" in topic for topic in forces)


def test_a_film_labels_one_of_two_opposite_forces(pushed: Record) -> None:
    film = Film({"shoves": pushed}, view="side", size=(640, 480))
    painter = film.painters["shoves"]
    names = [contact.point.name for contact in painter._contacts]
    assert {"link_3-box", "link_3-box on box"} <= set(names)
    labelled = {names[k] for k in painter._labelled}
    assert "link_3-box" in labelled
    assert "link_3-box on box" not in labelled


def test_the_axis_of_a_nearly_constant_signal_has_no_offset() -> None:
    record = Record(np.linspace(0.0, 1.0, 11))
    record.add("power", 3.84979 + 1e-7 * np.arange(11.0)[:, None], "W", labels=("joint_1",))
    axes = Strip({"one": record}, (640, 160), "power")._axes
    assert axes.yaxis.get_offset_text().get_text() == ""
    assert max(len(label.get_text()) for label in axes.get_yticklabels()) <= 5


def test_a_live_page_has_opposite_forces_on_both_bodies() -> None:
    operator = {"joints": ["joint_1", "joint_5", "joint_6"], "commands": []}
    changes = {"controller.hand": None, "controller.operator": operator, "integrator.method": "time_stepping"}
    session: Any = begin(dynsim.load_scenario("brace_on_itself", "braced", changes))
    for _ in range(20):
        session.tick(Command((0.0,) * len(session.axes)))
    forces = LiveDrive._contacts(SimpleNamespace(session=session), session.frame())
    own, other = (forces[name] for name in ("elbow", "elbow on link_2"))
    assert own["force"] == other["force"] > 1.0
    np.testing.assert_array_equal(own["normal"], -np.array(other["normal"]))
    np.testing.assert_allclose(own["at"], [0.106, 0.0, 0.43], atol=0.01)
