"""Numbers in pages are those of the studies' files, which agree with each other and with a fresh run."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import dynsim

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    spec = importlib.util.spec_from_file_location("pages", ROOT / ".ci" / "pages.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def read(name: str) -> Any:
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


def test_no_page_is_stale(pages: ModuleType) -> None:
    assert pages.stale() == {}, "python .ci/pages.py"


def test_a_number_and_a_table_that_are_stale_are_found(pages: ModuleType, tmp_path: Path, monkeypatch) -> None:
    page = tmp_path / "page.md"
    right = pages.written("Heat: 1.5<!-- = energy_two --> J.\n\n<!-- table: sweeps -->\n| 1 |\n<!-- end -->\n")
    assert (
        f"Heat: {read('reference/validation.json')['runs']['elbow_comparison two_elbows']['electrical_energy_J']:.1f}<"
        in right
    )
    assert "| runs | one process | two processes |\n|---|---:|---:|\n| 250 |" in right
    monkeypatch.setattr(pages, "PAGES", (page,))
    page.write_text(right, encoding="utf-8")
    assert pages.main(["--check"]) == 0
    page.write_text(right.replace("Heat: ", "Heat: −"), encoding="utf-8")
    assert list(pages.stale()) == ["page.md"]
    assert pages.main(["--check"]) == 1
    assert pages.main([]) == 0
    assert page.read_text(encoding="utf-8") == right
    page.write_text("3<!-- = not_known -->", encoding="utf-8")
    with pytest.raises(KeyError, match="not_known"):
        pages.stale()


def test_every_mark_is_of_a_number_and_every_number_is_used(pages: ModuleType) -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in pages.PAGES)
    assert text.count("<!-- = ") == len(pages.NUMBER.findall(text)), "a mark does not follow a number"
    assert text.count("<!-- table: ") == text.count("<!-- end -->") == len(pages.TABLE.findall(text))
    assert {name for name, _ in pages.TABLE.findall(text)} == set(pages.TABLES)


def test_every_file_says_which_version_made_it() -> None:
    for path in (*RESULTS.glob("reference/*.json"), RESULTS / "contact/comparison.json"):
        content = read(str(path.relative_to(RESULTS)))
        version = content.get("dynsim_version") or content.get("version") or content["versions"]["dynsim"]
        assert version == dynsim.__version__, path.name


def test_the_studies_agree() -> None:
    """Two of them run the same scenarios: glued, on a real floor and where all links touch."""
    runs, contact = read("reference/validation.json")["runs"], read("contact/comparison.json")
    keys = ("electrical_energy_J", "hand_error_rms_m", "energy_residual_relative", "rhs_evaluations")
    for scenario, variants in contact.items():
        for variant, row in variants.items() if isinstance(variants, dict) else ():
            assert [row[key] for key in keys] == [runs[f"{scenario} {variant}"][key] for key in keys]


@pytest.mark.parametrize("variant", ["two_elbows", "no_elbow"])
def test_the_kept_numbers_are_those_of_a_fresh_run(variant: str) -> None:
    """To rounding that differs from processor to processor, far below the digits that pages show."""
    kept = read("reference/validation.json")["elbow_summaries"][variant]
    fresh = dynsim.simulate(dynsim.load_scenario("elbow_comparison", variant)).summary
    assert fresh["electrical_energy_J"] == pytest.approx(kept["electrical_energy_J"], rel=1e-6)
    assert fresh["hand_error_rms_m"] == pytest.approx(kept["hand_error_rms_m"], rel=1e-6)
    assert fresh["energy_residual_relative"] < 3.0 * kept["energy_residual_relative"]
    assert fresh["rhs_evaluations"] == pytest.approx(kept["rhs_evaluations"], rel=0.05)
    assert fresh["warnings"] == kept["warnings"]
