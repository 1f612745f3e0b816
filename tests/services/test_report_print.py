"""A report on paper: every row of every table, and every dataset of every plot."""

from __future__ import annotations

import shutil
import subprocess
from datetime import UTC, datetime
from itertools import product
from pathlib import Path

import pytest

from slamhive.analysis.analysis_file import parse_analysis
from slamhive.analysis.table import RunTable, make_table
from slamhive.base.project import project_root
from slamhive.services.analysis.bundle import report_page
from slamhive.services.analysis.run import AnalysisOutcome, PlotOutcome, make_report
from tests.analysis.analysis_world import data_of
from tests.web.browser_world import CHROMIUM

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not (CHROMIUM and shutil.which("pdftotext")), reason="needs chromium and pdftotext"),
]
ALGORITHMS = [f"slam{place:03}" for place in range(34)]
DATASETS = [f"sequence{place:02}" for place in range(11)]
TEXT = """
name: On paper
select: {all: {where: "id >= 1"}}
forms:
- {form: table, metrics: [ate.rmse]}
- {form: distributions, metrics: [ate.rmse]}
"""


def wide_table() -> RunTable:
    """A run of each algorithm on the first dataset, and of the first three algorithms on all."""
    pairs = [(name, DATASETS[0]) for name in ALGORITHMS] + list(product(ALGORITHMS[:3], DATASETS[1:]))
    count = len(pairs)
    facts: dict[str, list[object]] = {
        "run_id": list(range(1, count + 1)),
        "configuration_id": list(range(1, count + 1)),
        "algorithm": [algorithm for algorithm, _ in pairs],
        "dataset": [dataset for _, dataset in pairs],
        "state": ["succeeded"] * count,
        "evaluation": ["succeeded"] * count,
        "protocol": ["aaaaaaaaaaaa"] * count,
        "protocol_label": ["SE(3)"] * count,
    }
    return make_table(facts, {}, {"ate.rmse": [0.01 * (place + 1) for place in range(count)]})


def printed(folder: Path) -> str:
    """The text of the report, printed from a narrow window."""
    analysis, table = parse_analysis(TEXT, "analysis.yaml"), wide_table()
    plots = tuple(
        PlotOutcome(request, request.plot_type.build(data_of(table), request.options), None)
        for request in analysis.plots
    )
    page, paper = folder / "report.html", folder / "report.pdf"
    report = make_report(AnalysisOutcome(analysis, table, plots), datetime(2026, 5, 4, tzinfo=UTC))
    page.write_text(report_page(report, project_root()))
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]
    options += ["--disable-component-update", f"--user-data-dir={folder / 'browser'}", "--window-size=500,600"]
    command = [str(CHROMIUM), *options, "--no-pdf-header-footer", f"--print-to-pdf={paper}", page.as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return subprocess.run(["pdftotext", "-layout", paper, "-"], check=True, capture_output=True, text=True).stdout


def test_nothing_is_lost_on_paper(tmp_path: Path):
    text = printed(tmp_path)
    rows = [line.split()[:2] for line in text.splitlines()]
    expected = [[name, DATASETS[0]] for name in ALGORITHMS]
    assert [pair for pair in expected if pair not in rows and pair[::-1] not in rows] == []
    plot = text[text.index("Distributions over runs") :].partition("Summary")[0]
    assert [name for name in DATASETS if name not in plot.replace("\n", "")] == []
