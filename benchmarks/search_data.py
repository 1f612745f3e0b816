"""Many made-up runs in a store, or in the database of MLflow: the rows that ``search.py`` searches.

Each run has 6 parameters and 40 metric values; 5 repeats share a configuration. One run in ten failed and has only
measured metrics. The others have a verdict: most are good, one in eight failed by its evaluation. The same seed makes
the same values.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy import create_engine

from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.verdict import VerdictKind
from slamhive.store import Store
from slamhive.store.metrics import CODES, VERDICT
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    AlgorithmRow,
    ConfigurationRow,
    ConfigurationValueRow,
    DatasetRow,
    MetricRow,
    MetricValueRow,
    ParameterRow,
    RunRow,
)
from slamhive.store.tables import TableBase

REPEATS = 5
METRICS = 40
PARAMETERS = ("nFeatures", "nLevels", "scaleFactor", "iniThFAST", "minThFAST", "thDepth")
ALGORITHMS = ("orb-slam3-mono", "orb-slam3-stereo", "orb-slam3-mono-inertial", "kiss-icp", "rko-lio")
DATASETS = tuple(f"MH_{place:02d}" for place in range(1, 6)) + tuple(f"V{place}" for place in range(101, 107))
REASONS = ("timeout", "no_trajectory", "nonzero_exit", "out_of_memory")
BEGIN = datetime(2026, 1, 1, tzinfo=UTC)
BATCH = 5_000
VERDICTS = {
    VerdictKind.GOOD: 0.875,
    VerdictKind.TRACKED_TOO_LITTLE: 0.075,
    VerdictKind.DIVERGED_FAR: 0.03,
    VerdictKind.DIVERGED_OUTLIER: 0.02,
}
"""How often each verdict is found among the runs that were evaluated."""


@dataclass(frozen=True)
class Made:
    """The metrics behind the rows, so that expected counts are known. ``values``: metric by run, NaN: none."""

    runs: int
    keys: tuple[str, ...]
    failed: npt.NDArray[np.bool_]
    parameters: npt.NDArray[np.float64]

    def values(self, place: int) -> npt.NDArray[np.float64]:
        """The values of one metric; NaN where the run has none."""
        chance = np.random.default_rng((7, place))
        if self.keys[place] == VERDICT:
            codes = [CODES[kind] for kind in VERDICTS]
            return np.where(self.failed, np.nan, chance.choice(codes, self.runs, p=list(VERDICTS.values())))
        scale = {"tracked_fraction": 1.0, "ram.max": 2e9}.get(self.keys[place], 0.1)
        values = np.minimum(chance.gamma(2.0, scale, self.runs), 1.0 if "fraction" in self.keys[place] else np.inf)
        if needs_protocol(self.keys[place]):
            values[self.failed] = np.nan
        return values


def needs_protocol(key: str) -> bool:
    """True if a metric is filed under the protocol of its evaluation."""
    return key == VERDICT or CATALOGUE[key].needs_protocol


def make(runs: int) -> Made:
    """The metrics of ``runs`` runs."""
    chance = np.random.default_rng(11)
    protocol = [key for key, metric in CATALOGUE.items() if metric.needs_protocol]
    measured = [key for key, metric in CATALOGUE.items() if not metric.needs_protocol]
    wanted = [*dict.fromkeys(["ate.rmse", "rpe.rmse", "tracked_fraction", *protocol])]
    front = dict.fromkeys(["cpu.mean", "ram.max", "latency.p95", *measured])
    keys = (*wanted[: METRICS - 12], *list(front)[:12], VERDICT)
    parameters = 500.0 * chance.integers(1, 20, (-(-runs // REPEATS), len(PARAMETERS))).astype(np.float64)
    return Made(runs, keys, chance.random(runs) < 0.1, parameters)


def fill(store: Store, made: Made) -> float:
    """Store all rows; how many seconds it took. Indexes that only searches need are made at the end."""
    began = time.perf_counter()
    mysql = store.engine.dialect.name == "mysql"
    indexes = [index for index in MetricValueRow.__table__.indexes if index.name == "ix_metric_values_search"]
    patient = create_engine(store.engine.url)  # the store's gives up on a statement after a minute
    for index in indexes:
        index.drop(patient)
    for table, rows in _tables(made):
        _insert(store, table, rows, mysql=mysql)
    for index in indexes:
        index.create(patient)
    patient.dispose()
    store.refresh_statistics()
    return time.perf_counter() - began


def _insert(store: Store, table: Any, rows: Iterator[dict[str, Any]], *, mysql: bool) -> None:
    with store.engine.connect() as connection:
        if mysql:
            for setting in ("foreign_key_checks", "unique_checks"):
                connection.exec_driver_sql(f"SET SESSION {setting}=0")
            connection.commit()
        while batch := list(itertools.islice(rows, BATCH * 4)):
            with connection.begin():
                for start in range(0, len(batch), BATCH):
                    _execute(connection, table, batch[start : start + BATCH], mysql=mysql)


def _execute(connection: Any, table: Any, batch: Sequence[dict[str, Any]], *, mysql: bool) -> None:
    """Rows by the driver's own executemany: SQLAlchemy's processing of types costs more than the database."""
    names = list(batch[0])
    mark = "%s" if mysql else "?"
    quoted = ", ".join(connection.dialect.identifier_preparer.quote(name) for name in names)
    statement = f"INSERT INTO {table.name} ({quoted}) VALUES ({', '.join([mark] * len(names))})"
    connection.exec_driver_sql(statement, [tuple(row.values()) for row in batch])


def _tables(made: Made) -> Iterator[tuple[Any, Iterator[dict[str, Any]]]]:
    now = BEGIN.strftime("%Y-%m-%d %H:%M:%S.%f")
    yield (
        AlgorithmRow.__table__,
        (
            {"id": place, "name": name, "package": name.split("-")[0], "mode": name}
            for place, name in enumerate(ALGORITHMS, 1)
        ),
    )
    yield DatasetRow.__table__, (
        {"id": place, "name": name, "checksum": "c", "duration_s": 100.0, "folder": "f", "sensors": "[]", "title": name,
         "registered_at": now}
        for place, name in enumerate(DATASETS, 1)
    )  # fmt: skip
    yield (
        ParameterRow.__table__,
        (
            {"id": place, "scope": "orb", "key": key, "type": "float", "unit": "", "general": None}
            for place, key in enumerate(PARAMETERS, 1)
        ),
    )
    yield MetricRow.__table__, ({"id": place, "key": key} for place, key in enumerate(made.keys, 1))
    yield TableBase.metadata.tables["protocols"], iter([_protocol()])
    yield ConfigurationRow.__table__, _configurations(made, now)
    yield ConfigurationValueRow.__table__, _values(made)
    yield RunRow.__table__, _runs(made)
    yield MetricValueRow.__table__, _figures(made)


def _protocol() -> dict[str, Any]:
    protocol = Protocol(Alignment.SE3)
    return {"id": 2, "fingerprint": protocol.fingerprint, "label": protocol.label,
            "definition": json.dumps(protocol.content)}  # fmt: skip


def _configurations(made: Made, now: str) -> Iterator[dict[str, Any]]:
    for place in range(1, len(made.parameters) + 1):
        yield {"id": place, "content_hash": f"{place:064x}", "algorithm_id": place % len(ALGORITHMS) + 1,
               "dataset_id": place % len(DATASETS) + 1, "playback_mode": "realtime", "playback_rate": 1.0,
               "created_at": now}  # fmt: skip


def _values(made: Made) -> Iterator[dict[str, Any]]:
    for place, row in enumerate(made.parameters.tolist(), 1):
        for parameter, value in enumerate(row, 1):
            yield {"configuration_id": place, "parameter_id": parameter, "value": str(value), "number_value": value}


def _runs(made: Made) -> Iterator[dict[str, Any]]:
    for place in range(made.runs):
        failed = bool(made.failed[place])
        created = BEGIN + timedelta(seconds=20 * place)
        at = created.strftime("%Y-%m-%d %H:%M:%S.%f")
        yield {"id": place + 1, "uid": f"{place:032x}", "configuration_id": place // REPEATS + 1, "executor": "docker",
               "state": "failed" if failed else "succeeded", "reason": REASONS[place % 4] if failed else None,
               "seed": place % REPEATS, "priority": 0, "evaluate": 1, "created_at": at, "started_at": at,
               "ended_at": at, "attempt": 1, "cancel_requested": 0, "held": 0, "affinity": "",
               "current_protocol_id": None if failed else 2}  # fmt: skip


def _figures(made: Made) -> Iterator[dict[str, Any]]:
    """Metric by metric, in the order of the primary key."""
    for place, key in enumerate(made.keys):
        protocol_id = 2 if needs_protocol(key) else MEASURED_PROTOCOL_ID
        for run, value in enumerate(made.values(place).tolist(), 1):
            if value == value:  # noqa: PLR0124 - not NaN
                yield {"metric_id": place + 1, "run_id": run, "protocol_id": protocol_id, "value": value,
                       "is_current": 1}  # fmt: skip
