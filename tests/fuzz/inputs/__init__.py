"""One module per kind of input, each with ``draw(rng, records) -> Draft``."""
