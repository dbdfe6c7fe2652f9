"""The examples in docstrings of the public interface run and print the output shown."""

from __future__ import annotations

import doctest
import inspect
from collections.abc import Iterator
from typing import Any

import pytest

import dynsim

NAMES = [name for name in dynsim.__all__ if not name.startswith("_")]


def public_parts(name: str) -> Iterator[tuple[str, Any]]:
    """Yield a public object, then methods of a class or functions of a module, with dotted names."""
    thing = getattr(dynsim, name)
    yield name, thing
    if inspect.isclass(thing):
        members = {key: inspect.unwrap(getattr(value, "__func__", value)) for key, value in vars(thing).items()}
    elif inspect.ismodule(thing):
        members = {key: value for key, value in vars(thing).items() if key in getattr(thing, "__all__", ())}
    else:
        members = {}
    for key, member in members.items():
        if not key.startswith("_") and (inspect.isroutine(member) or isinstance(member, property)):
            yield f"{name}.{key}", member


def examples(name: str) -> list[doctest.DocTest]:
    """The examples in the docstrings of a public object, one entry per docstring."""
    parser = doctest.DocTestParser()
    parts = ((dotted, inspect.getdoc(part) or "") for dotted, part in public_parts(name))
    tests = [parser.get_doctest(text, {}, dotted, None, None) for dotted, text in parts]
    return [test for test in tests if test.examples]


def failures(tests: list[doctest.DocTest]) -> str:
    """The report of the examples that fail."""
    output: list[str] = []
    runner = doctest.DocTestRunner(verbose=False)
    for test in tests:
        runner.run(test, out=output.append)
    return "".join(output)


def test_public_names_have_self_contained_examples() -> None:
    starts = {name: [test.examples[0].source for test in examples(name)] for name in NAMES}
    assert [name for name in NAMES if not any(source.startswith("import") for source in starts[name])] == []


@pytest.mark.parametrize("name", NAMES)
def test_examples_run(name: str) -> None:
    assert failures(examples(name)) == ""


@pytest.mark.parametrize("name", ["Model", "Simulation", "State"])
def test_public_methods_have_examples(name: str) -> None:
    methods = {dotted for dotted, part in public_parts(name) if not isinstance(part, property)}
    assert methods == {test.name for test in examples(name)}


def test_example_of_the_package_runs() -> None:
    assert failures([doctest.DocTestParser().get_doctest(dynsim.__doc__ or "", {}, "dynsim", None, None)]) == ""
