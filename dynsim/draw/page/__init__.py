"""Viewer pages: one HTML file with scene, data and program, for any browser, without a network.

    Record(s) → head and blocks (:mod:`dynsim.draw.page.content`) → text (:mod:`dynsim.draw.page.content`)

It depends on records alone: simulated and measured ones are shown in the same way.
"""

from dynsim.draw.page.content import Inline, page, show, viewable, write

__all__ = ["Inline", "page", "show", "viewable", "write"]
