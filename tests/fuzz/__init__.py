"""Fuzzing of all inputs: commands on damaged files must succeed or end with one clear error.

    inputs/      one module per kind of input; each draws a case from a seed and an index
    mutations    what breaks trees, texts and bytes
    readings     what stands in an input, read independently, and what dynsim made of it
    worker       a child process that runs cases and judges them
    campaign     hands cases to workers, and names those that hang or end their worker
    broken       deliberately broken loaders: the suite must find them

``PYTHONPATH=.:tests python -m fuzz`` runs all of it, ``… -m fuzz --repeat urdf 17`` one case.
"""
