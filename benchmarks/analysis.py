"""How long analyses take: all forms over a large experiment, and a scatter of very many runs.

    python benchmarks/analysis.py [--runs 1500] [--points 100000]

Prints a table: for each form the time to build, the size of its interactive figures; then the whole report (selection,
table, forms, page). Asked: 1500 runs with all forms under 15 s; the page of a scatter of 100,000 runs under 5 MB
without the library that draws it.
"""

from __future__ import annotations

import argparse
import gzip
import json
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.search_data import fill, make
from slamhive.analysis.forms import FORMS
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.result_json import from_json
from slamhive.project import project_root
from slamhive.services.analyses.bundle import report_page
from slamhive.services.analyses.run import AnalysisLimits
from slamhive.services.hive import open_hive

SCATTER = "x: nFeatures, y: ate.rmse"
OPTIONS = {
    "scatter": SCATTER,
    "scatter_3d": "x: nFeatures, y: cpu.mean, z: ate.rmse",
    "heatmap": "x: nFeatures, y: nLevels",
    "line": "x: nFeatures",
    "sensitivity": "x: nFeatures",
    "selector": "bounds: ['ate.rmse < 0.5']",
    "importance": "parameters: [algorithm, dataset, nFeatures, nLevels, scaleFactor]",
}
NEED_FILES = {"trajectories", "usage", "protocols", "repeatability"}
"""Forms that made-up runs have nothing for: no folders, one protocol, many configurations."""

LIMIT_S = 15.0
LIMIT_BYTES = 5_000_000


def analysis_text(forms: dict[str, str]) -> str:
    """An analysis of all runs with these forms."""
    listed = "\n".join(f"- {{form: {key}{', ' + options if options else ''}}}" for key, options in forms.items())
    return f"name: benchmark\nselect: {{all: {{where: 'id >= 1'}}}}\nforms:\n{listed}\n"


def measure(runs: int, forms: dict[str, str]) -> tuple[float, float, int]:
    """Seconds of wall and CPU time for the whole report, and the bytes of its figures."""
    with tempfile.TemporaryDirectory() as folder:
        hive = open_hive({"data": Path(folder)})
        try:
            fill(hive.store, make(runs))
            analysis = hive.analyses.read(analysis_text(forms))
            began, cpu = time.perf_counter(), time.process_time()
            last = [began]

            def tell(_share: float, doing: str) -> None:
                now = time.perf_counter()
                if now - last[0] > 0.5:
                    print(f"  {now - began:6.2f} s  {doing}", flush=True)
                last[0] = now

            report = hive.analyses.compute(analysis, AnalysisLimits(10**9, 3600), tell)
            page = report_page(report, project_root())
            wall, used = time.perf_counter() - began, time.process_time() - cpu
        finally:
            hive.close()
    for form in report["forms"]:
        print(f"  {form['form']:22} {form['error'] or 'made'}")
    charts = [chart for form in report["forms"] if form["result"] for chart in from_json(form["result"]).charts]
    figures = json.dumps([plotly_figure(chart) for chart in charts]).encode()
    print(f"  page {len(page) / 1e6:.1f} MB with the library; figures {len(figures) / 1e6:.2f} MB", end="")
    print(f", {len(gzip.compress(figures, 6)) / 1e6:.2f} MB compressed")
    return wall, used, len(figures)


def main() -> None:
    """Run both and print what was asked beside what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1500)
    parser.add_argument("--points", type=int, default=100_000)
    chosen = parser.parse_args()
    forms = {key: OPTIONS.get(key, "") for key in FORMS.names() if key not in NEED_FILES}
    print(f"{chosen.runs} runs, {len(forms)} forms")
    wall, used, _ = measure(chosen.runs, forms)
    print(f"  all forms: {wall:.1f} s ({used:.1f} s of CPU), asked {LIMIT_S:g} s: ratio {wall / LIMIT_S:.2f}")
    print(f"{chosen.points} runs in one scatter")
    wall, used, size = measure(chosen.points, {"scatter": SCATTER})
    print(f"  report: {wall:.1f} s ({used:.1f} s of CPU)")
    print(f"  figure: {size / 1e6:.2f} MB, asked {LIMIT_BYTES / 1e6:g} MB: ratio {size / LIMIT_BYTES:.2f}")


if __name__ == "__main__":
    main()
