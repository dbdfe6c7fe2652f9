"""One hypothesis profile for all tests: seeded, without deadlines (the first example compiles)."""

from hypothesis import settings

settings.register_profile("dynsim", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("dynsim")
