"""Outcomes for robot files of makers: reading, corrections, agreement with Pinocchio, a fall of 0.3 s."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from pathlib import Path

from support.robot_files import outcomes

import dynsim


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder in which the packages are installed")
    parser.add_argument("--json", type=Path, required=True, help="file for the outcomes")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        results = dict(outcomes(options.folder, Path(made)))
    lines = [f"{json.dumps(name)}: {json.dumps(result)}" for name, result in results.items()]
    head = f'{{"version": {json.dumps(dynsim.__version__)}, "files": {{\n'
    options.json.write_text(head + ",\n".join(lines) + "\n}}\n", encoding="utf-8")
    for (read, motion), count in Counter((r["read"], r.get("motion", "")) for r in results.values()).most_common():
        print(f"{count:4} {read}; {motion}")


if __name__ == "__main__":
    main()
