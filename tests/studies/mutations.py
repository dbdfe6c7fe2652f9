"""Mutation study: small errors put into kernel lines one at a time, and the fraction that tests detect.

``NUMBA_DISABLE_JIT=1 PYTHONPATH=tests python -m studies.mutations OUT.json`` draws lines of the kernels at random,
writes which tests reach each of them, then the result for each error. Kernels run as Python: an error is a code object
exchanged in a forked process, and nothing is compiled. Numbers: docs/dev/tried.md.
"""

from __future__ import annotations

import argparse
import ast
import builtins
import importlib
import json
import os
import random
import re
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import CodeType
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

FACTOR = 1.0 + 1e-4
# Processor time of a test with kernels as Python [s]; longer tests only show which lines they reach.
TEST_S = 2.5
# Time for all tests of one error [s]. A test that does not end is stopped after SLOWER times its usual time + MORE_S.
MISTAKE_S, SLOWER, MORE_S = 30.0, 8.0, 4.0
# Errors that no quick test detects: number of slower tests that are tried, and time for each [s].
LATE, LATE_S = 4, 25.0
# Largest number of parametrised examples of a test that are tried.
EXAMPLES = 3
FLIPPED: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
PROBE = "__mutation_probe__"


def kernels(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(d) for d in node.decorator_list):
            yield node


def mistakes(function: ast.FunctionDef) -> Iterator[tuple[str, ast.AST, Callable[[], None]]]:
    """Yield kind, node and modification of every possible error in a function."""
    indices = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Subscript):
            indices |= {id(inner) for inner in ast.walk(node.slice)}
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "range":
            indices |= {id(inner) for inner in node.args}
    for node in (inner for statement in function.body for inner in ast.walk(statement)):
        if isinstance(node, ast.Constant) and type(node.value) is float and node.value != 0.0:
            yield "constant", node, lambda node=node: setattr(node, "value", node.value * FACTOR)
        elif isinstance(node, ast.Constant) and type(node.value) is int and id(node) in indices:
            yield "index", node, lambda node=node: setattr(node, "value", node.value + 1)
        elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in FLIPPED:
            yield "sign", node, lambda node=node: setattr(node, "op", FLIPPED[type(node.op)]())
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield "sign", node, lambda node=node: setattr(node, "op", ast.UAdd())
        elif isinstance(node, ast.Compare) and type(node.ops[0]) in FLIPPED:
            yield "comparison", node, lambda node=node: node.ops.__setitem__(0, FLIPPED[type(node.ops[0])]())
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "range":
            last = ast.BinOp(node.args[-1], ast.Sub(), ast.Constant(1))
            yield "range", node, lambda node=node, last=last: node.args.__setitem__(-1, last)


def drawn(package: Path, rooms: list[str], lines: int, seed: int) -> list[dict[str, Any]]:
    """Draw lines of kernels, and one error for each, identified by its number within its function."""
    population: dict[tuple[str, str, int], dict[str, list[int]]] = {}
    for path in sorted(file for room in rooms for file in (package / room).rglob("*.py")):
        module = ".".join(path.relative_to(package.parent).with_suffix("").parts)
        for function in kernels(ast.parse(path.read_text("utf-8"))):
            for number, (kind, node, _) in enumerate(mistakes(function)):
                by_kind = population.setdefault((module, function.name, node.lineno), {})
                by_kind.setdefault(kind, []).append(number)
    rng = random.Random(seed)
    sample = []
    for module, function, line in rng.sample(sorted(population), lines):
        by_kind = population[module, function, line]
        kind = rng.choice(sorted(by_kind))
        number = rng.choice(by_kind[kind])
        sample.append({"module": module, "function": function, "line": line, "kind": kind, "number": number})
    print(f"{len(population)} lines of kernels can have a mistake; {lines} drawn", flush=True)
    return sample


def parsed(module: str) -> tuple[ast.Module, str]:
    path = str(importlib.import_module(module).__file__)
    return ast.parse(Path(path).read_text("utf-8")), path


def exchange(module: str, tree: ast.Module, path: str, name: str) -> None:
    """Replace a kernel, wherever it is imported, by its version in ``tree``."""
    code = compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True)
    new = next(part for part in code.co_consts if isinstance(part, CodeType) and part.co_name == name)
    vars(importlib.import_module(module))[name].__code__ = new


