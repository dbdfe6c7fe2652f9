"""The HTML text of a viewer page: its scripts and styles, three.js from its package, and the data; writing of pages."""

from __future__ import annotations

import html
import os
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

from dynsim.draw.page.content import packed
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.system.files import replacing

SCRIPTS = ("decode", "solids", "marks", "actor", "stage", "plots", "controls", "main")
"""Files of the page's program, in the order in which they are loaded."""
_THREE = ("jupyter_threejs_sage", "static/r130/three.min.js")


def page(records: Mapping[str, Record], *, ghost: bool = False, scripts: Sequence[str] = (), connect: str = "") -> str:
    """The page of one record, or of several beside each other.

    Parameters
    ----------
    records : by the names that the page shows
    ghost : several are laid over each other, the first one solid
    scripts : texts of further programs, which run after the page's own and find it as ``dynsim``
    connect : the one address that a page of a live drive may connect to; a page of records has none

    Raises
    ------
    RecordError
        There is nothing to be seen: no record with samples and a scene; or three.js is not installed.
    """
    data = packed(records, ghost=ghost)
    titles = (record.title.partition(" / ")[0] for record in records.values())
    title = next(filter(None, titles), "record")
    allowed = f"; connect-src {html.escape(connect)}" if connect else ""
    return _filled({"title": html.escape(title), "data": data, "connect": allowed}, scripts)


def write(records: Mapping[str, Record], path: str | os.PathLike[str], *, ghost: bool = False) -> Path:
    """Write the page of :func:`page` to a file: complete or not at all.

    Raises
    ------
    RecordError
        As :func:`page`, or the file cannot be written.
    """
    content = page(records, ghost=ghost).encode("utf-8", errors="replace")
    with replacing(Path(path)) as stream:
        stream.write(content)
    return Path(path)


def _filled(values: Mapping[str, str], scripts: Sequence[str]) -> str:
    own = resources.files("dynsim.draw.page").joinpath("page")
    style = own.joinpath("style.css").read_text(encoding="utf-8")
    program = "\n".join(own.joinpath(f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS)
    program = "\n".join([program, *scripts])
    parts = {"style": style, "three": _inline(three()), "program": _inline(program), **values}
    text = own.joinpath("page.html").read_text(encoding="utf-8")
    return re.sub(r"<!--\{(\w+)\}-->", lambda match: parts[match[1]], text)


def three() -> str:
    """The text of three.js, with its licence in its first lines.

    Raises
    ------
    RecordError
        The package is not installed.
    """
    package, file = _THREE
    try:
        return resources.files(package).joinpath(file).read_text(encoding="utf-8")
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise RecordError("to view records in 3D: pip install jupyter-threejs-sage") from error


def _inline(program: str) -> str:
    """As it may stand within a script element."""
    return re.sub(r"</(script)", r"<\\/\1", program, flags=re.IGNORECASE).replace("<!--", r"<\!--")
