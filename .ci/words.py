"""Words of docs, docstrings, comments, messages and help that a native reader would stumble over, against limits.

`python .ci/words.py` compares every folder with its limits: messages, help and public docstrings, and the first pages,
may have 1.5 such places per 1000 words; comments and private docstrings 5; all other texts the number that words.txt
lists and `--update` lowers. `--list PATH…` prints the places. The patterns find about half of the places that a reader
would find.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
KNOWN = Path(__file__).with_suffix(".txt")
FIRST_PAGES = {
    "README.md",
    "CONTRIBUTING.md",
    "docs/index.md",
    "docs/getting-started.md",
    "docs/limits.md",
    "docs/troubleshooting.md",
}
# Limits on places per 1000 words, by group of texts; texts of other groups are compared with words.txt.
PUBLIC, PRIVATE, OTHER = "public", "private", "other"
LIMITS = {PUBLIC: 1.5, PRIVATE: 5.0}
# A folder of few words may have this many places whatever its density.
ALLOWANCE = 1
GROUP_OF = {
    "message": PUBLIC,
    "help": PUBLIC,
    "public docstring": PUBLIC,
    "private docstring": PRIVATE,
    "comment": PRIVATE,
    "test name": OTHER,
    "page": OTHER,
}

VERB = (
    "(?:is|are|was|were|has|have|had|gives?|comes?|goes|go|makes?|keeps?|holds?|tells?|says?|knows?|lies|lie|moves?"
    "|leaves?|left|differs?|lacks?|needs?|takes?|touches|touched|stands?|turns?|cannot|can|could|may|must|would|others"
    "|nobody|somebody|no)"
)
# The beginning of a paragraph, item, cell or sentence.
START = r"(?:^|(?<=[.:;!?|] ))(?:[-*] |\| |# ?|\*\*)?"
ASKED = "see|know|show|shows|explain|explains|understand|describe|from|to|of"
NO_QUESTION = "".join(rf"(?<!\b{word} )" for word in ASKED.split("|"))
PATTERNS = {
    "what as a noun": (
        rf"{NO_QUESTION}\b[Ww]hat (?:it |they )?{VERB}\b(?![^.?]{{0,60}}\?)|\bof what\b|\bby what\b"
        r"|\bto what (?:is|it)\b"
    ),
    "that of": (
        r"\bis that of\b|\bare those of\b|\bthose (?:are|alone|that|with|in|which)\b|\bthe ones? (?:that|of)\b"
        r"|\bis that which\b|\bthat which\b|\bsuch as (?:is|are)\b|\bone of them alone\b"
        r"|\bothers (?:are|take|have|come)\b"
    ),
    "opens with of": (
        START + r"(?:Of|of) (?:a|an|the|those|that|all|some|one|each|what|which|its|their|other|several|two|such"
        r"|refused|long)\b"
    ),
    "is no": (
        r"(?<!here )(?<!ere )\b(?:is|are|was) no (?!longer|more|less|fewer|such|need|way|guarantee|reason|point|one\b)"
        r"[a-z]+|\b(?:is|are|has|have|was) none\b|\bthere (?:is|are) not\b|\bis nothing (?:that|of)\b|\bno such thing\b"
    ),
    "program as a person": (
        r"\b(?:is|are|was|were|be|being) told\b|\btold (?:of|so|by|otherwise)\b|\btells? (?:of|where|so|it)\b"
        r"|\bsays? (?:so|why|where|what|how|when|which|whether|of)\b|\b(?:nobody|somebody|anybody|whoever)\b"
        r"|\bheed\w*\b|\bhears?\b|\bheard\b(?! :)|\bspared\b|\bspeaks? with\b|\bbelieves?\b|\bin words\b|\bdeceives?\b"
    ),
    "verb of a dictionary": (
        r"\bgiv(?:es?|ing) way\b|\b(?:goes|go|went|gone) on\b|\bgoing on\b|\bcomes? to (?!mind|rest|terms|an? )"
        r"|\bcame to\b|\bbears?\b(?! in mind)|\bborne\b|\blaid\b|\bheld back\b|\bdrawn (?:over|to|into)\b"
        r"|\bstands? (?:still|where|as|ready)\b|\bput back\b|\btaken (?:along|in|anew|away)\b"
        r"|\bfalls? (?:slower|away)\b|\bdoes without\b|\bdo without\b"
    ),
    "where for if": (
        START + r"Where (?:a|an|it|its|no|none|nothing|there|they|one|two|that|this|events?|friction|all|joints?"
        r"|contacts?|some|the \w+ (?:is|are|moves|does|was))\b(?![^.]{0,80}\?)"
        r"|\balso where\b|\bwhere (?:need be|nothing|none|nobody|there is (?:no|none|one))\b"
        r"|\bas far as\b(?! (?:i|we|possible))|\bwhere it matters\b"
    ),
    "old word": (
        r"\bbeside\b|\banew\b|\balike\b|\bdearer\b|\baloft\b|\bshall\b|(?<=[.;] )[Ee]lse\b(?! if|:)|\bfor ever\b"
        r"|\bthereof\b|\bneed be\b|\bin full digits\b|\bupright ax|\boutermost\b|\bby themselves\b"
        r"|\bof (?:its|their|your|his|one's|an? \w+'s) own\b(?! accord)|\bonce more\b|\bto and fro\b|\bmost of all\b"
        r"|\bwithal\b|\bamid\b|\bthe moment at which\b"
    ),
    "take or give": (
        r"[;:,] (?:or )?(?:take|give|ask for|let|name) (?!the square|the mean|the next)(?:a|an|the|it|one|some|more"
        r"|less|other|this|another|auto|fewer|that|those)\b"
    ),
    "genitive without noun": (
        r"\b(?:the|its|their|that|a|an|this|own) [a-z]+(?:'s|s'|’s)(?=[.;,:)]| and | or | alone| too| is | are )"
        r"|\b(?:is|are) (?:the )?[a-z]+'s[.;,]|\b(?:is|are) (?:its|their) own[.;,]"
    ),
    "inversion": (
        START + r"(?:So (?:do|does|is|are|must)|Nor |To it |With it |Not (?:written|buffered|so|by|of|kept|to) "
        r"|Written are |Nothing (?:but|of|that)|Within, |Beyond it|Among them )"
        r"|\bsuch (?:is|are) the\b|\bof which (?:some|most|none|all)\b|\b(?:may|can|must) it be\b"
        r"|, (?:not|nor) (?:is|are|does|do)\b|\bas of no\b|\bthat there (?:was|is) not\b"
    ),
    "telegram": (
        START + r"(?:Fastest|Greatest|Least|Slowest|Dearest|Longest drive) ?[a-z]*|\bso many (?!of|that)[a-z]+"
        r"|\bat so \w+\b|\bas many\b(?! as)|\bhow(?:ever)? many\.|\bwith commas\b|\beach way\b"
        r"|\bby name\b(?! server)|\bat rest at\b|\bmore or less at\b|\ba row each\b|\ba \w+ each\b(?= of|;|,|\.)"
    ),
}
COMPILED = {name: re.compile(pattern, re.MULTILINE) for name, pattern in PATTERNS.items()}


class Text(NamedTuple):
    """A piece of prose: its kind, the line where it begins, and its words."""

    kind: str
    line: int
    prose: str


class Place(NamedTuple):
    """A place that a reader would stumble over."""

    path: Path
    line: int
    kind: str
    pattern: str
    excerpt: str


def joined(text: str) -> str:
    """Return text of the same length whose wrapped lines are joined by spaces, so that offsets still give lines."""
    return re.sub(r"\n(?=[ \t]*[^\s\-*#|>:0-9=~`])(?<!\n\n)", " ", text)


def _masked(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", "x", match.group())


def _blank(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", match.group())


def texts_of_page(source: str) -> Iterator[Text]:
    """Yield the prose of a Markdown page, without code, tables of numbers, links and comments."""
    source = re.sub(r"(?ms)^[ \t]*(```|~~~).*?^[ \t]*\1", _blank, source)
    source = re.sub(r"(?s)<!--.*?-->|`[^`\n]+`|\$\$.*?\$\$|<[a-zA-Z/][^>\n]*>", _masked, source)
    source = re.sub(r"\]\([^)\n]*\)", lambda match: "]" + " " * (len(match.group()) - 1), source)
    source = re.sub(r"(?m)^(?:\.\. [a-z-]+::.*|>>> .*|\.\.\. .*| {4,}\S.*|:::.*)$", _blank, source)
    yield Text("page", 1, joined(source))


def _literal(node: ast.AST) -> str | None:
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def _docstrings(node: ast.AST, public: bool) -> Iterator[tuple[ast.Constant, bool]]:
    """Yield docstrings below a node; public: neither the name nor one around it begins with an underscore."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            inside = public and not child.name.startswith("_")
            if ast.get_docstring(child, clean=False) is not None:
                yield child.body[0].value, inside  # type: ignore[attr-defined]
            # A function within a function is private.
            yield from _docstrings(child, inside and isinstance(child, ast.ClassDef))
        else:
            yield from _docstrings(child, public)