def make(mistake: dict[str, Any]) -> None:
    """Make the error in this process; record the original and the changed text in it."""
    tree, path = parsed(mistake["module"])
    function = next(f for f in kernels(tree) if f.name == mistake["function"])
    _, node, change = list(mistakes(function))[mistake["number"]]
    mistake["was"] = ast.unparse(node)
    change()
    mistake["is"] = ast.unparse(node)
    exchange(mistake["module"], tree, path, mistake["function"])


def watch(sample: list[dict[str, Any]]) -> set[int]:
    """Return the set of lines of the sample that are reached from now on, by number."""
    seen: set[int] = set()
    setattr(builtins, PROBE, seen.add)
    for module, name in sorted({(m["module"], m["function"]) for m in sample}):
        tree, path = parsed(module)
        function = next(f for f in kernels(tree) if f.name == name)
        everything = list(mistakes(function))
        holders = {
            id(inner): (body, statement)
            for owner in ast.walk(function)
            for body in (getattr(owner, "body", None), getattr(owner, "orelse", None))
            if isinstance(body, list)
            for statement in body
            for inner in ast.walk(statement)
        }
        probes = [
            (k, *holders[id(everything[m["number"]][1])])
            for k, m in enumerate(sample)
            if (m["module"], m["function"]) == (module, name)
        ]
        for k, body, statement in probes:
            probe = ast.parse(f"{PROBE}({k})").body[0]
            for inner in ast.walk(probe):
                ast.copy_location(inner, statement)
            body.insert(body.index(statement), probe)
        exchange(module, tree, path, name)
    return seen


