"""The same experiment on Docker, Slurm and Kubernetes gives the same table."""

from __future__ import annotations

import math
import statistics
import sys
from collections import defaultdict
from pathlib import Path

import pytest
from scipy.stats import t as student_t

from slamhive.bags.room import RoomOptions
from slamhive.domain.run import RunState
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from tests.executors.kubernetes_cluster import KubernetesCluster
from tests.executors.slurm_cluster import Cluster

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(3600)]

FILE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "engines.yaml"
ENGINES = ("docker", "slurm", "kubernetes")
PACKAGES = ("kiss-icp", "rko-lio", "orb-slam3")
RUNS = 40
CONFIDENCE = 0.999
"""Twelve differences are looked at, so 0.95 would be exceeded by chance alone."""
Table = dict[str, list[float]]
"""ATE (m) of each run, by configuration."""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with the room, which all engines share."""
    folder = tmp_path_factory.mktemp("engines")
    hive = open_hive({"data": folder, "executor": "docker"})
    hive.catalogue.render_room(RoomOptions(name="room", duration_s=5.0), lambda _fraction, _text: None)
    hive.close()
    return folder


def test_the_same_experiment_gives_the_same_table_on_each_engine(
    data: Path, slurm_cluster: Cluster, kubernetes_cluster: KubernetesCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    kubernetes_cluster.use(monkeypatch)
    tables: dict[str, Table] = {}
    for engine in ENGINES:
        hive = open_hive({"data": data, "executor": engine, "worker_slots": 1})
        try:
            if engine == "kubernetes":
                load_images(hive, kubernetes_cluster)
            tables[engine] = table_of(hive, engine)
        finally:
            hive.close()
        print_table(engine, tables[engine])
    for first, second in (("docker", "slurm"), ("docker", "kubernetes"), ("slurm", "kubernetes")):
        assert tables[first].keys() == tables[second].keys()
        differing = [name for name, values in tables[first].items() if not agree(values, tables[second][name])]
        assert differing == [], f"{first} and {second}"


def load_images(hive: Hive, cluster: KubernetesCluster) -> None:
    """There is no registry: nodes get the images as files."""
    for package in PACKAGES:
        cluster.load(hive.catalogue.package(package).image)


def table_of(hive: Hive, engine: str) -> Table:
    """Run the experiment; the error of each run, by configuration."""
    text = FILE.read_text().replace("name: engines", f"name: engines-{engine}")
    hive.experiments.start(ExperimentSource(text))
    hive.worker().run(until_idle=True)
    table: Table = defaultdict(list)
    runs = [hive.runs.get(run_id) for run_id in hive.experiments.run_ids(f"engines-{engine}")]
    assert len(runs) == RUNS
    for run in runs:
        assert run.state is RunState.SUCCEEDED, f"run {run.id} on {engine}: {run.detail}"
        assert run.metrics is not None
        assert run.executor == engine
        table[" ".join((run.algorithm, *(step.kind for step in run.variant)))].append(run.metrics["ate.rmse"])
    return table


def agree(first: list[float], second: list[float]) -> bool:
    """Whether the interval of the difference of the means holds 0, by Welch."""
    variances = [statistics.variance(values) / len(values) for values in (first, second)]
    difference_m = abs(statistics.fmean(first) - statistics.fmean(second))
    if not sum(variances):
        return math.isclose(difference_m, 0.0, abs_tol=1e-9)
    shares = sum(variance**2 / (len(values) - 1) for variance, values in zip(variances, (first, second), strict=True))
    limit = student_t.ppf((1 + CONFIDENCE) / 2, sum(variances) ** 2 / shares)
    return bool(difference_m <= limit * math.sqrt(sum(variances)) + 1e-9)


def print_table(engine: str, table: Table) -> None:
    for name, errors_m in sorted(table.items()):
        mean_m, deviation_m = statistics.fmean(errors_m), statistics.stdev(errors_m)
        sys.stdout.write(f"{engine:<11} {name:<32} {mean_m:.4f} ± {deviation_m:.4f} m, n = {len(errors_m)}\n")
