"""CSV hand paths: numbers read as other programs read them, or refused with file, line and reason."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from support.messages import raises

from dynsim.library.paths.csv import Config

HEADER = "t_s,x_m,y_m,z_m\n"


def path_of(folder: Path, content: str | bytes) -> Config:
    file = folder / "path.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return Config(type="csv", file=str(file))


@pytest.mark.parametrize(
    "content",
    [
        HEADER + "0,1,2,3\n1,2,2,4\n",
        "\ufeff" + HEADER + "0,1,2,3\r\n1,2,2,4\r\n",
        (HEADER + "0,1,2,3\n1,2,2,4").replace("\n", "\r"),
        "t_s, x_m, y_m, z_m\n# a comment\n\n0 , +1.0, 2., 3e0 # at rest\n 1,\t2,.2e1,4\n",
    ],
)
def test_a_path_goes_through_its_rows_and_rests_beyond_them(content: str, tmp_path: Path) -> None:
    path = path_of(tmp_path, content)
    times = np.array([-5.0, 0.0, 1.0, 9.0])
    assert np.array_equal(path.position(times), [[1, 2, 3], [1, 2, 3], [2, 2, 4], [2, 2, 4]])


@pytest.mark.parametrize(
    "cell", ["1_0", "１２", "٣", "nan", "inf", "1e999", "0x10", "", "1 2", "1\u00a0", "\x1c1", '"1"']
)
def test_what_is_no_decimal_number_is_refused_with_its_line(cell: str, tmp_path: Path) -> None:
    """Python alone would take the first three for numbers."""
    with raises(ValidationError, "path.csv:3", "4"):
        path_of(tmp_path, f"{HEADER}0,1,2,3\n1,{cell},2,3\n")


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (HEADER + "0,1,2,3\n1,1,2,3\n1,1,2,3\n", ("path.csv:4", "t_s = 1", "1")),
        (HEADER + "0,1,2,3\n", ("path.csv", "1")),
        ("time,x,y,z\n0,1,2,3\n", ("path.csv:1", "'time,x,y,z'", "t_s,x_m,y_m,z_m")),
        (HEADER + "0,1,2,3\n0.1,1e308,2,3\n0.2,-1e308,2,3\n", ("path.csv",)),
        (HEADER + "0,1,2,3\n5e-324,1,3,3\n", ("path.csv",)),
        (HEADER.encode() + b"0,1,2,3\n1,1,\xff2,3\n", ("path.csv:3", "0xff")),
        (b"\x1b[31m" * 50, ("path.csv:1", re.compile(r"'.{1,130}…'"), "t_s,x_m,y_m,z_m")),
    ],
)
def test_a_table_without_a_path_is_refused(content: str | bytes, names: tuple, tmp_path: Path) -> None:
    with raises(ValidationError, *names) as refused:
        path_of(tmp_path, content)
    assert "\x1b" not in str(refused.value)


def test_an_edited_file_is_read_anew(tmp_path: Path) -> None:
    """The scenario that is loaded already keeps its path, the next one has the new rows."""
    before = path_of(tmp_path, HEADER + "0,1,2,3\n1,1,2,3\n")
    after = path_of(tmp_path, HEADER + "0,7,2,3\n1,7,2,3\n")
    assert before.position(np.zeros(1))[0, 0] == 1.0
    assert after.position(np.zeros(1))[0, 0] == 7.0
