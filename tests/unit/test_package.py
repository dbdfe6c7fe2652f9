"""What a package must bring along: licence, types, how to cite it."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import dynsim

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_types_are_marked_and_the_licence_is_there() -> None:
    assert (Path(dynsim.__file__).parent / "py.typed").is_file()
    assert PROJECT["license-files"] == ["LICENSE"]
    assert (
        (ROOT / "LICENSE").read_text(encoding="utf-8").startswith(f"{PROJECT['license']} License\n\nCopyright (c) 2026")
    )


def test_the_citation_is_of_this_version_and_names_both_papers() -> None:
    citation = YAML(typ="safe").load(ROOT / "CITATION.cff")
    assert (citation["cff-version"], citation["title"]) == ("1.2.0", PROJECT["name"])
    assert (str(citation["version"]), citation["license"]) == (dynsim.__version__, PROJECT["license"])
    families = [[author["family-names"] for author in paper["authors"]] for paper in citation["references"]]
    assert families == [["Wang", "Minami"], ["Tanaka", "Tadakuma", "Nakajima", "Fujita"]]
    # The titles of the documentation, which breaks its lines elsewhere.
    for paper, page in zip(citation["references"], ("physics.md", "snake.md"), strict=True):
        assert paper["title"] in " ".join((ROOT / "docs" / page).read_text(encoding="utf-8").split())


def test_what_is_public_can_be_had_and_is_all_that_is_listed() -> None:
    for name in dynsim.__all__:
        assert getattr(dynsim, name) is not None
    assert dir(dynsim) == sorted(dynsim.__all__)
    with pytest.raises(AttributeError, match="no attribute 'viewer'"):
        _ = dynsim.viewer


def test_pages_films_and_braces_are_at_the_top_without_another_import() -> None:
    code = "import dynsim; print(dynsim.view.write.__name__, dynsim.film.write.__name__, dynsim.Brace.__name__)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert (done.stdout, done.stderr) == ("write write Brace\n", "")
