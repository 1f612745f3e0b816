"""The architecture page shows the packages as they are, and each package has a README that names what is there."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from architecture import PAGE, ROOT, arrows_of, as_svg, as_text, imported_packages, shortest

IMPORTS = imported_packages()


def test_the_arrows_of_the_page_are_those_of_the_imports():
    assert as_text(arrows_of(PAGE.read_text())) == as_text(shortest(IMPORTS))


def test_an_arrow_that_follows_from_others_is_left_out():
    imports = {"a": {"b", "c"}, "b": {"c"}, "c": set()}
    assert shortest(imports) == {"a": {"b"}, "b": {"c"}, "c": set()}


def test_packages_in_a_circle_have_no_picture():
    with pytest.raises(ValueError, match="circle: a -> b -> a"):
        shortest({"a": {"b"}, "b": {"a"}})


def test_the_picture_has_each_package_and_each_arrow():
    arrows = arrows_of(PAGE.read_text())
    picture = as_svg(arrows)
    assert [name for name in arrows if f">{name}</text>" not in picture] == []
    assert picture.count("marker-end") == sum(len(others) for others in arrows.values())


def test_the_page_is_read_in_ten_minutes():
    assert len(PAGE.read_text().split()) <= 2_500


@pytest.mark.parametrize("package", sorted(IMPORTS))
def test_the_readme_of_a_package_names_what_is_there(package: str):
    folder = ROOT / "slamhive" / package
    text = (folder / "README.md").read_text()
    assert 100 < len(text.split()) < 500
    for word in ("**Must not know", "**Tests:**"):
        assert word in text or package == "base"
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    named = [name for row in rows for name in re.findall(r"`([a-z_0-9]+/?)`", row.split("|")[1])]
    assert len(named) >= 3
    assert [name for name in named if not (folder / name).is_dir() and not (folder / f"{name}.py").is_file()] == []
    assert [name for name in re.findall(r"`(tests/[\w/]+)`", text) if not (ROOT / name).exists()] == []
