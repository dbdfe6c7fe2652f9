"""Random mutations of inputs: trees of keys and values, texts, bytes, drawn from a ``random.Random``."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Collection
from functools import cache
from random import Random
from typing import Any


class Raw(str):
    """Value written verbatim into a YAML text."""

    __slots__ = ()


NUMBERS = (
    0, 1, -1, 2, 3, 7, 10, 100, -100, 255, 4096, 0.5, -0.5, 1e-3, 1e-9, 1e-300, 5e-324, 1e9, 1e18, -1e18, 1e300, 1e308,
    10**6, 2**31, 2**63, -(2**63) - 1, 2**64, 10**30, -0.0, 0.1, 9.81, 1e-12, 45, 90, 360,
)  # fmt: skip
TEXTS = (
    "", " ", "x", "0", "1", "-1", "1e-3", "1_9.2", "1 2", "1,5", "²", "１２", "٣", "1.0.0", "nan", "inf", "-inf", "yes",
    "no", "null", "~", "true", "None", "floor", "link_4", "joint_1", "z", "dc", "plane", "..", ".", "/", "a/b",
    "a\\b", "\t", "a\nb", "a\r\nb", "[red]x[/red]", "[/]", "[bold", ":b:", "\x1b[31mred", "\x07", "\x00", "\x85",
    "\u2028", "\ufeff", "é", "e\u0301", "🤖", "\U0010ffff", "x" * 300, "ä" * 200, "%s%d{}{0}", "${HOME}", "-",
    "--help", "=", "<<", "*", "&a", "!t",
)  # fmt: skip
RAW = tuple(
    map(
        Raw,
        (
            ".nan", ".inf", "-.inf", ".NaN", "._", "_", "1_000", "0x1F", "0o17", "0b11", "017", "1:30", "1e", "+1",
            "1.", ".5", "1e400", "-1e400", "9" * 400, "9" * 5000, "0." + "3" * 5000, "1e99999999999", "2001-01-01",
            "2001-13-45", "2001-01-01T25:61:61Z", "2001-12-14t21:59:43.10-05:00", "2001-01-01 00:00:00 +99:99",
            "0000-00-00", "!!int x", "!!int ''", "!!float x", "!!float ''", "!!bool x", "!!bool 3", "!!null x",
            "!!timestamp x", "!!binary '***'", "!!binary aGk=", "!!set {a, b}", "!!omap [a: 1, a: 2]",
            "!!pairs [a: 1]", "!!str 5", "!!seq {a: 1}", "!!map [1]", "!!merge x",
            "!!python/object/apply:os.getcwd []", "!foo 1", "!foo {a: 1}", "! 1", "!<tag:x> 1", "!<> 1", "!e!x 1",
            "*nowhere", "&a 1", "&a [*a]", "&a {b: *a}", "&a {<<: *a}", "{<<: [*a]}", "{<<: 1}", "{<<: {mass_kg: 1}}",
            "{<<: [{x: 1}, 2]}", "&a [1, &b [*a, *b]]", "{? [1, 2] : 3}", "{? {a: 1} : 2}", "{1: 2, '1': 3}",
            "{null: 1}", "{true: 1}", "{1.5: 1}", "{a: 1, a: 2}", "[,]", "[1,", "{a", "}", "]", "@x", "`x`", "%x",
            "|", ">", "|+9\n  x", "'", '"', '"\\x"', '"\\ud800"', '"\\uD83D"', '"\\0"', '"\\x00"', '"\\x1b[31m"',
            "# comment", "---", "...", "? x", ": x", "- x", "a: b: c", "~", "Null", "yes", "on", "[" * 50 + "]" * 50,
            "[" * 3000, "[" * 3000 + "]" * 3000, "{a: " * 1500 + "1" + "}" * 1500, "- " * 400 + "1",
            # A billion values with aliases expanded; and a text that is merely long.
            "{a0: &a0 [1], " + ", ".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)) + "}",
            "[" + "0.5, " * 300_000 + "]",
        ),
    )
)  # fmt: skip
SPECIAL_BYTES = b'\x00\t\n\r\x1b "&*-.:<[_{\x7f\x80\xc3\xff'


def value(rng: Random, old: Any = None) -> Any:
    """Return a replacement for ``old``: often similar, sometimes of a different kind."""
    if is_number(old) and rng.random() < 0.35:
        return near(rng, old)
    choice = rng.random()
    if choice < 0.3:
        return rng.choice(NUMBERS)
    if choice < 0.5:
        return rng.choice(TEXTS)
    if choice < 0.85:
        return rng.choice(RAW)
    return copy.deepcopy(
        rng.choice(
            (
                None,
                True,
                False,
                [],
                {},
                [[]],
                [1, 2, 3],
                [None],
                [0.0] * 6,
                ["x"],
                {"type": "x"},
                {"a": {"b": 1}},
                [[1], 2],
            )
        )
    )


def is_number(old: Any) -> bool:
    """True for a number that is not a flag."""
    return isinstance(old, (int, float)) and not isinstance(old, bool)


def near(rng: Random, number: float) -> Any:
    """Return a different number, or the same number as text."""
    ways = (
        lambda x: x * 1.01, lambda x: x * 1.5, lambda x: x + 1, lambda x: -x, lambda x: x * 1e6, lambda x: x * 1e-6,
        str,
    )  # fmt: skip
    return rng.choice(ways)(number)


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all nodes in a tree of mappings and lists, from the top down."""
    below: list[tuple[Any, ...]] = []
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, item in items:
        below += [(*path, key), *places(item, (*path, key))]
    return below


