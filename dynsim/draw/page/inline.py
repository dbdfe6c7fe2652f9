"""A viewer page shown inside a notebook."""

from __future__ import annotations

import html
import os
from dataclasses import dataclass
from pathlib import Path

from dynsim.system.files import replacing


@dataclass(frozen=True)
class Inline:
    """A page that a notebook shows in a frame of its own, ``height`` pixels high; :meth:`save` writes it to a file."""

    page: str
    height: int = 640

    def _repr_html_(self) -> str:
        # Scripts run, but not with the rights of the notebook.
        return (
            f'<iframe sandbox="allow-scripts allow-downloads" srcdoc="{html.escape(self.page)}" '
            f'style="width:100%;height:{int(self.height)}px;border:0" title="dynsim"></iframe>'
        )

    def __repr__(self) -> str:
        return f"<page of {len(self.page) / 1e6:.2f} MB; save(FILE) writes it>"

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file.

        Raises
        ------
        RecordError
            The file cannot be written.
        """
        with replacing(Path(path)) as stream:
            stream.write(self.page.encode("utf-8", errors="replace"))
        return Path(path)
