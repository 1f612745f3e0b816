"""The same experiment gives the same table on Slurm, and on Kubernetes, as on Docker.

The same means what it means for a replay: errors are shown to differ by no more than its margin. A test for any
difference at all finds some hundredths of a millimetre between the errors of ORB-SLAM3.

The engines take turns. How fast a machine is drifts over minutes, and the errors of ORB-SLAM3 in real time with it.
"""

from __future__ import annotations

import statistics
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from slamhive.analysis.regression import Sample, rank_equivalence
from slamhive.domain.gate import REPLAY_MARGINS
from slamhive.domain.run import RunState
from slamhive.recordings.room import RoomOptions
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from tests.executors.kubernetes_cluster import KubernetesCluster

pytestmark = [pytest.mark.cluster, pytest.mark.long, pytest.mark.timeout(3600)]

FILE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "engines.yaml"
PACKAGES = ("kiss-icp", "rko-lio", "orb-slam3")
REPEATS, TURNS = 10, 5
SIGNIFICANCE = 0.05
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


@pytest.mark.parametrize("other", ["slurm", "kubernetes"])
def test_the_same_experiment_gives_the_same_table_as_on_docker(
    other: str, data: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    cluster = request.getfixturevalue(f"{other}_cluster")
    if isinstance(cluster, KubernetesCluster):
        cluster.use(monkeypatch)
    tables: dict[str, Table] = {engine: defaultdict(list) for engine in ("docker", other)}
    for turn in range(TURNS):
        for engine, table in tables.items():
            hive = open_hive({"data": data, "executor": engine, "worker_slots": 1})
            try:
                if isinstance(cluster, KubernetesCluster) and engine == other and turn == 0:
                    load_images(hive, cluster)
                take_turn(hive, engine, f"engines-{engine}-with-{other}-{turn}", table)
            finally:
                hive.close()
    for engine, table in tables.items():
        print_table(engine, table)
        assert {len(errors_m) for errors_m in table.values()} == {REPEATS}
    assert tables["docker"].keys() == tables[other].keys()
    differing = [name for name, values in tables["docker"].items() if not agree(values, tables[other][name])]
    assert differing == []


def load_images(hive: Hive, cluster: KubernetesCluster) -> None:
    """There is no registry: nodes get the images as files."""
    for package in PACKAGES:
        cluster.load(hive.catalogue.package(package).image)


def take_turn(hive: Hive, engine: str, name: str, table: Table) -> None:
    """Run some repeats of the experiment under a name, and add the error of each run to ``table``."""
    text = FILE.read_text().replace("name: engines", f"name: {name}")
    hive.experiments.start(ExperimentSource(text.replace(f"repeats: {REPEATS}", f"repeats: {REPEATS // TURNS}")))
    hive.worker().run(until_idle=True)
    for run in map(hive.runs.get, hive.experiments.run_ids(name)):
        assert run.state is RunState.SUCCEEDED, f"run {run.id} on {engine}: {run.detail}"
        assert run.metrics is not None
        assert run.executor == engine
        table[" ".join((run.algorithm, *(step.kind for step in run.variant)))].append(run.metrics["ate.rmse"])


def agree(first: list[float], second: list[float]) -> bool:
    """Whether both are shown to be within the margin of a replay, by its tests."""
    evidence = rank_equivalence(Sample(np.array(first), np.array(second)), REPLAY_MARGINS["ate.rmse"])
    return evidence.within < SIGNIFICANCE


def print_table(engine: str, table: Table) -> None:
    for name, errors_m in sorted(table.items()):
        mean_m, deviation_m = statistics.fmean(errors_m), statistics.stdev(errors_m)
        sys.stdout.write(f"{engine:<11} {name:<32} {mean_m:.4f} ± {deviation_m:.4f} m, n = {len(errors_m)}\n")