def texts_of_module(source: str) -> Iterator[Text]:
    """Yield docstrings, comments, messages, help texts and names of tests of a Python module."""
    tree = ast.parse(source)
    seen: set[int] = set()
    docstrings = list(_docstrings(tree, True))
    if ast.get_docstring(tree, clean=False) is not None:
        docstrings.insert(0, (tree.body[0].value, True))  # type: ignore[attr-defined]
    for constant, public in docstrings:
        seen.add(id(constant))
        text = re.sub(r"(?m)^[ \t]*(?:>>>|\.\.\.).*$", _blank, str(constant.value))
        text = re.sub(r"``[^`\n]+``|`[^`\n]+`", _masked, text)
        yield Text("public docstring" if public else "private docstring", constant.lineno, joined(text))
    for node in ast.walk(tree):
        name = getattr(node, "name", None)
        if isinstance(name, str) and name.startswith("test_"):
            yield Text("test name", node.lineno, name.removeprefix("test_").replace("_", " "))  # type: ignore[attr-defined]
        for keyword in getattr(node, "keywords", []):
            text_of_help = _literal(keyword.value)
            if keyword.arg in ("help", "epilog", "short_help", "description") and text_of_help:
                seen.add(id(keyword.value))
                yield Text("help", keyword.value.lineno, text_of_help)
        if isinstance(node, ast.JoinedStr):
            seen.update(id(part) for part in node.values)
        if isinstance(node, (ast.JoinedStr, ast.Constant)) and id(node) not in seen:
            message = _literal(node)
            if message and len(message.split()) > 3 and re.search(r"[a-z]{3,} [a-z]{2,}", message):
                yield Text("message", node.lineno, message)
    yield from _comments(source)


