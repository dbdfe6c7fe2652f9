"""Griffe extension that converts docstrings for the site."""

from __future__ import annotations

import re
from typing import Any

import griffe

_SECTION = re.compile(r"^\w+\n-+\n", flags=re.MULTILINE)
_SESSION = re.compile(r"(?:^(?:>>>|\.\.\.) .*\n?)+", flags=re.MULTILINE)
_ROLE = re.compile(r":\w+:`~?(?:[\w.]+\.)?([\w ]+)`")


class Plain(griffe.Extension):
    """Extension that converts roles to names, and sessions before the first section to code; griffe reads sections."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Convert the docstring of one object."""
        if obj.docstring is None:
            return
        text = _ROLE.sub(r"`\1`", obj.docstring.value).replace("``", "`")
        section = _SECTION.search(text)
        start = len(text) if section is None else section.start()
        head = _SESSION.sub(lambda match: f"```python\n{_code(match[0])}\n```\n", text[:start])
        obj.docstring.value = head + text[start:]


def _code(session: str) -> str:
    return "\n".join(line[4:] for line in session.rstrip().splitlines())
