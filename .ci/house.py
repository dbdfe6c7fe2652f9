"""Size and shape of the package: lines of code, modules outside folders, import cycles, layer violations."""

from __future__ import annotations

import ast
import io
import sys
import tokenize
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "dynsim"
# Limits, to be lowered when the package shrinks.
LINES, MODULES = 56_500, 326
LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def code_lines(source: str) -> int:
    """Return the number of lines without blank lines, comments and docstrings."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            text = body[0].value
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                lines.difference_update(range(body[0].lineno, (body[0].end_lineno or 0) + 1))
    return len(lines)


def imports(modules: dict[str, Path]) -> dict[str, set[str]]:
    """Return the modules of the package that each module imports, also within functions and for types."""
    imported: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
                imported[name] |= {
                    imported_name if imported_name in modules else node.module for imported_name in names
                }
            elif isinstance(node, ast.Import):
                imported[name] |= {alias.name for alias in node.names}
        imported[name] &= modules.keys() - {name}
    return imported


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one module, by reachability."""
    reached: dict[str, set[str]] = {}
    for start in graph:
        seen, waiting = set[str](), [start]
        while waiting:
            new = graph[waiting.pop()] - seen
            seen |= new
            waiting += new
        reached[start] = seen
    parts = {frozenset(b for b in reached[a] if a in reached[b]) for a in graph if a in reached[a]}
    return [sorted(part) for part in parts]


def main() -> int:
    """Print the sizes; return 1 beyond a limit, or if there are import cycles or upward imports."""
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted(PACKAGE.rglob("*.py"))
    }
    lines = {name: code_lines(path.read_text(encoding="utf-8")) for name, path in modules.items()}
    graph = imports(modules)
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    height = {room.strip(): k for k, layer in enumerate(layers) for room in layer.split("|")}
    upward = [
        (module, other)
        for module, others in graph.items()
        for other in others
        if module != "dynsim" and other != "dynsim" and height.get(_room(module), -1) > height.get(_room(other), 99)
    ]
    loose = [path.name for path in PACKAGE.glob("*.py")]
    print(f"{sum(lines.values())} lines of code in {len(modules)} modules, {len(loose)} outside the folders")
    print(f"{len(circles(graph))} circles of imports, {len(upward)} imports upwards")
    for module in (*circles(graph), *upward):
        print(f"  {' '.join(module)}")
    for room in sorted({_room(name) for name in modules} - {"dynsim"}):
        size = sum(count for name, count in lines.items() if _room(name) == room)
        print(f"  {room.removeprefix('dynsim.'):12} {size:6}")
    large = sum(lines.values()) > LINES or len(modules) > MODULES
    if large:
        print(f"more than {LINES} lines or {MODULES} modules")
    return int(large or bool(circles(graph)) or bool(upward))


def _room(module: str) -> str:
    return ".".join(module.split(".")[:2])


if __name__ == "__main__":
    sys.exit(main())
