"""Time for one run to become JSON, as lists of the command line and the web API do it.

    python benchmarks/run_json.py

Runs from a store with rows that :mod:`benchmarks.search_data` makes: 6 parameters and 40 metrics. Prints the smallest
time of several repetitions, which depends least on other work of the machine.
"""

from __future__ import annotations

import sys
import tempfile
import timeit
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.search_data import fill, make
from slamhive.documents.run import RunDocument
from slamhive.store import open_store

RUNS = 50
REPEATS = 20


def main() -> None:
    """Fill, measure, print."""
    with tempfile.TemporaryDirectory(prefix="slamhive-json-") as folder:
        store = open_store(f"sqlite:///{folder}/runs.db")
        fill(store, make(RUNS))
        records = store.read(lambda t: t.runs.get_many(list(range(1, RUNS + 1)), with_metrics=True))
        store.close()
    documents = [RunDocument.of(record) for record in records]
    for what, work in (
        ("document of a record", lambda: [RunDocument.of(record) for record in records]),
        ("JSON of a document", lambda: [document.content for document in documents]),
    ):
        took_s = min(timeit.repeat(work, number=1, repeat=REPEATS))
        print(f"{what:24}{1e6 * took_s / RUNS:8.1f} us a run")


if __name__ == "__main__":
    main()
