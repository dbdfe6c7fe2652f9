"""Pages opened in a real browser without a network."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from dynsim.draw.page import write
from dynsim.record import Record

# A page is drawn without a graphics card here, on a machine that other tests keep busy.
PATIENCE_MS = 180_000


@dataclass
class Opened:
    """A page, what it asked for and what it complained about."""

    page: Any
    address: str
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def js(self, program: str, argument: object = None) -> Any:
        """The value of an expression in the page."""
        return self.page.evaluate(program, argument)

    def seek(self, instant: float) -> dict[str, Any]:
        """What the page shows at an instant."""
        return dict(self.js("t => { dynsim.seek(t); return dynsim.state(); }", instant))

    def until(self, program: str) -> None:
        """Wait until an expression holds; the page itself may not evaluate texts."""
        end = time.monotonic() + PATIENCE_MS / 1e3
        while not self.js(program):
            assert time.monotonic() < end, program
            self.page.wait_for_timeout(20)

    def state(self) -> dict[str, Any]:
        """What the page shows."""
        return dict(self.js("dynsim.state()"))


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[Callable[..., Opened]]:
    """Opens the page of records, the network being off; at the end nothing was asked for but the file itself."""
    pages: list[Opened] = []
    contexts: list[Any] = []

    def opens(
        records: Mapping[str, Record] | Path,
        *,
        size: tuple[int, int] = (1000, 700),
        ghost: bool = False,
        dark: bool = False,
    ) -> Opened:
        if isinstance(records, Path):
            path = records
        else:
            path = write(records, tmp_path / f"page_{len(pages)}.html", ghost=ghost)
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]}, offline=True, color_scheme="dark" if dark else "light"
        )
        context.set_default_timeout(PATIENCE_MS)
        contexts.append(context)
        page = context.new_page()
        entry = Opened(page, path.resolve().as_uri())
        pages.append(entry)
        page.on("request", lambda request: entry.requests.append(request.url))
        page.on("pageerror", lambda error: entry.complaints.append(str(error)))
        page.on("dialog", lambda dialog: entry.complaints.append(f"dialog: {dialog.message}"))
        page.on(
            "console",
            lambda message: entry.complaints.append(message.text) if message.type == "error" else None,
        )
        page.goto(entry.address)
        page.evaluate("dynsim.ready")
        return entry

    yield opens
    for entry in pages:
        assert [url for url in entry.requests if not url.startswith(("data:", "blob:"))] == [entry.address]
        assert entry.complaints == []
    for context in contexts:
        context.close()