def _comments(source: str) -> Iterator[Text]:
    lines: dict[int, str] = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not re.match(r"# ?(?:type:|noqa|fmt:|pragma|!)", token.string):
            lines[token.start[0]] = token.string.lstrip("#: ")
    for number, comment in lines.items():
        if number - 1 not in lines:
            while number + comment.count("\n") + 1 in lines:
                comment += "\n" + lines[number + comment.count("\n") + 1]
            yield Text("comment", number, joined(comment))


class Count:
    """Words and places of the texts of some files, by folder and group."""

    def __init__(self) -> None:
        self.words: Counter[tuple[str, str]] = Counter()
        self.places: dict[tuple[str, str], list[Place]] = defaultdict(list)

    def add(self, path: Path) -> None:
        """Count the texts of one file."""
        source = path.read_text(encoding="utf-8")
        name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.as_posix()
        for text in texts_of_module(source) if path.suffix == ".py" else texts_of_page(source):
            group = GROUP_OF[text.kind]
            if name in FIRST_PAGES:
                group = PUBLIC
            elif not name.startswith("dynsim/"):
                group = OTHER
            key = (name if path.suffix == ".md" else name.rpartition("/")[0], group)
            self.words[key] += len(re.findall(r"[A-Za-z]{2,}", text.prose))
            for pattern, expression in COMPILED.items():
                for match in expression.finditer(text.prose):
                    line = text.line + text.prose.count("\n", 0, match.start())
                    if text.kind == "page":
                        line = source.count("\n", 0, match.start()) + 1
                    excerpt = text.prose[max(0, match.start() - 30) : match.end() + 40].replace("\n", " ").strip()
                    self.places[key].append(Place(path, line, text.kind, pattern, excerpt))


