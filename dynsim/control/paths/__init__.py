"""Hand paths, one file each: ``Config`` with ``position(t)``, shape (T,) → (T, 3) [s → m]."""