def at(tree: Any, path: tuple[Any, ...]) -> Any:
    """Return the node at a path."""
    for key in path:
        tree = tree[key]
    return tree


def mutate_tree(rng: Random, tree: Any) -> str:
    """Damage one place of a tree; return a description."""
    if not (candidates := places(tree)):
        return "nothing left"
    if rng.random() < 0.25:
        candidates = [path for path in candidates if is_number(at(tree, path))] or candidates
        path = rng.choice(candidates)
        if is_number(old := at(tree, path)):
            at(tree, path[:-1])[path[-1]] = new = near(rng, old)
            return f"{'.'.join(map(str, path))} = {new!r}"
    path = rng.choice(candidates)
    owner, key = at(tree, path[:-1]), path[-1]
    dotted = ".".join(map(str, path))
    choice = rng.random()
    if choice < 0.5:
        owner[key] = value(rng, owner[key])
        return f"{dotted} = {str(owner[key])[:60]!r}"
    if choice < 0.65:
        del owner[key]
        return f"without {dotted}"
    if isinstance(owner, dict):
        if choice < 0.75:
            new = rng.choice((f"{key}x", str(key)[:-1], str(key).upper(), rng.choice(TEXTS), Raw(rng.choice(RAW))))
            kept = [(new if name == key else name, item) for name, item in owner.items()]
            owner.clear()
            owner.update(kept)
            return f"{dotted} renamed to {new[:60]!r}"
        if choice < 0.85:
            new = rng.choice((*TEXTS, "type", "count", "file", "mass_kg", "friction"))
            owner[new] = value(rng)
            return f"{dotted} gets the neighbour {new[:60]!r}: {str(owner[new])[:60]!r}"
    elif choice < 0.85:
        change = rng.choice(("longer", "much longer", "shorter", "reversed"))
        if change == "longer":
            owner.insert(key, copy.deepcopy(owner[key]))
        elif change == "much longer":
            owner.extend(copy.deepcopy(owner) * rng.choice((10, 100, 1000)))
            # Trees of more than some ten thousand values only take time.
            del owner[20_000:]
        elif change == "shorter":
            del owner[key:]
        else:
            owner.reverse()
        return f"{dotted}: its list {change}"
    other = rng.choice(candidates)
    owner[key] = copy.deepcopy(at(tree, other))
    return f"{dotted} = what stands at {'.'.join(map(str, other))}"


def yaml_text(tree: Any, indent: str = "") -> str:
    """Return block YAML of a tree, one key per line, with :class:`Raw` verbatim."""
    if isinstance(tree, dict) and tree:
        return "".join(
            f"{indent}{_flow(key)}:"
            + (f"\n{yaml_text(item, indent + '  ')}" if isinstance(item, dict) and item else f" {_flow(item)}\n")
            for key, item in tree.items()
        )
    return f"{indent}{_flow(tree)}\n"


