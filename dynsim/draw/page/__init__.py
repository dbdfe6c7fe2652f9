"""Write a self-contained HTML page that shows records in 3D.

The page contains the scene, data and program, and works in any browser without a network. It depends only on records:
simulated and measured records are shown in the same way. See :mod:`dynsim.draw.page.content`.
"""

from dynsim.draw.page.content import Inline, page, show, viewable, write

__all__ = ["Inline", "page", "show", "viewable", "write"]
