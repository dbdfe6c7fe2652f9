"""Fuzzing of all inputs: commands on damaged files must succeed or end with one clear error.

    inputs/      modules that draw cases of one or several kinds from a seed and an index
    mutations    random damage of trees, texts and bytes
    readings     content of an input, read independently, and its comparison with dynsim's objects
    worker       a child process that runs cases and judges them
    campaign     distributes cases to workers, and reports cases that hang or end their worker
    broken       deliberately broken loaders: the suite must detect them

``PYTHONPATH=.:tests python -m fuzz`` runs all cases, ``… -m fuzz --repeat urdf 17`` a single one.
"""
