"""The examples of analyses are understood, and show every form."""

from __future__ import annotations

import pytest

from slamhive.analysis.analysis_file import parse_analysis
from slamhive.analysis.plot_types import PLOT_TYPES
from slamhive.base.project import project_root

pytestmark = pytest.mark.integration  # the forms load pandas and scipy

FOLDER = project_root() / "docs" / "examples" / "analyses"


def test_the_examples_show_every_form():
    files = sorted(FOLDER.glob("*.yaml"))
    analyses = [parse_analysis(path.read_text(encoding="utf-8"), path.name) for path in files]
    assert {request.plot_type.key for analysis in analyses for request in analysis.plots} == set(PLOT_TYPES.names())
