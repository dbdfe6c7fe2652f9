"""Command line of the fuzzer: all cases of a seed, or one of them."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from fuzz import campaign
from fuzz.case import KINDS, draw, put
from fuzz.inputs.record import make_records


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=campaign.SEED)
    parser.add_argument("--count", type=int, default=6000, help="inputs, spread over all kinds")
    parser.add_argument("--kind", choices=KINDS, help="only inputs of this kind")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="worker processes")
    parser.add_argument("--limit", type=float, default=campaign.LIMIT, help="of one command [s]")
    parser.add_argument("--repeat", nargs=2, metavar=("KIND", "INDEX"), help="one case again")
    parser.add_argument("--keep", type=Path, help="with --repeat: write the files of the case to this folder")
    parser.add_argument(
        "--journal", type=Path, help="file of results: results are added, and cases in it that did not fail are skipped"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fuzz-records-") as folder:
        records = Path(folder)
        make_records(records)
        if options.repeat:
            kind, index = options.repeat[0], int(options.repeat[1])
            case = draw(kind, options.seed, index, records)
            print(case.what, *(f"dynsim {' '.join(command)}" for command in case.commands), sep="\n")
            for name, data in case.files.items() if options.keep else ():
                put(options.keep / name, data)
            cases = [(kind, index)]
        elif options.kind:
            cases = [(options.kind, index) for index in range(options.count)]
        else:
            cases = campaign.spread(options.count)
        done = campaign.read(options.journal) if options.journal and options.journal.exists() else []
        known = {(result.seed, result.kind, result.index) for result in done if not result.failed}
        cases = [case for case in cases if (options.seed, *case) not in known]

        def end(*_: object) -> None:
            print(campaign.table(done) if done else "nothing was done", flush=True)
            os._exit(130)

        signal.signal(signal.SIGINT, end)

        def report(result: campaign.Result) -> None:
            done.append(result)
            if options.journal:
                with options.journal.open("a", encoding="utf-8") as stream:
                    stream.write(f"{json.dumps(asdict(result))}\n")
            if result.failed:
                print(result, file=sys.stderr, flush=True)
            if sys.stderr.isatty() and len(done) % 20 == 0:
                print(f"\r{len(done)} of {len(cases)}", end="", file=sys.stderr, flush=True)

        campaign.run(
            cases,
            records=records,
            seed=options.seed,
            jobs=max(1, min(options.jobs, len(cases))),
            limit=options.limit,
            report=report,
        )
    print(campaign.failures(done))
    print(campaign.table(done))
    if options.repeat and not done[0].failed:
        print(done[0].ended.detail)
    return 1 if any(result.failed for result in done) else 0


if __name__ == "__main__":
    sys.exit(main())
