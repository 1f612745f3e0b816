"""Imported runs evaluated in the evaluation container: the figures are those of a plain process."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.cli.waiting import evaluate_to_end
from slamhive.domain.sensors import SensorSetup
from slamhive.services.hive import open_hive
from slamhive.services.imports.request import ImportRequest
from tests.services.imports.world import trajectory, write

pytestmark = [pytest.mark.integration, pytest.mark.docker]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    root = tmp_path / "source"
    write(root / "seq1" / "groundtruth.txt", trajectory())
    write(root / "building" / "relations.txt", "100 101 0.1 0 0 0 0 0\n")
    straight = "".join(f"{100 + i / 10} {i} 0 0 0 0 0 1\n" for i in range(30))
    for name, text in (("seq1/0", trajectory(1)), ("seq1/straight", straight), ("building/0", trajectory(2))):
        write(root / "alpha" / f"{name}.txt", text)
    return root


def evaluated(source: Path, data: Path, executor: str) -> dict[str, tuple[str | None, dict[str, float]]]:
    """{source: why it failed, figures} of every run."""
    hive = open_hive({"data": data, "executor": executor, "min_free_disk_mb": 1})
    try:
        request = ImportRequest(source, sensors={"": SensorSetup.STEREO})
        run_ids = hive.imports.carry_out(request, lambda _done, _total: None).run_ids
        service = hive.evaluations
        ended = evaluate_to_end(service, service.queue(run_ids))
        return {
            hive.runs.record(entry.run_id)["imported"]["source"]: (
                entry.reason,
                hive.runs.get(entry.run_id).metrics or {},
            )
            for entry in ended
        }
    finally:
        hive.close()


def test_the_container_finds_what_a_process_finds(source, tmp_path):
    in_container = evaluated(source, tmp_path / "one", "docker")
    assert in_container == evaluated(source, tmp_path / "other", "process")
    assert in_container["alpha/seq1/0.txt"][1]["ate.rmse"] > 0
    assert in_container["alpha/building/0.txt"][1]["relations.matched_fraction"] == 1
    reason, figures = in_container["alpha/seq1/straight.txt"]
    assert "straight line" in (reason or "")
    assert figures == {}
