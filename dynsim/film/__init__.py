"""Films of records: without display, graphics card or browser.

Record(s) → robots of :mod:`dynsim.view.robot` → painted frames (:mod:`dynsim.film.painter`) over a plot
(:mod:`dynsim.film.strip`) → file (:mod:`dynsim.film.encode`)
"""

from dynsim.film.film import Film, write

__all__ = ["Film", "write"]
