"""Requests a second of the web pages, mixed, with very many runs behind waitress with 8 threads.

    python benchmarks/web.py [--runs 100000] [--seconds 20] [--clients 8]

Fills a store (see ``search_data.py``), computes an analysis of all its runs, and serves it in view-only mode in a
separate process. As many clients as browsers request lists, sorted and filtered lists, pages of runs, the page and
the plots of the analysis, and help. A browser that has a page sends its ETag, so both columns are real: without, and
with. Prints requests per second and the times of each address. Target: 200 per second on 2 cores.

The last column is the CPU time of a page of a workstation, which keeps none: that of one thread, so it hardly depends
on what else the machine does. Asked: 150 ms.
"""

from __future__ import annotations

import argparse
import http.client
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path
from urllib.parse import urlsplit

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.search_data import fill, make
from slamhive.services.hive import open_hive
from slamhive.web.app import create_app

ROOT = Path(__file__).resolve().parents[1]
ANALYSIS = """name: All runs
select:
  all: {where: "id >= 1"}
forms:
  - {form: scatter, x: nFeatures, y: ate.rmse}
"""
SERVER = """
import sys
import logging
import waitress
logging.getLogger("waitress").setLevel(logging.ERROR)
from slamhive.services.hive import open_hive
from slamhive.web.app import create_app
server = waitress.create_server(create_app(open_hive()), host="127.0.0.1", port=0, threads=8)
print(server.effective_port, flush=True)
server.run()
"""


def addresses(runs: int, token: str) -> list[str]:
    """The mix: each address as often unchanged here."""
    some = [f"/runs/{1 + place * (runs // 4)}" for place in range(4)]
    return [
        "/",
        "/runs",
        "/runs?sort=ate.rmse",
        "/runs?where=ate.rmse+%3C+0.1&limit=50",
        *some,
        f"/analyses/{token}",
        f"/analyses/{token}",
        f"/analyses/{token}/figures.json",
        "/analyses",
        "/experiments",
        "/configurations",
        "/help/analysis",
        "/help/web",
        "/algorithms",
        "/api/v1/algorithms",
    ]


class Client(threading.Thread):
    """One browser on one connection, going round the addresses until the time is over."""

    def __init__(self, url: str, paths: list[str], first: int, until_s: float, *, keeps: bool) -> None:
        super().__init__()
        self._url = urlsplit(url)
        self._paths = paths
        self._turn = first
        self._until_s = until_s
        self._keeps = keeps
        self.took_s: dict[str, list[float]] = defaultdict(list)
        self.bad: dict[str, int] = defaultdict(int)

    def run(self) -> None:
        """Ask."""
        connection = http.client.HTTPConnection(str(self._url.hostname), self._url.port, timeout=120)
        tags: dict[str, str] = {}
        while time.monotonic() < self._until_s:
            path = self._paths[self._turn % len(self._paths)]
            self._turn += 1
            headers = {"If-None-Match": tags[path]} if self._keeps and path in tags else {}
            began = time.perf_counter()
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            answer.read()
            self.took_s[path].append(time.perf_counter() - began)
            tags[path] = answer.headers.get("ETag", "")
            if answer.status not in (200, 304):
                self.bad[f"{path}: {answer.status}"] += 1


def measure(url: str, paths: list[str], clients: int, seconds: float, *, keeps: bool) -> tuple[float, dict[str, float]]:
    """Requests a second, and the median time (s) of each address."""
    until_s = time.monotonic() + seconds
    began = time.perf_counter()
    threads = [Client(url, paths, 3 * place, until_s, keeps=keeps) for place in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wall_s = time.perf_counter() - began
    took: dict[str, list[float]] = defaultdict(list)
    for thread in threads:
        for path, times in thread.took_s.items():
            took[path] += times
        for what, count in thread.bad.items():
            print(f"answered otherwise: {what}, {count} times")
    return sum(map(len, took.values())) / wall_s, {path: statistics.median(times) for path, times in took.items()}


def made_anew(paths: list[str]) -> dict[str, float]:
    """CPU time (s) of each page where none is kept: the median of five, once templates and statements are compiled."""
    hive = open_hive()
    client = create_app(hive).test_client()
    took = {}
    for path in dict.fromkeys(paths):
        times = []
        for _ in range(6):
            began = time.thread_time()
            client.get(path).close()
            times.append(time.thread_time() - began)
        took[path] = statistics.median(times[1:])
    hive.close()
    return took


def main() -> None:
    """Fill, serve, measure, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--data", type=Path, help="keep the data root here, and take what lies there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="slamhive-web-") as folder:
        data = options.data or Path(folder)
        os.environ["SLAMHIVE_DATA"] = str(data)
        filled = (data / "slamhive.db").exists()
        hive = open_hive()
        if not filled:
            fill(hive.store, make(options.runs))
        listed = hive.stored_analyses.listed()
        token = listed[0].token if listed else hive.stored_analyses.create(ANALYSIS).token
        began = time.perf_counter()
        hive.analysis_jobs.work_once("benchmark:1:2:3:4", threading.Event())
        record = hive.stored_analyses.get(token)
        print(f"analysis of all runs: {record.state}, {record.reason or ''} {time.perf_counter() - began:.1f} s")
        files = {path.name: path.stat().st_size for path in hive.stored_analyses.folder(token).root.glob("*.gz")}
        print("; ".join(f"{name} {size / 1e6:.2f} MB" for name, size in sorted(files.items())))
        hive.close()
        paths = addresses(options.runs, token)
        anew = made_anew(paths)
        environment = {
            **os.environ,
            "SLAMHIVE_MODE": "view-only",
            "PYTHONPATH": str(ROOT),
        }
        server = subprocess.Popen([sys.executable, "-c", SERVER], env=environment, stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            url = f"http://127.0.0.1:{int(server.stdout.readline())}"
            measure(url, paths, 1, 1.0, keeps=False)
            print(f"load of the machine before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
            plain, times = measure(url, paths, options.clients, options.seconds, keeps=False)
            kept, kept_times = measure(url, paths, options.clients, options.seconds, keeps=True)
        finally:
            server.terminate()
            server.wait()
        print(f"\nrequests a second: {plain:.0f} without ETags, {kept:.0f} with")
        print(f"if every page were made again: {len(paths) / sum(anew[path] for path in paths):.0f} on one core\n")
        print(f"{'address':60} {'median':>9} {'with ETag':>10} {'CPU cold':>10}")
        for path in dict.fromkeys(paths):
            figures = (1e3 * took[path] for took in (times, kept_times, anew))
            print(f"{path.replace(token, 'TOKEN'):60} " + " ".join(f"{figure:7.1f} ms" for figure in figures))


if __name__ == "__main__":
    main()
