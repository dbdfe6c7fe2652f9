"""Griffe extension that converts docstrings for the site."""

from __future__ import annotations

import re
from typing import Any

import griffe

_SECTION = re.compile(r"^(Parameters|Attributes|Returns|Raises)\n-+\n", flags=re.MULTILINE)
_ENTRY = re.compile(r"^(\*{0,2}\w[\w, ]*) : (.*)$", flags=re.MULTILINE)
_SESSION = re.compile(r"(?:^(?:>>>|\.\.\.) .*\n?)+", flags=re.MULTILINE)
_ROLE = re.compile(r":\w+:`~?(?:[\w.]+\.)?([\w ]+)`")


class Plain(griffe.Extension):
    """Converts sections, sessions and roles in docstrings to Markdown."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Treat the text after a parameter's colon as a sentence, not a type; sessions as code; roles as names."""
        if obj.docstring is None:
            return
        text = _ROLE.sub(r"`\1`", obj.docstring.value).replace("``", "`")
        parts = _SECTION.split(text)
        # Names of sections alternate with their texts.
        sections = [f"{name}\n{'-' * len(name)}\n{_ENTRY.sub(_sentence, body)}" for name, body in _pairs(parts[1:])]
        head = _SESSION.sub(lambda match: f"```python\n{_code(match[0])}\n```\n", parts[0])
        obj.docstring.value = "".join([head, *sections])


def _pairs(parts: list[str]) -> list[tuple[str, str]]:
    return list(zip(parts[::2], parts[1::2], strict=True))


def _sentence(match: re.Match[str]) -> str:
    return f"{match[1]}\n    {match[2]}"


def _code(session: str) -> str:
    return "\n".join(line[4:] for line in session.rstrip().splitlines())
