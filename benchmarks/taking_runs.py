"""Duration of a claim beside 1000 queued runs, and beside 100,000 queued and 100,000 held ones.

``python benchmarks/taking_runs.py [--database-url URL]``; without a URL on a SQLite file. The database must be empty;
its rows stay. Ratios near 1 say that the queue's length does not matter.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slamhive.store import open_store
from tests.store.long_queue import NEARS, NOW, analyse, claim_s, fill
from tests.store.store_samples import Samples

FEW, MANY = 1000, 100_000


def main() -> None:
    """Print a table: what the worker did last, both times, their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--database-url")
    parser.add_argument("--runs", type=int, default=MANY)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        store = open_store(options.database_url or f"sqlite:///{folder}/queue.db")
        configuration_id = Samples(store, NOW).configuration()
        fill(store, configuration_id, 1, FEW, held=False)
        before_s = {what: claim_s(store, near) for what, near in NEARS.items()}
        fill(store, configuration_id, FEW + 1, options.runs, held=False)
        fill(store, configuration_id, FEW + options.runs + 1, options.runs, held=True)
        analyse(store)
        print(f"{store.label}: a claim from {FEW} queued runs, then from {options.runs} queued and {options.runs} held")
        for what, near in NEARS.items():
            after_s = claim_s(store, near)
            times = f"{before_s[what] * 1e3:6.2f} ms {after_s * 1e3:6.2f} ms"
            print(f"{what + ':':12} {times}  x{after_s / before_s[what]:.2f}")
        store.close()


if __name__ == "__main__":
    main()
