"""Niceness is kept from the request to the record, by retries and when the database is rebuilt."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slamhive.documents.submission import Submission
from slamhive.executors.kubernetes.run_files import order_of
from slamhive.executors.slurm.containers import container_orders
from slamhive.executors.slurm.image_folders import ImageFolder
from slamhive.experiments.file import parse_experiment
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex
from slamhive.services.runs.record import spec_from_json
from tests.services.fake_executor import FakeExecutor

ONE = "name: one\nalgorithms: tiny\ndatasets: track\n"


@pytest.mark.integration
def test_niceness_is_kept_from_request_to_record(hive: Hive, tmp_path: Path) -> None:
    hive.executors.opened["process"] = FakeExecutor()
    (run,) = hive.runs.submit(Submission("tiny", "track", nice=7, evaluate=False))
    assert hive.runs.get(run.id).nice == 7
    hive.worker().run(until_idle=True)
    record = json.loads((hive.runs.folder(run.id).record).read_text())
    assert record["request"]["nice"] == 7
    assert record["spec"]["command"][3:] == ["7", "/slamhive/mapping.py"]
    spec = spec_from_json(record["spec"])
    in_pod, in_job = order_of(spec, log_max_bytes=1000), container_orders(spec, ImageFolder(tmp_path, {}, {}), "auto")
    assert in_pod["command"] == in_job.command == list(spec.command)
    assert container_orders(spec, ImageFolder(tmp_path, {}, {}), "auto").command == list(spec.command), ()
    assert hive.runs.in_full(run.id).content["limits"]["nice"] == 7
    assert run.stated["Niceness"] == 7
    assert hive.runs.retry(run.id).nice == 7
    reindex(hive, lambda _done, _total: None)
    assert hive.runs.get(run.id).nice == 7


def test_stored_experiments_keep_their_hash() -> None:
    plain, stated = parse_experiment(ONE), parse_experiment(ONE + "limits: {nice: 0}\n")
    assert plain.content_hash == stated.content_hash
    asked = parse_experiment(ONE + "limits: {nice: 4}\n")
    assert asked.content_hash != plain.content_hash
    assert asked.options["nice"] == 4


BUDGETS = """\
name: budgets
algorithms: tiny
datasets: track
limits: {cpus: 0.5 | 1, slow_down: 1 | 4}
evaluate: false
executor: process
"""


@pytest.mark.integration
def test_limits_of_an_experiment_are_cells_and_are_searched_and_survive_the_database(hive: Hive) -> None:
    engine = hive.executors.opened["process"] = FakeExecutor()
    hive.experiments.start(ExperimentSource(BUDGETS, "budgets.yaml"))
    hive.worker().run(until_idle=True)

    def found(where: str) -> list[tuple[float | None, float]]:
        runs = hive.runs.page(hive.searches.read(where)).records
        return sorted((run.cpu_cores, run.slow_down) for run in runs)

    assert found("experiment = budgets") == [(0.5, 1.0), (0.5, 4.0), (1.0, 1.0), (1.0, 4.0)]
    assert len({run.configuration_id for run in hive.runs.page().records}) == 1
    assert {spec.limits.cpu_cores for spec in engine.starts} == {0.5, 0.125, 1.0, 0.25}
    assert found("cpu_cores < 1 cores and slow_down = 4") == [(0.5, 4.0)]
    reindex(hive, lambda _done, _total: None)
    assert found("cpu_cores = 1") == [(1.0, 1.0), (1.0, 4.0)]
    cells = hive.experiments.axes("budgets")
    assert {name: sorted(values) for name, values in cells.items() if name in ("cpu_cores", "slow_down")} == {
        "cpu_cores": [0.5, 1.0],
        "slow_down": [1.0, 4.0],
    }
