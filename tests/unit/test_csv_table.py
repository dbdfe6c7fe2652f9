"""CSV text: cells that a spreadsheet would compute, missing values, and numbers."""

from __future__ import annotations

import csv
import io

from dynsim.record.csv_rows import csv_table


def test_texts_that_look_like_formulas_get_an_apostrophe() -> None:
    texts = ["=1+1", "+A1", "-A1", "@SUM(A1)", "\t=1"]
    harmless = ["-1.5", "+2e-3", "a=1", "", "1-2"]
    names = ["=name", "value"]
    rows = [{"=name": text, "value": -0.5} for text in (*texts, *harmless)] + [{"value": 1e-300}]
    header, *lines = list(csv.reader(io.StringIO(csv_table(names, rows), newline="")))
    assert header == ["'=name", "value"]
    assert [line[0] for line in lines] == [*(f"'{text}" for text in texts), *harmless, ""]
    assert [float(line[1]) for line in lines] == [-0.5] * (len(rows) - 1) + [1e-300]