def _flow(tree: Any) -> str:
    if isinstance(tree, Raw):
        return str(tree)
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(item)}" for key, item in tree.items()) + "}"
    if isinstance(tree, list):
        return "[" + ", ".join(map(_flow, tree)) + "]"
    if (
        isinstance(tree, str)
        and tree.isidentifier()
        and tree.lower() not in ("null", "true", "false", "yes", "no", "on", "off", "y", "n")
    ):
        return tree
    return json.dumps(tree, ensure_ascii=False)


def mutate_bytes(rng: Random, data: bytes) -> tuple[bytes, str]:
    """Damage a file without knowledge of its format."""
    out = bytearray(data)
    where = rng.randrange(len(out)) if out else 0
    ways: dict[str, Callable[[], None]] = {
        "a bit flipped": lambda: out.__setitem__(where, out[where] ^ (1 << rng.randrange(8))),
        "a byte replaced": lambda: out.__setitem__(where, rng.choice(SPECIAL_BYTES)),
        "a byte inserted": lambda: out.insert(where, rng.choice(SPECIAL_BYTES)),
        "bytes removed": lambda: out.__delitem__(slice(where, where + rng.choice((1, 2, 8, 100)))),
        "truncated": lambda: out.__delitem__(slice(where, None)),
        "a stretch of random bytes": lambda: out.__setitem__(slice(where, where + 8), rng.randbytes(8)),
        "a stretch of zeros": lambda: out.__setitem__(slice(where, where + 64), bytes(len(out[where : where + 64]))),
        "a stretch doubled": lambda: out.__setitem__(slice(where, where), out[where : where + 200]),
        "bytes appended": lambda: out.extend(rng.randbytes(16)),
    }
    kind = rng.choice(list(ways))
    if not out:
        return bytes(out), "empty"
    ways[kind]()
    return bytes(out), f"{kind} at {where}"


def mutate_text(rng: Random, text: str) -> tuple[bytes, str]:
    """Damage a text file: its lines, its words or its encoding."""
    lines = text.splitlines(keepends=True) or [""]
    row = rng.randrange(len(lines))
    line = lines[row]
    choice = rng.randrange(15)
    if choice == 0:
        lines[row] = "\t" + line
    elif choice == 1:
        lines[row] = rng.choice((" ", "   ", "  ")) + line
    elif choice == 2:
        lines[row] = line.lstrip()
    elif choice == 3:
        lines.insert(row, line)
    elif choice == 4:
        del lines[row]
    elif choice == 5:
        other = rng.randrange(len(lines))
        lines[row], lines[other] = lines[other], line
    elif choice == 6:
        lines[row] = line.rstrip("\n") + rng.choice(TEXTS) + "\n"
    elif choice == 7:
        column = rng.randrange(len(line) + 1)
        lines[row] = line[:column] + rng.choice((*TEXTS, *RAW)) + line[column:]
    elif choice == 8:
        old, new = rng.choice(
            (
                (":", ""),
                (":", "::"),
                ("{", "["),
                ("}", ""),
                ("]", ""),
                (",", ""),
                ("-", "–"),
                (".", ","),
                ('"', "'"),
                (" ", "\u00a0"),
            )
        )
        lines[row] = line.replace(old, new)
    elif choice == 9:
        words = _numbers_in(line)
        if words:
            lines[row] = line.replace(rng.choice(words), str(rng.choice((*NUMBERS, *TEXTS, *RAW))), 1)
    elif choice == 10:
        return "".join(lines)[: rng.randrange(len(text) + 1)].encode(), "text truncated"
    elif choice == 11:
        encoding = rng.choice(("utf-8-sig", "utf-16", "utf-32", "latin-1", "cp037"))
        return text.encode(encoding, "replace"), f"encoded as {encoding}"
    elif choice == 12:
        end = rng.choice(("\r\n", "\r", "\n\n", "\x85", "\u2028"))
        return text.replace("\n", end).encode(), f"lines end with {end!r}"
    elif choice == 13:
        data, mutation = mutate_bytes(rng, text.encode())
        return data, mutation
    else:
        return (text + rng.choice(("\n---\n", "\n...\n", "\n%YAML 1.1\n---\n", "\x00", text))).encode(
            "utf-8", "replace"
        ), "appended"
    return "".join(lines).encode("utf-8", "surrogatepass"), f"line {row + 1} changed (way {choice})"


