"""MLflow's own search over the rows of one of our SQLite files; run by ``search.py`` with a Python that has MLflow.

    python search_mlflow.py runs.db SECONDS

Prints one line of JSON: {query: milliseconds of CPU time of each repeat, none if it had not ended after SECONDS}.
The rows are copied into the tables that MLflow searches, and ANALYZE is run.
"""

from __future__ import annotations

import json
import random
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mlflow.entities import ViewType
from mlflow.exceptions import MlflowException
from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore
from sqlalchemy import Engine, event
from sqlalchemy.exc import OperationalError

REPEATS = 5
QUERIES: dict[str, tuple[Callable[[random.Random], str], list[str]]] = {
    "newest runs": (lambda _: "", ["attributes.start_time DESC"]),
    "all, by ATE": (lambda _: "", ["metrics.`ate.rmse` ASC"]),
    "metric, narrow": (lambda c: f"metrics.`ate.rmse` < {c.uniform(0.005, 0.02):.5f}", []),
    "metric, wide": (lambda c: f"metrics.`ate.rmse` < {c.uniform(0.15, 0.3):.5f}", ["metrics.`ate.rmse` ASC"]),
    "metric and parameter": (
        lambda c: (
            f"metrics.`ate.rmse` < {c.uniform(0.05, 0.3):.5f} and params.nFeatures = '{c.randrange(1, 19) * 500}.0'"
        ),
        ["metrics.`ate.rmse` ASC"],
    ),
    "two metrics": (
        lambda c: (
            f"metrics.`ate.rmse` < {c.uniform(0.05, 0.3):.5f} and metrics.tracked_fraction > {c.uniform(0.5, 0.95):.4f}"
        ),
        ["metrics.`cpu.mean` ASC"],
    ),
}


def copy(source: str, target: Path) -> None:
    """Our runs, parameters and current metrics in the tables that MLflow searches, in the order of their keys."""
    connection = sqlite3.connect(target)
    connection.executescript(
        f"""
        PRAGMA journal_mode=OFF;
        PRAGMA synchronous=OFF;
        ATTACH '{source}' AS ours;
        INSERT INTO runs (run_uuid, name, user_id, source_type, status, start_time, end_time, lifecycle_stage,
                          experiment_id, artifact_uri)
          SELECT uid, uid, 'user', 'LOCAL', CASE state WHEN 'failed' THEN 'FAILED' ELSE 'FINISHED' END,
                 1000 * id, 1000 * id, 'active', 0, '' FROM ours.runs;
        INSERT INTO params (key, value, run_uuid)
          SELECT p.key, v.value, r.uid FROM ours.parameters p
          CROSS JOIN ours.runs r
          JOIN ours.configuration_values v ON v.configuration_id = r.configuration_id AND v.parameter_id = p.id;
        INSERT INTO latest_metrics (key, value, timestamp, step, is_nan, run_uuid)
          SELECT m.key, v.value, 0, 0, 0, r.uid FROM ours.metrics m
          CROSS JOIN ours.metric_values v ON v.metric_id = m.id CROSS JOIN ours.runs r ON r.id = v.run_id;
        ANALYZE;
        """
    )
    connection.commit()
    connection.close()


class Deadline:
    """Interrupts what SQLite works on once its time is over."""

    def __init__(self, engine: Engine) -> None:
        self.at_s = float("inf")
        event.listen(engine, "connect", self._watch)
        engine.dispose()

    def _watch(self, connection: sqlite3.Connection, _record: object) -> None:
        connection.set_progress_handler(lambda: time.monotonic() > self.at_s, 100_000)


def search(store: SqlAlchemyStore, query: str, deadline: Deadline, limit_s: float) -> list[float]:
    """Milliseconds of CPU time of each repeat; empty if one had not ended in time."""
    draw, order = QUERIES[query]
    chance = random.Random(5)
    times_ms = []
    for repeat in range(REPEATS + 1):
        text = draw(chance)
        deadline.at_s = time.monotonic() + limit_s
        began = time.process_time()
        try:
            store.search_runs(["0"], text, ViewType.ACTIVE_ONLY, max_results=50, order_by=order)
        except (OperationalError, MlflowException) as error:
            if "interrupted" not in str(error):
                raise
            return []
        if repeat:
            times_ms.append(1e3 * (time.process_time() - began))
    return times_ms


def main() -> None:
    """Copy, search, print."""
    with tempfile.TemporaryDirectory(prefix="mlflow-search-") as name:
        path = Path(name) / "mlflow.db"
        SqlAlchemyStore(f"sqlite:///{path}", name)
        copy(sys.argv[1], path)
        store = SqlAlchemyStore(f"sqlite:///{path}", name)
        deadline = Deadline(store.engine)
        print(json.dumps({query: search(store, query, deadline, float(sys.argv[2])) for query in QUERIES}))


if __name__ == "__main__":
    main()
