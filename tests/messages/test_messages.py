"""The messages of dynsim agree with the golden file and have one form."""

import re
from collections import Counter

import pytest

from messages import golden

AREAS = list(golden.areas())


@pytest.mark.parametrize("area", AREAS)
def test_messages_agree_with_the_golden_file(area: str):
    difference = golden.difference(area)
    if difference:
        pytest.fail(f"messages have changed; if on purpose, run `{golden.COMMAND}`:\n{difference}", pytrace=False)


@pytest.mark.parametrize("area", AREAS)
def test_messages_have_one_form(area: str):
    """One line per problem, with file and key, not empty, without traceback, not long; except known departures."""
    new = [line for line in golden.departures(area) if line not in golden.allowed()]
    if new:
        pytest.fail("\n".join(["not in form:", *new]), pytrace=False)


def test_known_departures_still_exist():
    now = [line for area in AREAS for line in golden.departures(area)]
    mended = [line for line in golden.allowed() if line not in now]
    if mended:
        pytest.fail("\n".join([f"in form now; run `{golden.COMMAND}`:", *mended]), pytrace=False)


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("(no message)", "no message"),
        ("ModelError: ", "no message"),
        ("exit 1: Traceback (most recent call last):", "a traceback or an object without a text"),
        ("ModelError: needs a model, not <function check>", "a traceback or an object without a text"),
        ("not dynsim's: KeyError: 'q'", "an exception that is not dynsim's"),
        ("ModelError: first line\nsecond line", "several lines"),
        ("ModelError: bell \x07", "characters that cannot be printed"),
        (f"ModelError: {'word ' * 61}", "60 words or more"),
    ],
)
def test_form_of_a_bad_message_has_a_fault(message: str, fault: str):
    assert list(golden.faults(message)) == [fault]


def test_form_of_a_good_message_has_no_fault():
    assert list(golden.faults("ScenarioError: arm.yaml:2: duration_s = 0: must be greater than 0")) == []
    assert list(golden.faults("CheckRefused: 2 limits violated:\n  q: 3 rad\n  v: 2 rad/s")) == []
    assert list(golden.faults(f"ModelError: {'word ' * 60}")) == []


def test_golden_file_has_every_area_and_no_other():
    assert list(golden.recorded()) == AREAS


def test_names_of_inputs_are_unique_in_their_area():
    for area in AREAS:
        names = Counter(case.name for case in golden.cases(area))
        assert [name for name, count in names.items() if count > 1] == []


def test_golden_file_has_many_inputs_and_no_path_of_a_machine():
    assert sum(len(golden.cases(area)) for area in AREAS) >= 320
    assert not re.search(r"/tmp/|/home/|/root/|site-packages", golden.FILE.read_text(encoding="utf-8"))