def _numbers_in(line: str) -> list[str]:
    words = "".join(sign if sign.isalnum() or sign in "+-._" else " " for sign in line).split()
    return [word for word in words if any(sign.isdigit() for sign in word)]


@cache
def options() -> dict[str, tuple[Any, ...]]:
    """Return the choices of every scenario key that is an enumeration, by the name of the key."""
    from dynsim.scenario.reading import json_schema

    known: dict[str, tuple[Any, ...]] = {}

    def walk(node: Any) -> None:
        for name, item in node.get("properties", {}).items() if isinstance(node, dict) else ():
            for choice in (item, *item.get("anyOf", ()), item.get("items", {})) if isinstance(item, dict) else ():
                if "enum" in choice and name != "type":
                    known[name] = tuple(dict.fromkeys((*known.get(name, ()), *choice["enum"])))
        for item in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
            walk(item)

    walk(json_schema())
    return known


def scaled(rng: Random, number: float) -> float:
    """Return a number of similar size: usually times 0.5 to 2, sometimes by powers of ten or with the other sign."""
    if isinstance(number, int) and rng.random() < 0.5:
        return max(0, number + rng.choice((-1, 1, 2)))
    factor = rng.uniform(0.5, 2.0) if rng.random() < 0.75 else rng.choice((0.1, 0.01, 10.0, 100.0, -1.0, 0.0))
    return float(f"{factor * number:.6g}") if number else rng.choice((0.0, 0.01, 0.1))


def vary(rng: Random, tree: Any, fixed: Collection[str] = ("duration_s", "rate_hz", "count", "joints")) -> str:
    """Change one value of a tree to one that is probably valid; return its dotted key, or "" without such a value.

    ``fixed`` are keys whose values do not change.
    """
    chosen = []
    for path in places(tree):
        old, name = at(tree, path), next((key for key in reversed(path) if isinstance(key, str)), "")
        if not set(path) & set(fixed) and (
            isinstance(old, bool) or is_number(old) or (isinstance(old, str) and name in options())
        ):
            chosen.append((path, old, name))
    # A list of numbers counts as often as a single number.
    weights = [1.0 / (len(at(tree, path[:-1])) if isinstance(path[-1], int) else 1) for path, _, _ in chosen]
    if not chosen:
        return ""
    path, old, name = rng.choices(chosen, weights)[0]
    if isinstance(old, bool):
        new: Any = not old
    elif is_number(old):
        new = scaled(rng, old)
    else:
        new = rng.choice(options()[name])
    at(tree, path[:-1])[path[-1]] = new
    return ".".join(map(str, path))


def mutate_blocks(rng: Random, data: bytes) -> tuple[bytes, str]:
    """Damage large parts of a file: blocks overwritten, moved, doubled or removed."""
    out, done = bytearray(data), []
    for _ in range(rng.choice((1, 2, 5))):
        size = max(1, int(len(out) * rng.choice((0.0002, 0.001, 0.01, 0.1, 0.3))))
        start, other = (rng.randrange(max(1, len(out) - size)) for _ in range(2))
        block = bytes(out[start : start + size])
        kind = rng.choice(("random", "zeros", "ones", "copied", "removed", "doubled", "shuffled", "truncated"))
        if kind in ("random", "zeros", "ones"):
            byte = {"zeros": b"\0", "ones": b"\xff"}.get(kind)
            out[start : start + size] = rng.randbytes(len(block)) if byte is None else byte * len(block)
        elif kind == "copied":
            out[other : other + size] = block
        elif kind == "doubled":
            out[start:start] = block
        elif kind == "shuffled":
            out[start : start + size] = bytes(rng.sample(block, len(block)))
        else:
            del out[start : start + size if kind == "removed" else None]
        done.append(f"{size} bytes {kind} at {start}")
    return bytes(out), "; ".join(done)
