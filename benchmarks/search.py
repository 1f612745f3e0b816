"""Duration of searches over many runs, on SQLite and MariaDB, side by side with MLflow over the same rows.

    python benchmarks/search.py --runs 100000 --mlflow /path/to/venv/bin/python
    python benchmarks/search.py --runs 1000000 --only mariadb

"clock" is the time a user waits, "CPU" the CPU time of client and server. On a busy machine only "calls" and "rows" are
exact: the Python calls of a page, and the rows that MariaDB reads for it. They do not vary, so they show whether a
change costs statements or changes a query plan.

Every query is a page as the web server makes it. It parses the filter, counts matches and runs left out, and reads 50
runs with all parameters and metrics. The values in the filter are random, so nothing comes from a cache of results. On
SQLite, the benchmark then requests the same pages from the web server and measures its memory.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import os
import pstats
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode
from urllib.request import urlopen

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.search_data import fill, make
from benchmarks.web import SERVER
from slamhive.base.project import project_root
from slamhive.base.settings_sources import load_settings
from slamhive.filters.binding import Search, read_search
from slamhive.filters.fields import vocabulary_of
from slamhive.services.datasets.catalogue import Catalogue
from slamhive.services.searches import Searches
from slamhive.store import RunSort, Store, open_store
from tests.services.mariadb import INSTALL_COMMAND, DatabaseServer, find_server

Draw = Callable[[np.random.Generator], str]
LIMIT_MS = {100_000: 100.0, 1_000_000: 500.0}

QUERIES: dict[str, tuple[Draw, RunSort]] = {
    "newest runs": (lambda _: "", RunSort()),
    "all, by ATE": (lambda _: "", RunSort("ate.rmse", descending=False)),
    "all, by parameter": (lambda _: "", RunSort("nFeatures", descending=False)),
    "all, by algorithm": (lambda _: "", RunSort("algorithm", descending=False)),
    "metric, narrow": (lambda c: f"ate.rmse < {c.uniform(0.005, 0.02):.5f}", RunSort()),
    "metric, wide": (lambda c: f"ate.rmse < {c.uniform(0.15, 0.3):.5f}", RunSort("ate.rmse", descending=False)),
    "parameter": (lambda c: f"nFeatures >= {c.integers(1, 19) * 500}", RunSort()),
    "state and reason": (lambda _: "state = failed and reason = timeout", RunSort("ended_at")),
    "metric and parameter": (
        lambda c: f"ate.rmse < {c.uniform(0.05, 0.3):.5f} and nFeatures >= {c.integers(1, 19) * 500}",
        RunSort("ate.rmse", descending=False),
    ),
    "two metrics": (
        lambda c: f"ate.rmse < {c.uniform(0.05, 0.3):.5f} and tracked_fraction > {c.uniform(0.5, 0.95):.4f}",
        RunSort("cpu.mean", descending=False),
    ),
    "algorithm and dataset": (
        lambda c: f"algorithm = kiss-icp and dataset ~ MH_0* and ate.rmse < {c.uniform(0.05, 0.4):.5f}",
        RunSort(),
    ),
    "or, not": (
        lambda c: f"(ate.rmse < {c.uniform(0.01, 0.05):.5f} or reason = timeout) and not dataset = MH_01",
        RunSort("created_at"),
    ),
    "four conditions": (
        lambda c: (
            f"state = succeeded and ate.rmse < {c.uniform(0.1, 0.3):.5f} and nLevels <= {c.integers(4, 19) * 500} "
            f"and ram.max < {c.uniform(2, 6):.3f} GB"
        ),
        RunSort("rpe.rmse", descending=False),
    ),
    "verdict": (lambda _: "verdict = good", RunSort("ate.rmse", descending=False)),
    "verdict, narrow": (
        lambda c: f"verdict = diverged_far and ate.rmse < {c.uniform(0.05, 0.3):.5f}",
        RunSort(),
    ),
    "sorted within": (lambda c: f"ate.rmse > {c.uniform(0.2, 0.4):.5f}", RunSort("ate.rmse", descending=False)),
    "deep page": (lambda _: "", RunSort("cpu.mean")),
    "by configuration": (lambda c: f"ate.rmse < {c.uniform(0.02, 0.3):.5f}", RunSort("configuration")),
    "by failures": (lambda c: f"ate.rmse < {c.uniform(0.02, 0.3):.5f}", RunSort("failed")),
}
GROUPED = frozenset({"by configuration", "by failures"})
DEEP = frozenset({"deep page"})


def page(
    searches: Searches, store: Store, search: Search, sort: RunSort, after: str | None, *, grouped: bool
) -> str | None:
    """One page; the key of the next."""
    if grouped:
        groups = searches.groups(search, sort, after, 50, ["ate.rmse", "tracked_fraction", "cpu.mean"])
        searches.left_out(search, groups.runs)
        return groups.next_key
    found = store.read(lambda t: t.runs.page(search, sort, after, 50, with_metrics=True))
    searches.left_out(search, found.count)
    return found.next_key


@dataclass
class Times:
    """Milliseconds of each query of a class. A server's own are known for all of them together.

    ``calls`` and ``rows`` are of one query: function calls in Python, and rows that the server read (0 on SQLite).
    """

    clock_ms: list[float]
    cpu_ms: list[float]
    server_ms: float = 0.0
    calls: int = 0
    rows: int = 0


def measure(store: Store, repeats: int, server_cpu_s: Callable[[], float] = lambda: 0.0) -> dict[str, Times]:
    """Durations of each query, by class."""
    stored, protocols = store.read(lambda t: (t.searches.parameters(), t.searches.protocols()))
    vocabulary = vocabulary_of(stored, protocols=protocols)
    settings = load_settings(project_root())
    searches = Searches(settings, store, Catalogue(settings, project_root()))

    def ask(text: str, sort: RunSort, after: str | None, *, grouped: bool) -> str | None:
        return page(searches, store, read_search(text, vocabulary), sort, after, grouped=grouped)

    found: dict[str, Times] = {}
    for name, (draw, sort) in QUERIES.items():
        chance = np.random.default_rng(5)
        after: str | None = None
        if name in DEEP:
            for _ in range(40):
                after = ask("", sort, after, grouped=False)
        ask(draw(chance), sort, after, grouped=name in GROUPED)  # compiles the statements
        times, before_s = Times([], []), server_cpu_s()
        for _ in range(repeats):
            text = draw(chance)
            began, worked = time.perf_counter(), time.process_time()
            ask(text, sort, after, grouped=name in GROUPED)
            times.clock_ms.append(1e3 * (time.perf_counter() - began))
            times.cpu_ms.append(1e3 * (time.process_time() - worked))
        times.server_ms = 1e3 * (server_cpu_s() - before_s) / repeats
        text, rows_before = draw(chance), rows_read(store)
        with cProfile.Profile() as profile:
            ask(text, sort, after, grouped=name in GROUPED)
        times.calls = pstats.Stats(profile).total_calls  # type: ignore[attr-defined]
        times.rows = rows_read(store) - rows_before
        found[name] = times
    return found


def rows_read(store: Store) -> int:
    """Number of rows that a MariaDB server has read so far, by index or in order; 0 on SQLite."""
    if store.engine.dialect.name == "sqlite":
        return 0
    with store.engine.connect() as connection:
        found = connection.exec_driver_sql("SHOW GLOBAL STATUS LIKE 'Handler_read%%'")
        return sum(int(number) for _, number in found)


def table(title: str, found: dict[str, Times], limit_ms: float | None) -> None:
    """Print the median and the 95th percentile of each class and of all, in milliseconds."""
    print(f"\n{title}\n{'query':24}{'clock p50':>10}{'p95':>9}{'CPU p50':>10}{'p95':>9}{'server mean':>13}", end="")
    print(f"{'calls':>10}{'rows':>10}")
    everything = Times(
        [value for times in found.values() for value in times.clock_ms],
        [value + times.server_ms for times in found.values() for value in times.cpu_ms],
        statistics.mean(times.server_ms for times in found.values()),
        calls=round(statistics.mean(times.calls for times in found.values())),
        rows=round(statistics.mean(times.rows for times in found.values())),
    )
    for name, times in {**found, "all (CPU with server)": everything}.items():
        high, worked = (float(np.percentile(values, 95)) for values in (times.clock_ms, times.cpu_ms))
        over = "" if limit_ms is None or high <= limit_ms else f"  over {limit_ms:g} ms"
        clock, cpu = statistics.median(times.clock_ms), statistics.median(times.cpu_ms)
        exact = f"{times.calls:10}{times.rows:10}"
        print(f"{name:24}{clock:10.1f}{high:9.1f}{cpu:10.1f}{worked:9.1f}{times.server_ms:13.1f}{exact}{over}")


@contextmanager
def sqlite_store(folder: Path) -> Iterator[tuple[Store, Path]]:
    """A store in a new file."""
    path = folder / "runs.db"
    store = open_store(f"sqlite:///{path}")
    yield store, path
    store.close()


@contextmanager
def mariadb_store(folder: Path, pool_gb: int) -> Iterator[tuple[Store, Callable[[], float]]]:
    """A store on a server of its own, with so much memory for its pages, and how many seconds it has worked."""
    program = find_server()
    if program is None:
        raise SystemExit(f"no MariaDB or MySQL server here; {INSTALL_COMMAND}")
    server = DatabaseServer(folder, program, f"--innodb-buffer-pool-size={pool_gb}G", "--innodb-log-file-size=512M")
    server.create()
    server.start()
    try:
        store = open_store(server.create_database("slamhive_benchmark"))
        process = psutil.Process(int((folder / "pid").read_text()))

        def worked_s() -> float:
            spent = process.cpu_times()
            return float(spent.user + spent.system)

        yield store, worked_s
        store.close()
    finally:
        server.stop()


@contextmanager
def web_server(path: Path, folder: Path) -> Iterator[tuple[str, psutil.Process]]:
    """The web server over an SQLite file: its address, and its process."""
    environment = {
        **os.environ,
        "SLAMHIVE_DATA": str(folder),
        "SLAMHIVE_DATABASE_URL": f"sqlite:///{path}",
        "PYTHONPATH": str(Path(__file__).resolve().parents[1]),
    }
    server = subprocess.Popen([sys.executable, "-c", SERVER], env=environment, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        yield f"http://127.0.0.1:{int(server.stdout.readline())}", psutil.Process(server.pid)
    finally:
        server.terminate()
        server.wait()


def walk_pages(url: str, worker: psutil.Process, repeats: int) -> None:
    """Every class of query as a page, from several browsers at once, and all runs as a file; print time and memory."""
    chance = np.random.default_rng(6)
    print(f"\n{'page':24}{'clock p50':>10}{'p95':>9}{'worker CPU':>13}")
    for name, (draw, sort) in QUERIES.items():
        order = {"sort": sort.key, "order": "desc" if sort.descending else "asc"}
        group = {"group": "configuration"} if name in GROUPED else {}
        addresses = [f"{url}/runs?{urlencode({'where': draw(chance), **order, **group})}" for _ in range(repeats + 1)]
        _get(addresses[0])
        before = worker.cpu_times()
        times_ms = [_get(address) for address in addresses[1:]]
        after = worker.cpu_times()
        cpu_ms = 1e3 * (after.user + after.system - before.user - before.system) / repeats
        print(f"{name:24}{statistics.median(times_ms):10.1f}{np.percentile(times_ms, 95):9.1f}{cpu_ms:13.1f}")
        with ThreadPoolExecutor(4) as browsers:
            list(browsers.map(_get, addresses))
    for form in ("csv", "json"):
        took_ms = _get(f"{url}/searches/export.{form}")
        print(f"all runs as {form.upper()}: {1e-3 * took_ms:.1f} s")
    status = Path(f"/proc/{worker.pid}/status").read_text()
    peak_mb = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1e3
    print(f"peak memory of the web worker after all of these: {peak_mb:.0f} MB")


def _get(address: str) -> float:
    """Milliseconds until the whole answer is there."""
    began = time.perf_counter()
    with urlopen(address, timeout=300) as answer:
        while answer.read(1 << 16):
            pass
    return 1e3 * (time.perf_counter() - began)


def beside_mlflow(python: str, path: Path, ours: dict[str, Times], limit_s: float) -> None:
    """The queries that MLflow's language can say, over the same rows, in CPU time: both do all in one process."""
    script = Path(__file__).with_name("search_mlflow.py")
    result = subprocess.run([python, str(script), str(path), str(limit_s)], capture_output=True, text=True, check=False)
    if result.returncode != 0:
        raise SystemExit(f"{script.name} failed: {result.stderr[-1500:]}")
    theirs: dict[str, list[float]] = json.loads(result.stdout.splitlines()[-1])
    print(f"\nbeside MLflow, SQLite, after ANALYZE, CPU\n{'query':24}{'ours ms':>10}{'MLflow ms':>12}{'times':>8}")
    ratios = []
    for name, values in theirs.items():
        own = statistics.median(ours[name].cpu_ms)
        if not values:
            ratios.append(1e3 * limit_s / own)
            print(f"{name:24}{own:10.1f}   not ended after {limit_s:g} s: more than {ratios[-1]:.0f} times")
            continue
        other = statistics.median(values)
        ratios.append(other / own)
        print(f"{name:24}{own:10.1f}{other:12.1f}{other / own:8.1f}")
    print(f"median of the ratios {statistics.median(ratios):.1f}, smallest {min(ratios):.1f}")


