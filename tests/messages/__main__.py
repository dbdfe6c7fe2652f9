"""``python -m messages``: write the golden file of messages again."""

from messages import golden


def main() -> int:
    """Write the file; 1 if a message departs from the form that all of them have."""
    golden.write()
    count = sum(len(golden.cases(area)) for area in golden.areas())
    print(f"{count} messages written to {golden.FILE}; review the diff")
    for line in golden.drop_mended():
        print(f"in form now: {line}")
    new = [fault for area in golden.areas() for fault in golden.departures(area) if fault not in golden.allowed()]
    for line in new:
        print(f"not in form: {line}")
    return 1 if new else 0


if __name__ == "__main__":
    raise SystemExit(main())
