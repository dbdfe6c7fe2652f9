"""Damaged inputs of every kind: each succeeds or ends with one clear error, and nothing is lost."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fuzz import campaign
from fuzz.case import KINDS, draw

pytestmark = pytest.mark.long

# Cases of each kind in the long tests.
QUICK = 6
ALL = 6000
# Cases that have detected a defect: seed, kind, number.
ONCE = (
    (7_700_000, "record", 793),
    (7_700_000, "sweep", 1443),
    (9_100_000, "servo_map", 440),
    (9_100_000, "scenario", 816),
    (1_234_567, "urdf", 1832),
)


def check(results: list[campaign.Result], count: int) -> None:
    print(campaign.table(results))
    assert len(results) == count
    assert not any(result.failed for result in results), f"\n{campaign.failures(results)}\n{campaign.table(results)}"


def test_a_sample_of_broken_inputs(records: Path) -> None:
    cases = [(kind, index) for kind in KINDS for index in range(QUICK)]
    results = campaign.run(cases, records=records)
    check(results, len(cases))
    assert sum(result.ended.ran for result in results) > 0.15 * len(cases), "too few inputs are accepted and run"


def test_cases_that_were_found_once(records: Path, tmp_path: Path) -> None:
    worker = campaign.Worker(records, tmp_path, campaign.LIMIT, broken=False)
    check([worker.run(kind, seed, index) for seed, kind, index in ONCE], len(ONCE))
    worker.close()


@pytest.mark.slow
def test_all_broken_inputs(records: Path) -> None:
    """Print the table of kinds and outcomes (visible with ``-s``)."""
    check(campaign.run(campaign.spread(ALL), records=records, jobs=os.cpu_count() or 1), ALL)


@pytest.mark.parametrize("kind", KINDS)
def test_a_case_is_the_same_whenever_it_is_drawn(kind: str, records: Path) -> None:
    for index in range(20):
        first, again = draw(kind, 1, index, records), draw(kind, 1, index, records)
        assert (first.what, first.files, first.commands) == (again.what, again.files, again.commands)
    first, other = draw(kind, 1, 0, records), draw(kind, 2, 0, records)
    assert (first.what, first.files) != (other.what, other.files)