def main() -> None:
    """Fill, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=20, help="queries of each class")
    parser.add_argument("--only", choices=("sqlite", "mariadb"))
    parser.add_argument("--mlflow", metavar="PYTHON", help="a Python that has MLflow, to compare with")
    parser.add_argument("--mlflow-limit", type=float, default=20.0, metavar="S", help="of each of MLflow's queries")
    options = parser.parse_args()
    made = make(options.runs)
    limit_ms = LIMIT_MS.get(options.runs)
    print(f"load of the machine before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    with tempfile.TemporaryDirectory(prefix="slamhive-search-") as name:
        folder = Path(name)
        if options.only != "mariadb":
            with sqlite_store(folder) as (store, path):
                took_s = fill(store, made)
                print(f"SQLite: {options.runs:,} runs stored in {took_s:.0f} s, {path.stat().st_size / 1e6:.0f} MB")
                found = measure(store, options.repeats)
                table(f"SQLite, {options.runs:,} runs", found, limit_ms)
                with web_server(path, folder) as (url, worker):
                    walk_pages(url, worker, options.repeats)
                if options.mlflow:
                    beside_mlflow(options.mlflow, path, found, options.mlflow_limit)
        if options.only != "sqlite":
            (folder / "mariadb").mkdir()
            pool_gb = max(1, round(6 * options.runs / 1e6))  # what is searched fits
            with mariadb_store(folder / "mariadb", pool_gb) as (store, worked_s):
                print(f"\nMariaDB, buffer pool {pool_gb} GB: {options.runs:,} runs stored in {fill(store, made):.0f} s")
                table(f"MariaDB, {options.runs:,} runs", measure(store, options.repeats, worked_s), limit_ms)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"\npeak memory of this process, filling included: {peak_mb:.0f} MB")


if __name__ == "__main__":
    main()
