"""Runs and what they refer to, made for tests of the store."""

from __future__ import annotations

import itertools
from datetime import datetime
from pathlib import Path
from typing import Any

from slamhive.domain.configuration import Configuration
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Value
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.evaluation.job import EvaluationResult
from slamhive.store import Lease, RunRequest, Store

SE3 = Protocol(Alignment.SE3)
SIM3 = Protocol(Alignment.SIM3)
WORKER = "worker-1"
PATHS: dict[RunState, list[RunState]] = {
    RunState.QUEUED: [],
    RunState.PREPARING: [],
    RunState.STARTING: [RunState.STARTING],
    RunState.RUNNING: [RunState.STARTING, RunState.RUNNING],
    RunState.COLLECTING: [RunState.STARTING, RunState.RUNNING, RunState.COLLECTING],
    RunState.SUCCEEDED: [RunState.STARTING, RunState.RUNNING, RunState.COLLECTING, RunState.SUCCEEDED],
    RunState.FAILED: [RunState.STARTING, RunState.RUNNING, RunState.FAILED],
    RunState.CANCELLING: [RunState.STARTING, RunState.CANCELLING],
    RunState.CANCELLED: [RunState.STARTING, RunState.CANCELLING, RunState.CANCELLED],
}


def dataset(name: str = "room", checksum: str = "sha256:" + "0" * 64) -> Dataset:
    """A dataset value; nothing of it exists on disk."""
    camera = Sensor("left", SensorKind.CAMERA, "/left", 20.0)
    return Dataset(name, Path("/datasets") / name, "room.bag", 15.0, (camera,), None, checksum, title="A room")


def result(protocol: Protocol = SE3, /, reason: str | None = None, **metrics: float) -> EvaluationResult:
    """What an evaluation returns; ``ate_rmse=1`` becomes ``ate.rmse``."""
    figures = {key.replace("_", ".", 1): value for key, value in metrics.items()}
    return EvaluationResult("1", protocol.fingerprint, reason, figures, 50, 50, "evo 1.31")


class Samples:
    """Adds rows through the public interface of the store."""

    def __init__(self, store: Store, now: datetime) -> None:
        self.store = store
        self.now = now
        self._numbers = itertools.count(1)

    def configuration(
        self, parameters: dict[str, Value] | None = None, algorithm: str = "orb-slam3-stereo", data: str = "room"
    ) -> int:
        """The id of a configuration."""

        def work(tx: Any) -> int:
            algorithm_id = tx.catalogue.put_algorithm_named(algorithm, "orb-slam3", "stereo")
            dataset_id = tx.catalogue.put_dataset(dataset(data), self.now)
            content = Configuration(algorithm, data, {"nFeatures": 1000} if parameters is None else parameters)
            found: tuple[int, bool] = tx.configurations.get_or_create(content, algorithm_id, dataset_id, self.now)
            return found[0]

        return self.store.write(work)

    def request(self, configuration_id: int | None = None, **fields: Any) -> RunRequest:
        """A request with a uid of its own."""
        uid = f"{next(self._numbers):032x}"
        configuration_id = self.configuration() if configuration_id is None else configuration_id
        return RunRequest(**{"uid": uid, "configuration_id": configuration_id, "executor": "process", **fields})

    def queued(self, count: int = 1, **fields: Any) -> list[int]:
        """Ids of new queued runs."""
        configuration_id = fields.pop("configuration_id", None) or self.configuration()
        requests = [self.request(configuration_id, **fields) for _ in range(count)]
        return self.store.write(lambda tx: tx.runs.add_runs(requests, self.now))

    def run_in(self, state: RunState, because: FailureReason = FailureReason.TIMEOUT, **fields: Any) -> int:
        """A run that has gone through life up to ``state``; the queue must be empty before."""
        (run_id,) = self.queued(**fields)
        if state is RunState.QUEUED:
            return run_id
        claimed = self.store.write(lambda tx: tx.queue.claim_queued(Lease(WORKER, self.now, 30.0)))
        assert claimed is not None
        assert claimed.id == run_id
        for target in PATHS[state]:
            reason: Any = {"reason": because} if target is RunState.FAILED else {}
            self.store.write(
                lambda tx, to=target, why=reason: tx.runs.move(run_id, to, why="test", now=self.now, **why)  # type: ignore[misc]
            )
        return run_id
