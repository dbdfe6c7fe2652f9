"""Records to look at: one page of HTML that holds scene, data and program, for any browser, without a network.

    Record(s) → head and blocks (:mod:`dynsim.view.content`) → text (:mod:`dynsim.view.html`)

It knows records and nothing of who made them: simulated and measured ones look the same.
"""

from dynsim.view.content import viewable
from dynsim.view.html import page, write
from dynsim.view.inline import Inline

__all__ = ["Inline", "page", "viewable", "write"]
