"""``python -m studies.bench [--quick] [--json FILE]``: measure, print tables, and write a JSON file."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from dynsim.system.files import write_json
from studies.bench.run import run_bench
from studies.bench.table import format_table


def main() -> None:
    """Run the benchmarks that the command line selects."""
    parser = argparse.ArgumentParser(prog="python -m studies.bench", description="Benchmarks of dynsim and its peers.")
    parser.add_argument("--quick", action="store_true", help="fewer sizes and repetitions")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers to a JSON file")
    options = parser.parse_args()
    console = Console()
    with console.status("measuring") as status:
        result = run_bench(options.quick, status.update)
    for table in format_table(result):
        console.print(table)
    if options.json is not None:
        write_json(options.json, result)


if __name__ == "__main__":
    main()
