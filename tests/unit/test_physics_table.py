"""Table of equations in docs/theory/equations.md: it names every equation of [WM], and functions that exist."""

import importlib.util
import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "theory" / "equations.md"
EQUATIONS = 56  # of the paper, the last is the voltage law


def rows() -> list[tuple[str, str]]:
    """(equation, function) of the table of equations."""
    cells = [
        [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in PAGE.read_text(encoding="utf-8").splitlines()
        if line.startswith(("| [WM]", "| –"))
    ]
    return [(row[0], row[2]) for row in cells]


def equations(cell: str) -> set[int]:
    numbers: set[int] = set()
    for first, last in re.findall(r"(\d+)(?:–(\d+))?", cell):
        numbers |= set(range(int(first), int(last or first) + 1))
    return numbers


def test_every_equation_of_the_paper_is_named():
    named = set().union(*(equations(equation) for equation, _ in rows() if equation.startswith("[WM]")))
    assert named == set(range(1, EQUATIONS + 1))


def test_every_row_names_a_function_that_exists_or_says_why_there_is_none():
    for equation, function in rows():
        names = re.findall(r"`([a-z_]+(?:\.\w+)+)`", function)
        assert names or re.match(r"not in dynsim: \w+", function), equation
        for name in names:
            # The last parts are attributes: a function, or a method of a class.
            parts = ["dynsim", *name.split(".")]
            split = next(k for k in range(len(parts), 0, -1) if _is_module(".".join(parts[:k])))
            thing = importlib.import_module(".".join(parts[:split]))
            assert split < len(parts), f"{equation}: {name} is a module, not a function"
            for part in parts[split:]:
                assert hasattr(thing, part), f"{equation}: {name}"
                thing = getattr(thing, part)
            thing = thing.fget if isinstance(thing, property) else thing
            assert callable(thing), f"{equation}: {name}"


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False
