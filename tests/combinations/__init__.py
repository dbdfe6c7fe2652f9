"""Every feature together with every other: seeded scenes that cover each pair of factor levels, run by every method.

    factors      the factors and their levels, and incompatible levels
    covering     few assignments of levels that contain each pair, or each triple
    known        combinations that were wrong once
    scenes       the scenario of an assignment
    plants       their robots
    drives       their motors and controllers
    running      a scene run with a method, in one of several ways
    checks       properties of every record, and agreement between the records of a scene
    verdicts     truth of warnings and stops
    study        many scenes, counted by factor

``PYTHONPATH=.:tests python -m combinations --seed 1 --count 100`` runs scenes that are not in the tests.
"""
