"""Render records to a GIF or MP4 file; this does not require a display.

Records become robots (:mod:`dynsim.draw.geometry.robot`), robots become frames (:mod:`dynsim.draw.film.painter`), and
:mod:`dynsim.draw.film.film` adds a plot and writes the file.
"""

from dynsim.draw.film.film import Film, write

__all__ = ["Film", "write"]