def in_a_child(work: Callable[[Callable[[Any], None]], None]) -> list[Any]:
    """Run ``work`` in a forked process, which may end at any point, and return its messages."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receive)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        try:
            work(lambda value: os.write(send, json.dumps(value).encode() + b"\n") and None)
        finally:
            os._exit(0)
    os.close(send)
    with os.fdopen(receive) as lines:
        messages = [json.loads(line) for line in lines]
    os.waitpid(child, 0)
    return messages


def limit(seconds: float, tell: Callable[[], None]) -> None:
    """End this process after ``seconds`` of processor time or 20 times as much wall time; call ``tell`` before."""

    def end(*_: Any) -> None:
        tell()
        os._exit(0)

    for number in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(number, end)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.setitimer(signal.ITIMER_REAL, 20.0 * seconds)


def used_s() -> float:
    times = resource.getrusage(resource.RUSAGE_SELF)
    return times.ru_utime + times.ru_stime


def outcome(item: pytest.Item, following: pytest.Item | None) -> str:
    """Return passed, failed or skipped."""
    reports = runtestprotocol(item, log=False, nextitem=following)
    if any(report.failed for report in reports):
        return "failed"
    return "passed" if all(report.passed for report in reports) else "skipped"


class Study:
    """Plugin that replaces pytest's loop over the tests."""

    def __init__(self, out: Path, sample: list[dict[str, Any]]) -> None:
        self.out, self.drawn = out, sample

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        reach_file = self.out.with_suffix(".reach.json")
        if reach_file.exists():
            reach = json.loads(reach_file.read_text())
        else:
            reach = self.reach(session.items)
            reach_file.write_text(json.dumps(reach))
        items = {item.nodeid: item for item in session.items}
        results = json.loads(self.out.read_text()) if self.out.exists() else []
        for k in range(len(results), len(self.drawn)):
            results.append(self.judge(k, self.drawn[k], reach, items))
            self.write(results)
        for result in results:
            if not result["noticed"] and "longer" not in result:
                result["longer"] = self.look_longer(result, items)
                self.write(results)
        return True

    def write(self, results: list[dict[str, Any]]) -> None:
        self.out.write_text(json.dumps(results, indent=1))
        noticed = sum(bool(result["noticed"]) for result in results)
        print(f"{time.strftime('%H:%M:%S')} {len(results)} mistakes, {noticed} noticed", flush=True)

    def look_longer(self, result: dict[str, Any], items: dict[str, Any]) -> list[str]:
        """Run some late tests, first those whose names share words with the kernel, and return their outcomes."""
        words = {word for word in re.split("[._]", f"{result['module']}_{result['function']}") if len(word) > 3}
        families: dict[str, str] = {}
        for name in result["late"]:
            families.setdefault(name.split("[")[0], name)
        messages: list[str] = []
        for name in sorted(families.values(), key=lambda name: -sum(word in name for word in words))[:LATE]:

            def work(tell: Callable[[Any], None], name: str = name, mistaken: bool = True) -> None:
                if mistaken:
                    make(result)
                limit(LATE_S, lambda: tell("late"))
                tell(outcome(items[name], None))

            messages.append((in_a_child(work) or ["broken"])[-1])
            # Some fail as Python even without the error.
            if messages[-1] == "failed" and in_a_child(partial(work, mistaken=False)) == ["passed"]:
                result["noticed"] = [name, "fails"]
                break
        return messages

    def reach(self, items: list[pytest.Item]) -> dict[str, dict[str, Any]]:
        """Return for each test the lines of the sample that it reaches, its processor time [s] and outcome."""
        reach: dict[str, dict[str, Any]] = {}
        late: dict[str, int] = {}
        families: dict[str, list[pytest.Item]] = {}
        for item in items:
            families.setdefault(item.nodeid.split("[")[0], []).append(item)
        # The first, the last and some in between.
        items = [
            examples[k]
            for examples in families.values()
            for k in sorted({round(n * (len(examples) - 1) / (EXAMPLES - 1)) for n in range(EXAMPLES)})
        ]
        seen = watch(self.drawn)
        for count, item in enumerate(items):
            family = item.nodeid.split("[")[0]
            if late.get(family, 0) >= 2:  # its other examples take as long
                continue

            def work(tell: Callable[[Any], None], item: pytest.Item = item) -> None:
                start = used_s()
                limit(TEST_S, lambda: tell(["late", used_s() - start, sorted(seen)]))
                ended = outcome(item, None)
                tell([ended, used_s() - start, sorted(seen)])

            messages = in_a_child(work)
            ended, seconds, reached = messages[0] if messages else ("broken", 0.0, [])
            late[family] = late.get(family, 0) + (ended == "late")
            reach[item.nodeid] = {"outcome": ended, "s": seconds, "lines": reached}
            if count % 20 == 0:
                print(
                    f"{count}/{len(items)} {time.strftime('%H:%M:%S')} {item.nodeid} {ended} {seconds:.1f}", flush=True
                )
        return reach

    def judge(self, k: int, mistake: dict[str, Any], reach: dict[str, Any], items: dict[str, Any]) -> dict[str, Any]:
        """Return the error with its result: the test that detected it, or the number of tests that did not."""
        tests = sorted(
            (test["s"], name) for name, test in reach.items() if test["outcome"] == "passed" and k in test["lines"]
        )
        tests = [(seconds, name) for seconds, name in tests if name in items]

        def work(tell: Callable[[Any], None]) -> None:
            make(mistake)
            tell(["made", mistake["was"], mistake["is"]])
            total = 0.0
            for n, (seconds, name) in enumerate(tests):
                if total > MISTAKE_S:
                    break
                total += seconds
                limit(SLOWER * seconds + MORE_S, lambda name=name: tell(["noticed", name, "does not end"]))
                if outcome(items[name], items[tests[n + 1][1]] if n + 1 < len(tests) else None) == "failed":
                    tell(["noticed", name, "fails"])
                    return
                tell(["passed", name])

        messages = in_a_child(work)
        noticed = next((line for line in messages if line[0] == "noticed"), None)
        if not noticed and (not messages or not any(line[0] == "made" for line in messages)):
            noticed = ["noticed", "", "cannot be made"]
        made = next((line for line in messages if line[0] == "made"), ["", "", ""])
        late = [name for name, test in reach.items() if test["outcome"] == "late" and k in test["lines"]]
        return {
            **mistake,
            "was": made[1],
            "is": made[2],
            "tests": len(tests),
            "passed": sum(line[0] == "passed" for line in messages),
            "noticed": noticed and noticed[1:],
            "late": late,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--lines", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rooms", nargs="+", default=["dynamics", "integrators", "snake"])
    parser.add_argument("--tests", nargs="+", default=["tests/verification", "tests/oracle"])
    options = parser.parse_args()
    sys.setrecursionlimit(10_000)
    package = Path(str(importlib.import_module("dynsim").__file__)).parent
    sample = drawn(package, options.rooms, options.lines, options.seed)
    arguments = [
        "-o",
        "addopts=--import-mode=importlib",
        "-m",
        "not slow and not long",
        "-q",
        "-s",
        "-p",
        "no:cacheprovider",
    ]
    pytest.main([*arguments, *options.tests], plugins=[Study(options.out, sample)])


if __name__ == "__main__":
    main()
