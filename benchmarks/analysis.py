"""Duration of analyses: all forms over a large experiment, and a scatter of very many runs.

    python benchmarks/analysis.py [--runs 1500] [--points 100000] [--browser chromium]

Prints for each plot type whether it could be created, then the time of the whole report (selection, table, plots,
page). Then it prints how long a browser takes from the start of the page until the scatter plot is on the screen.
Targets: 1500 runs with all plot types under 15 s; the page of a scatter plot of 100,000 runs under 5 MB without
plotly.js, in under 3 s.
"""

from __future__ import annotations

import argparse
import gzip
import http.server
import json
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.search_data import fill, make
from slamhive.analysis.plot_types import PLOT_TYPES
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.base.project import project_root
from slamhive.services.analysis.bundle import report_page
from slamhive.services.analysis.run import AnalysisLimits
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
LIMIT_PAINT_S = 3.0
FEW = 100
BROWSER_OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--window-size=1400,1000",
)  # fmt: skip
"""Without a graphics card: what is painted by one is painted by the processor."""

LIMIT_BYTES = 5_000_000


def analysis_text(forms: dict[str, str]) -> str:
    """An analysis of all runs with these forms."""
    listed = "\n".join(f"- {{form: {key}{', ' + options if options else ''}}}" for key, options in forms.items())
    return f"name: benchmark\nselect: {{all: {{where: 'id >= 1'}}}}\nforms:\n{listed}\n"


TIMER = """<script>
const place = document.querySelector("[data-chart]");
const done = () => setTimeout(() => fetch("/done?ms=" + performance.now()));
new MutationObserver((_, watcher) => {
  if (!place.on) return;
  watcher.disconnect();
  place.once("plotly_afterplot", () => requestAnimationFrame(done));
}).observe(place, { attributes: true, childList: true });
</script>"""
"""Sends the server the time since the page was asked for, once the first plot is drawn and a frame is painted."""


def paint(page: str, browser: str) -> float | None:
    """Seconds from asking for the page until its first plot is painted; None without the browser, or in a minute."""
    told: queue.Queue[float] = queue.Queue()
    body = page.replace("default-src 'none';", "default-src 'none'; connect-src 'self';").replace(
        "</body>", TIMER + "</body>"
    )

    class Server(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            address = urllib.parse.urlparse(self.path)
            if address.path == "/done":
                told.put(float(urllib.parse.parse_qs(address.query)["ms"][0]) / 1000)
            self.send_response(200 if address.path in {"/", "/done"} else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(body.encode() if address.path == "/" else b"")

        def log_message(self, *_: Any) -> None:
            pass

    if shutil.which(browser) is None:
        return None
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Server)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, *BROWSER_OPTIONS, f"--user-data-dir={profile}", f"http://127.0.0.1:{server.server_port}/"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            return told.get(timeout=60)
        except queue.Empty:
            return None
        finally:
            process.terminate()
            process.wait()
            server.shutdown()
            time.sleep(0.5)  # its children write into the profile until they are gone


def measure(runs: int, forms: dict[str, str]) -> tuple[float, float, int, str]:
    """Seconds of wall and CPU time for the whole report, the bytes of its plots, and its page."""
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
    for plot in report.forms:
        print(f"  {plot.form:22} {plot.error or 'made'}")
    charts = [chart for plot in report.forms for chart in plot.charts]
    figures = json.dumps([plotly_figure(chart) for chart in charts]).encode()
    print(f"  page {len(page) / 1e6:.1f} MB with the library; plots {len(figures) / 1e6:.2f} MB", end="")
    print(f", {len(gzip.compress(figures, 6)) / 1e6:.2f} MB compressed")
    return wall, used, len(figures), page


def main() -> None:
    """Run both and print what was asked beside what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1500)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--browser", default="chromium")
    chosen = parser.parse_args()
    forms = {key: OPTIONS.get(key, "") for key in PLOT_TYPES.names() if key not in NEED_FILES}
    print(f"{chosen.runs} runs, {len(forms)} forms")
    wall, used, *_ = measure(chosen.runs, forms)
    print(f"  all forms: {wall:.1f} s ({used:.1f} s of CPU), asked {LIMIT_S:g} s: ratio {wall / LIMIT_S:.2f}")
    print(f"{chosen.points} runs in one scatter")
    wall, used, size, page = measure(chosen.points, {"scatter": SCATTER})
    print(f"  report: {wall:.1f} s ({used:.1f} s of CPU)")
    print(f"  figure: {size / 1e6:.2f} MB, asked {LIMIT_BYTES / 1e6:g} MB: ratio {size / LIMIT_BYTES:.2f}")
    few = measure(FEW, {"scatter": SCATTER})[3]
    for _ in range(3):
        least, painted = paint(few, chosen.browser), paint(page, chosen.browser)
        if least is None or painted is None:
            print(f"  {chosen.browser} did not paint it")
            continue
        print(f"  painted: {painted:.2f} s, asked {LIMIT_PAINT_S:g} s: ratio {painted / LIMIT_PAINT_S:.2f}", end="")
        print(f"; a scatter of {FEW} runs, most of it the library being read: {least:.2f} s")


if __name__ == "__main__":
    main()
