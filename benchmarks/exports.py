"""Time and memory of exports of many runs, on SQLite.

    python benchmarks/exports.py --runs 100000

Each format is written in a process of its own, with the default columns of the list of runs. "CPU" does not vary with
the load of the machine; "memory" is the highest resident size of the process.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.search_data import fill, make
from slamhive.filters.fields import vocabulary_of
from slamhive.services.exports import RUNS_AT_ONCE, ExportFormat, RunExport
from slamhive.store import RunSort, open_store
from slamhive.store.run_cells import RunCellPage
from slamhive.web.columns import DEFAULT_COLUMNS, exported


def export(url: str, kind: ExportFormat, path: Path) -> None:
    """Write all runs of the database, and print seconds, CPU seconds, MB of the file and MB of memory."""
    with closing(open_store(url)) as store:
        content = RunExport(exported(DEFAULT_COLUMNS), vocabulary_of(store.read(lambda t: t.searches.parameters())))

        def page(after: str | None) -> RunCellPage:
            return store.read(lambda t: t.runs.cells(None, RunSort(), after, RUNS_AT_ONCE, content.wanted))

        began, began_cpu = time.perf_counter(), time.process_time()
        if kind is ExportFormat.PARQUET:
            content.parquet(page, path)
        else:
            pieces = {ExportFormat.CSV: content.csv, ExportFormat.JSON: content.json}.get(kind, content.ndjson)(page)
            with path.open("w", encoding="utf-8") as file:
                file.writelines(pieces)
    took_s, cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{kind.value:8} {took_s:7.1f} s {cpu_s:7.1f} s {path.stat().st_size / 1e6:8.1f} MB {memory_mb:8.0f} MB")


def main() -> None:
    """Make the runs, then export them in each format."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--one", nargs=3, metavar=("URL", "FORMAT", "PATH"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        url, kind, path = options.one
        export(url, ExportFormat(kind), Path(path))
        return
    with tempfile.TemporaryDirectory(prefix="slamhive-exports-") as name:
        url = f"sqlite:///{name}/runs.db"
        with closing(open_store(url)) as store:
            fill(store, make(options.runs))
        print(f"{options.runs:,} runs; load of the machine before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
        print(f"{'format':8} {'clock':>9} {'CPU':>9} {'file':>11} {'memory':>11}", flush=True)
        for kind in ExportFormat:
            subprocess.run([sys.executable, __file__, "--one", url, kind.value, f"{name}/runs"], check=True)


if __name__ == "__main__":
    main()
