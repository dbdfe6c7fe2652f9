"""Films of records, painted without display, graphics card or browser.

Record(s) → robots of :mod:`dynsim.draw.geometry.robot` → painted frames (:mod:`dynsim.draw.film.painter`) over a plot
(:mod:`dynsim.draw.film.film`) → file (:mod:`dynsim.draw.film.film`)
"""

from dynsim.draw.film.film import Film, write

__all__ = ["Film", "write"]
