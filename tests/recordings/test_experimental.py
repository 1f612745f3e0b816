"""The importers that say ``experimental`` are those that the documentation calls unverified as a whole."""

import re

import pytest

from slamhive.base.project import project_root
from slamhive.recordings.importers.registry import EXPERIMENTAL, IMPORTERS

pytestmark = pytest.mark.quick


def test_the_documentation_names_the_same_importers():
    assert set(EXPERIMENTAL) <= set(IMPORTERS.names())
    text = (project_root() / "docs" / "importing-datasets.md").read_text()
    rows = [line.split("|") for line in text.splitlines() if re.match(r"\| [^|]+ \| `", line)]
    unverified = {row[2].strip(" `"): "unverified" in row[3] for row in rows}
    # Of these, only a variant or one camera was never tried.
    in_part = {"euroc", "tum-rgbd", "tartanair"}
    assert {name for name, doubt in unverified.items() if doubt} - in_part == set(EXPERIMENTAL)