def files_of(paths: list[Path]) -> Iterator[Path]:
    """Yield the Python and Markdown files at or below some paths."""
    for path in paths:
        below = sorted(path.rglob("*")) if path.is_dir() else [path]
        yield from (file for file in below if file.suffix in (".md", ".py"))


def recorded() -> dict[str, int]:
    """Return the places of each folder or page that words.txt allows."""
    rows = (line.rsplit(" ", 1) for line in KNOWN.read_text(encoding="utf-8").splitlines())
    return {name: int(count) for name, count in rows}


def too_many(count: Count, known: dict[str, int]) -> list[str]:
    """Return one line for each folder or page with more places than its limit."""
    lines = []
    for (name, group), words in sorted(count.words.items()):
        number = len(count.places[name, group])
        if group == OTHER:
            if number > known.get(name, 0):
                lines.append(f"{name}: {number} places; before: {known.get(name, 0)}")
        elif number > max(ALLOWANCE, LIMITS[group] * words / 1000.0):
            limit = LIMITS[group]
            lines.append(f"{name} ({group}): {number} places in {words} words; at most {limit} per 1000 words")
    return lines


def main() -> int:
    """Print places or compare them with their limits; the exit code is 1 if there are too many."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", nargs="+", type=Path, metavar="PATH", help="print the places of files or folders")
    parser.add_argument("--update", action="store_true", help="write the places of all other texts to words.txt")
    options = parser.parse_args()
    count = Count()
    if options.list:
        for path in files_of([path.resolve() for path in options.list]):
            count.add(path)
        for item in sorted(item for places in count.places.values() for item in places):
            print(f"{item.path}:{item.line}: {item.kind}: {item.pattern}: …{item.excerpt}…")
        total, words = sum(map(len, count.places.values())), sum(count.words.values())
        print(f"{total} places in {words} words, {1000.0 * total / max(words, 1):.1f} per 1000")
        return 0
    folders = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "dynsim", "docs", "tests", ".ci", "results/README.md"]
    for path in files_of([ROOT / name for name in folders]):
        if "site" not in path.relative_to(ROOT).parts[1:2] or path.suffix == ".py":
            count.add(path)
    others = {name: len(count.places[name, group]) for name, group in count.words if group == OTHER}
    if options.update:
        KNOWN.write_text(
            "".join(f"{name} {others[name]}\n" for name in sorted(others) if others[name]), encoding="utf-8"
        )
    lines = too_many(count, recorded())
    print("\n".join(lines) if lines else "words: within the limits")
    if lines:
        print("see the places with: python .ci/words.py --list PATH")
    by_group: Counter[str] = Counter()
    words_of: Counter[str] = Counter()
    for (name, group), words in count.words.items():
        by_group[group] += len(count.places[name, group])
        words_of[group] += words
    for group in (PUBLIC, PRIVATE, OTHER):
        density = 1000.0 * by_group[group] / max(words_of[group], 1)
        print(f"  {group:8} {by_group[group]:5} places in {words_of[group]:6} words, {density:.1f} per 1000")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
