"""MLflow's own search over the rows of one of our SQLite files; run by ``search.py`` with a Python that has MLflow.

Prints one line of JSON: {query: milliseconds of processor time}. The rows are copied into MLflow's own tables, and
ANALYZE is run.
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
from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

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
    """Our runs, parameters and current figures in MLflow's tables."""
    connection = sqlite3.connect(target)
    connection.executescript(
        f"""
        ATTACH '{source}' AS ours;
        INSERT INTO runs (run_uuid, name, source_type, status, start_time, end_time, lifecycle_stage, experiment_id)
          SELECT uid, uid, 'LOCAL', CASE state WHEN 'failed' THEN 'FAILED' ELSE 'FINISHED' END,
                 1000 * id, 1000 * id, 'active', 0 FROM ours.runs;
        INSERT INTO params (key, value, run_uuid)
          SELECT p.key, v.value, r.uid FROM ours.runs r
          JOIN ours.configuration_values v ON v.configuration_id = r.configuration_id
          JOIN ours.parameters p ON p.id = v.parameter_id;
        INSERT INTO latest_metrics (key, value, timestamp, step, is_nan, run_uuid)
          SELECT m.key, v.value, 0, 0, 0, r.uid FROM ours.metric_values v
          JOIN ours.metrics m ON m.id = v.metric_id JOIN ours.runs r ON r.id = v.run_id;
        INSERT INTO metrics (key, value, timestamp, step, is_nan, run_uuid)
          SELECT key, value, timestamp, step, is_nan, run_uuid FROM latest_metrics;
        ANALYZE;
        """
    )
    connection.commit()
    connection.close()


def main() -> None:
    """Copy, search, print."""
    with tempfile.TemporaryDirectory(prefix="mlflow-search-") as name:
        path = Path(name) / "mlflow.db"
        SqlAlchemyStore(f"sqlite:///{path}", name)
        copy(sys.argv[1], path)
        store = SqlAlchemyStore(f"sqlite:///{path}", name)
        found: dict[str, list[float]] = {}
        for query, (draw, order) in QUERIES.items():
            chance = random.Random(5)
            times_ms = []
            for repeat in range(REPEATS + 1):
                text = draw(chance)
                began = time.process_time()
                store.search_runs(["0"], text, ViewType.ACTIVE_ONLY, max_results=50, order_by=order)
                if repeat:
                    times_ms.append(1e3 * (time.process_time() - began))
            found[query] = times_ms
        print(json.dumps(found))


if __name__ == "__main__":
    main()
