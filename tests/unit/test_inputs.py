"""Reading files that users name: only regular ones, and YAML gives plain values or one error with its line."""

import os
import pwd
import re
import socket
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.messages import raises

from dynsim.errors import RecordError, ScenarioError
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.servo_map import load_servo_map
from dynsim.hardware.virtual.faults import load_fault_script
from dynsim.record import Record
from dynsim.scenario import build_model, find_scenario, load_scenario
from dynsim.system.inputs import DEPTH_LIMIT, NODE_LIMIT, SIZE_LIMIT, check_file, parse_yaml, read_text


def parse(text: str):
    return parse_yaml(text, ScenarioError, "case.yaml")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("# nothing", None),
        ("a: 1\nb: -2.5e3\nc: true\nd: ~\ne: x y", {"a": 1, "b": -2500.0, "c": True, "d": None, "e": "x y"}),
        ("a: 012\nb: 0x1F\nc: 1_000\nd: 1E-8\ne: 5.", {"a": 12, "b": 31, "c": "1_000", "d": 1e-8, "e": 5.0}),
        ("a: 2024-99-99\nb: ._\nc: yes\nd: 1:30", {"a": "2024-99-99", "b": "._", "c": "yes", "d": "1:30"}),
        ("a: '1'\nb: !!str 1\nc: !!float 1\nd: ! 1", {"a": "1", "b": "1", "c": 1.0, "d": "1"}),
        ("a: .inf\nb: -.INF", {"a": float("inf"), "b": -float("inf")}),
        ("1: a\nnull: b\ntrue: c\n1.5: d", {"1": "a", "null": "b", "true": "c", "1.5": "d"}),
        ("\ufeffa: 1", {"a": 1}),
        ("x: &x {a: 1, b: 2}\ny: {<<: *x, b: 3}", {"x": {"a": 1, "b": 2}, "y": {"a": 1, "b": 3}}),
        ("- &x {a: 1}\n- &y {a: 2, b: 2}\n- {<<: [*x, *y]}", [{"a": 1}, {"a": 2, "b": 2}, {"a": 1, "b": 2}]),
        ("'<<': 1", {"<<": 1}),
    ],
)  # fmt: skip
def test_yaml_becomes_plain_values(text: str, value: object):
    parsed = parse(text)
    assert parsed == value
    assert repr(parsed) == repr(value)  # 1 == 1.0 == True


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("a: !!python/object:os.system x", "1 !!python/object:os.system"),
        ("a:\n  !!binary eA==", "2 !!binary"),
        ("a: !!set {x}", "1 !!set"),
        ("a: !!omap [x: 1]", "1 !!omap"),
        ("a: !own 1", "1 !own"),
        ("a: 1\n!!merge b: {c: 1}", "2 !!merge"),
        ("!!int 1: 2", "1 !!int"),
        ("a: !!int x", "1 x !!int"),
        ("a: " + "9" * 5000, "1 5000"),
        ("a: 0x" + "f" * 300, "1 302"),
        ("a: " + "[" * 10_000, f"1 {DEPTH_LIMIT}"),
        (
            "a0: &a0 [1]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}]\n" for k in range(1, 60)),
            f"50 {DEPTH_LIMIT}",
        ),
        ("a: &self\n  <<: *self", "2 *self &self"),
        ("a: &self [*self]", "1 *self &self"),
        ("a: *gone", "1 *gone &gone"),
        ("a: {<<: 1}", "1 <<"),
        ("b: 1\na: x\x07", "2 U+0007"),
        ("a: x\0y", "1 U+0000"),
        ('a: "\\x1b[31m"', "1 U+001B"),
        ('a: "\\ud800"', "1"),
        ("a: \ud800", "1 U+D800"),
        ("a: 1\nb: 2\na: 3", "3 a 1"),
        ("[1]: 2", "1 list"),
        ("{a: 1}: 2", "1 mapping"),
        ("a: 1\n---\nb: 2", "2"),
        ("a: [1", "YAML"),
        ("%YAML 3.0\n---\na: 1", "1 YAML"),
        ("a: @x", "1 YAML"),
        ("a:\n\tb: 1", "2 YAML"),
    ],
)
def test_every_fault_of_yaml_is_one_line_with_its_place(text: str, names: str):
    with raises(ScenarioError, *names.split()) as caught:
        parse(text)
    line = names.split()[0]
    assert str(caught.value).startswith(f"case.yaml:{line}: " if line.isdigit() else "case.yaml:")
    assert str(caught.value).isprintable()


