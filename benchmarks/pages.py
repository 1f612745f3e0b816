"""Bytes, requests and the time until it can be used of each page, in a real browser.

    python benchmarks/pages.py FOLDER [--repeats 3] [--address /runs/3 ...]

Serves the data root FOLDER, such as that of ``slamhive demo``, in view-only mode in a process of its own. Opens the
start page, the lists, the newest evaluated run, a comparison, an experiment, a dataset and the editor of reports in
Chromium, without its cache.

- bytes and requests of the first view: until the page is loaded, its plots are drawn and nothing was asked for half a
  second, compressed as they are sent. What needs a click, such as a 3D view, is not part of it.
- interactive: the time from the request until the last long task (over 50 ms) of the main thread has ended, and at
  least until the content is parsed. This is Time to Interactive (https://web.dev/articles/tti), which also waits for
  silence; that wait is left out.
- busy: the CPU time of the main thread, which hardly depends on what else the machine does.

Asked of each page: at most 350 kB, and interactive within 1 s on 2 cores.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from slamhive.services.hive import open_hive  # noqa: E402
from tests.web.browser_world import CHROMIUM, LOOKS, OPTIONS  # noqa: E402

MOST_BYTES, MOST_S = 350_000, 1.0
QUIET_S = 0.5
LONG_TASKS = """
window.longTaskEnds = [];
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) window.longTaskEnds.push(entry.startTime + entry.duration);
}).observe({ type: "longtask", buffered: true });
"""
INTERACTIVE_MS = """() => {
  const { domContentLoadedEventEnd: parsed } = performance.getEntriesByType("navigation")[0];
  return Math.max(parsed, ...window.longTaskEnds);
}"""
SERVER = """
import logging, sys
import waitress
logging.getLogger("waitress").setLevel(logging.ERROR)
from slamhive.services.hive import open_hive
from slamhive.web.app import create_app
hive = open_hive({"data": sys.argv[1], "mode": "view-only"})
server = waitress.create_server(create_app(hive), host="127.0.0.1", port=0, threads=4)
print(server.effective_port, flush=True)
server.run()
"""


@dataclass(frozen=True)
class View:
    """One opening of a page."""

    sent_bytes: int
    requests: int
    interactive_s: float
    busy_s: float


def opened(chromium: Browser, server: str, address: str) -> View:
    """Open a page in a fresh context, and wait until it asks for nothing more."""
    context = chromium.new_context(base_url=server, **LOOKS["light"])
    try:
        page = context.new_page()
        page.add_init_script(LONG_TASKS)
        session = context.new_cdp_session(page)
        session.send("Network.enable")
        session.send("Performance.enable", {"timeDomain": "threadTicks"})
        sent: list[int] = []
        session.on("Network.loadingFinished", lambda event: sent.append(int(event["encodedDataLength"])))
        answer = page.goto(address, wait_until="load")
        if answer is None or answer.status != 200:
            raise SystemExit(f"{address} answered {None if answer is None else answer.status}")
        known = -1
        while known != len(sent):
            known = len(sent)
            page.wait_for_timeout(QUIET_S * 1e3)
        metrics = {entry["name"]: entry["value"] for entry in session.send("Performance.getMetrics")["metrics"]}
        interactive_s = float(page.evaluate(INTERACTIVE_MS)) / 1e3
        return View(sum(sent), len(sent), interactive_s, float(metrics["TaskDuration"]))
    finally:
        context.close()


@contextlib.contextmanager
def served(data: Path) -> Iterator[str]:
    """The address of a server of the data root."""
    process = subprocess.Popen([sys.executable, "-c", SERVER, str(data)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield f"http://127.0.0.1:{int(process.stdout.readline())}"
    finally:
        process.terminate()
        process.wait()


def usual_addresses(data: Path) -> list[str]:
    """The pages that people look at the most, as far as the data root has them."""
    with contextlib.closing(open_hive({"data": data, "mode": "view-only"})) as hive:
        runs = [run for run in hive.runs.page().records if run.protocol is not None]
        names = [status.name for status in hive.experiments.list()]
        datasets = [dataset.name for dataset in hive.catalogue.datasets()]
    found = ["/", "/runs", "/experiments"]
    found += [f"/runs/{runs[0].id}"] if runs else []
    found += [f"/compare?runs={','.join(str(run.id) for run in runs[:4])}"] if len(runs) > 1 else []
    found += [f"/experiments/{name}" for name in names[:1]]
    return [*found, *(f"/datasets/{name}" for name in datasets[:1]), "/analyses/new"]


def main() -> None:
    """Print a line for each page, and end with 1 if one is too heavy or too slow."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="FOLDER", help="a data root with evaluated runs")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--address", nargs="*")
    options = parser.parse_args()
    too_much = []
    with served(options.data) as server, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=list(OPTIONS))
        print(f"{'page':40} {'bytes':>9} {'requests':>8} {'interactive':>11} {'busy':>7}")
        for address in options.address or usual_addresses(options.data):
            views = [opened(chromium, server, address) for _ in range(options.repeats)]
            sent = max(view.sent_bytes for view in views)
            interactive_s = statistics.median(view.interactive_s for view in views)
            busy_s = statistics.median(view.busy_s for view in views)
            print(f"{address:40} {sent:9,} {views[0].requests:8} {interactive_s:9.2f} s {busy_s:5.2f} s", flush=True)
            if sent > MOST_BYTES or interactive_s > MOST_S:
                too_much.append(address)
        chromium.close()
    if too_much:
        raise SystemExit(f"more than {MOST_BYTES:,} bytes or {MOST_S:g} s: {', '.join(too_much)}")


if __name__ == "__main__":
    main()
