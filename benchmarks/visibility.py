"""Cost of hiding runs from a viewer: CPU time of the pages of ``search.py``, by how much is hidden.

    python benchmarks/visibility.py --runs 100000

All columns come from one process and one database, one query after the other, so that they can be compared on a busy
machine. "all" sees everything, as on a server without accounts. For the others, that part of the runs is hidden.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from sqlalchemy import text

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.search import DEEP, GROUPED, QUERIES, page, sqlite_store
from benchmarks.search_data import fill, make
from slamhive.base.project import project_root
from slamhive.base.settings_sources import load_settings
from slamhive.domain.accounts import Viewer
from slamhive.filters.binding import read_search
from slamhive.filters.fields import vocabulary_of
from slamhive.services.datasets.catalogue import Catalogue
from slamhive.services.searches import Searches
from slamhive.store import Store

HIDDEN = {"all": None, "none": 0.0, "1 %": 0.01, "50 %": 0.5}
MEMBER = Viewer("anna", signed_in=True)


def hide(store: Store, share: float) -> None:
    """Make this share of the runs private, of somebody else; spread over all of them."""
    every = f"CASE WHEN (id * 7919) % 100 < {round(100 * share)} THEN 'private:ben' ELSE 'team' END"
    store.write(lambda t: t.database.execute(text(f"UPDATE runs SET audience = {every}")))
    store.refresh_statistics()


def measure(store: Store, repeats: int) -> dict[str, dict[str, float]]:
    """{query: {what is hidden: median CPU time of a page in ms}}."""
    stored, protocols = store.read(lambda t: (t.searches.parameters(), t.searches.protocols()))
    vocabulary = vocabulary_of(stored, protocols=protocols)
    settings = load_settings(project_root())
    found: dict[str, dict[str, float]] = {name: {} for name in QUERIES}
    for title, share in HIDDEN.items():
        if share is not None:
            hide(store, share)
        searches = Searches(settings, store, Catalogue(settings, project_root()))
        with store.seen_by(None if share is None else MEMBER):
            for name, (draw, sort) in QUERIES.items():
                chance, after = np.random.default_rng(5), None
                grouped = name in GROUPED
                for _ in range(40 if name in DEEP else 0):
                    after = page(searches, store, read_search("", vocabulary), sort, after, grouped=False)
                times = []
                for place in range(repeats + 1):
                    search = read_search(draw(chance), vocabulary)
                    began = time.process_time()
                    page(searches, store, search, sort, after, grouped=grouped)
                    if place:  # the first one compiles the statements
                        times.append(1e3 * (time.process_time() - began))
                found[name][title] = statistics.median(times)
    return found


def main() -> None:
    """Fill a database, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=10, help="queries of each class")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, sqlite_store(Path(folder)) as (store, _):
        fill(store, make(arguments.runs))
        found = measure(store, arguments.repeats)
    print(f"{'CPU time of a page in ms':24}" + "".join(f"{title:>10}" for title in HIDDEN))
    for name, times in found.items():
        print(f"{name:24}" + "".join(f"{times[title]:10.1f}" for title in HIDDEN))


if __name__ == "__main__":
    main()