def test_whatever_the_parser_stumbles_over_is_an_error_of_the_text(monkeypatch: pytest.MonkeyPatch):
    from ruamel.yaml import YAML

    def stumble(self: YAML, text: str):
        raise IndexError("string index out of range")
        yield

    monkeypatch.setattr(YAML, "parse", stumble)
    with raises(ScenarioError, "string index out of range"):
        parse("a: 1")


def test_aliases_are_copies_of_a_bounded_number():
    shared = parse("x: &x {a: [1]}\ny: *x")
    shared["x"]["a"].append(2)
    assert shared["y"] == {"a": [1]}
    # Every line holds ten of the line before it: 10^9 values.
    bomb = "a0: &a0 1\n" + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 10))
    with raises(ScenarioError, re.compile(r"^case\.yaml:\d+: "), f"{NODE_LIMIT:,}".replace(",", " ")):
        parse(bomb)


def test_a_long_list_is_read_by_the_compiled_parser():
    from ruamel.yaml.main import CParser

    # The other one takes 7 s for this list instead of 0.3.
    assert CParser is not None or sys.implementation.name != "cpython"
    values = parse("a: [" + ", ".join(f"{0.1 * k:.6f}" for k in range(300_000)) + "]")["a"]
    assert len(values) == 300_000
    assert values[12345] == 1234.5
    assert values.lines[299_999] == 1


def special_files(folder: Path) -> dict[str, Path]:
    """What a name may stand for besides a regular file."""
    os.mkfifo(folder / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(folder / "socket"))
    return {
        "pipe": folder / "pipe",
        "socket": folder / "socket",
        "device": Path("/dev/zero"),
        "folder": folder,
        "File name too long": folder / ("x" * 300),
        "missing/file": folder / "missing" / "file",
        r"a\x00b": folder / "a\0b",
    }


def test_only_regular_files_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    for name, path in special_files(tmp_path).items():
        with raises(ScenarioError, name):
            find_scenario(path)
        with raises(RecordError, name):
            Record.load(path)
        with raises(ServoMapError, name):
            load_servo_map(path)
        with raises(ServoMapError, name):
            load_fault_script(path)
        with raises(ScenarioError, re.compile(rf"controller\.hand\.path(\.file|: .*{re.escape(name)})")):
            load_scenario("elbow_comparison", overrides={"controller.hand.path": {"type": "csv", "file": str(path)}})
        with raises(Exception, name):
            build_model(load_scenario("six_axis_arm", overrides={"plant.file": str(path)}))


def test_a_file_that_may_not_be_looked_up_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # Root may look everywhere: the answer of the system is put in.
    def refuse(path: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("dynsim.system.inputs.os", SimpleNamespace(stat=refuse))
    with raises(ScenarioError, "case.yaml", "Permission denied"):
        check_file(tmp_path / "closed" / "case.yaml", ScenarioError)
    # The name of a shipped scenario still means it.
    assert find_scenario("single_pendulum").name == "single_pendulum.yaml"


def test_a_file_is_read_up_to_a_size(tmp_path: Path):
    path = tmp_path / "case.yaml"
    with path.open("wb") as file:
        file.truncate(SIZE_LIMIT + 1)
    with raises(ScenarioError, "case.yaml", f"{SIZE_LIMIT / 1e6:g} MB"):
        read_text(path, ScenarioError)


def test_a_user_without_a_home_has_a_kernel_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    from dynsim.jit.kernel import cache_folder

    def nobody(uid: int) -> None:
        raise KeyError(uid)

    for name in ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", nobody)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert cache_folder.__wrapped__().is_relative_to(tmp_path)
