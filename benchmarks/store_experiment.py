"""Cost of storing an experiment of 100,000 configurations and their runs, and of looking at it afterwards.

    PYTHONPATH=. python benchmarks/store_experiment.py [--configurations 100000] [--database sqlite|mysql] [--json]

Wall and CPU seconds of this process to expand and to store, of a claim and of a page beside 100,000 queued runs,
and the largest memory. MySQL is a private server in a temporary folder. Fails above the bounds.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.expand import EXPERIMENT, PER_VALUE, catalogue
from slamhive.base.settings import Settings
from slamhive.experiments.expansion import expand
from slamhive.experiments.file import parse_experiment
from slamhive.services.datasets.catalogue import Catalogue
from slamhive.services.datasets.variants import VariantService
from slamhive.services.executors import Executors
from slamhive.services.experiments import progress as statuses
from slamhive.services.experiments.context import ExperimentContext
from slamhive.services.experiments.folder import StoredExperiment
from slamhive.services.experiments.service import ExperimentService
from slamhive.services.experiments.starting import fill, put_experiment
from slamhive.services.ledger.keeping import Ledger
from slamhive.store import Lease, Store, open_store
from slamhive.store.records import ExperimentState
from tests.services.mariadb import DatabaseServer, find_server

STORE_BOUND_S = 60.0
MEMORY_BOUND_BYTES = 1_000_000_000


def main() -> int:
    """Expand and store on each database, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configurations", type=int, default=100_000)
    parser.add_argument("--database", choices=["sqlite", "mysql"], action="append")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    text = EXPERIMENT.format(last=max(1, options.configurations // PER_VALUE))
    figures: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in options.database or ["sqlite", "mysql"]:
            with _store(name, Path(folder)) as store:
                figures[name] = measure(store, text, Path(folder))
    if options.json:
        print(json.dumps({"figures": figures, "bounds": {"store_s": STORE_BOUND_S}}, indent=1))
    else:
        for name, found in figures.items():
            print(f"{name}: " + ", ".join(f"{key} {value:g}" for key, value in found.items()))
        print(f"bounds: store_s {STORE_BOUND_S:g}, peak_mb {MEMORY_BOUND_BYTES / 1e6:g}")
    slow = any(found["store_s"] > STORE_BOUND_S for found in figures.values())
    return 1 if slow or _peak_bytes() > MEMORY_BOUND_BYTES else 0


def measure(store: Store, text: str, folder: Path) -> dict[str, float]:
    """Seconds and counts on one database."""
    context = ExperimentContext(
        settings := Settings(data=folder),
        store,
        Catalogue(settings, folder),
        lambda: VariantService(settings, store),
        lambda: Executors(settings, folder, lambda: False),
    )
    store.listener = Ledger(settings, store).note
    experiment = parse_experiment(text)
    expanding = _timed(lambda: sum(1 for _ in expand(experiment, catalogue())))
    expansion = expand(experiment, catalogue())
    now = datetime.now(UTC)
    identity = StoredExperiment(
        uid="0" * 32,
        name=experiment.name,
        content_hash=experiment.content_hash,
        state=ExperimentState.ACTIVE,
        executor="docker",
        repeats=1,
        created_at=now,
    )

    def storing() -> int:
        size = expansion.size
        record = put_experiment(context, identity, text, experiment, cells=size.configurations, runs=size.runs)
        fill(context, record, experiment, expansion, lambda _done, _total: None)
        return store.read(lambda t: t.experiments.get(experiment.name)).runs

    stored = _timed(storing)
    claim = _timed(lambda: store.write(lambda t: t.queue.claim(Lease("benchmark", now, 60.0))))
    page = _timed(lambda: store.read(lambda t: statuses.cell_page(t, experiment.name, 50_000, 50)))
    experiments = ExperimentService(context)
    first_status = _timed(lambda: experiments.status(experiment.name))
    status = _timed(lambda: experiments.status(experiment.name))
    experiments.grid(experiment.name, "p0", "p1")
    grid = _timed(lambda: experiments.grid(experiment.name, "p0", "p1"))
    hold = _timed(lambda: store.write(lambda t: t.experiments.hold(1, held=True)))
    return {
        "runs": stored["result"],
        "expand_cpu_s": expanding["cpu_s"],
        "store_s": stored["wall_s"],
        "store_cpu_s": stored["cpu_s"],
        "claim_s": claim["wall_s"],
        "cells_page_s": page["wall_s"],
        "first_status_cpu_s": first_status["cpu_s"],
        "status_cpu_s": status["cpu_s"],
        "grid_cpu_s": grid["cpu_s"],
        "pause_s": hold["wall_s"],
        "peak_mb": round(_peak_bytes() / 1e6),
    }


def _timed(work: Callable[[], Any]) -> dict[str, Any]:
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    result = work()
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    return {"result": result, "wall_s": round(wall_s, 3), "cpu_s": round(cpu_s, 3)}


@contextmanager
def _store(name: str, folder: Path) -> Iterator[Store]:
    server = None
    if name == "mysql":
        program = find_server()
        if program is None:
            sys.exit("no MariaDB or MySQL server here")
        (folder / "server").mkdir()
        server = DatabaseServer(folder / "server", program)
        server.create()
        server.start()
    url = f"sqlite:///{folder}/slamhive.db" if server is None else server.create_database("slamhive_benchmark")
    store = open_store(url)
    try:
        yield store
    finally:
        store.close()
        if server is not None:
            server.stop()


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    sys.exit(main())
