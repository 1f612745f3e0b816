"""``slamhive algorithm test`` on a small project: real runs, and what is said of bounds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration

KEPT = "{poses: 30, ate_rmse_m: 0.1, alignment: se3, parameters: {seconds: 0}}"
BROKEN = "{poses: 30, ate_rmse_m: 0.1, alignment: se3, parameters: {seconds: 0, behaviour: crash}}"


@pytest.fixture
def slamhive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = make_project(tmp_path / "project") / "algorithms" / "tiny"
    for name in ("track", "other"):
        make_dataset(tmp_path / "data", name)
    with (package / "algorithm.yaml").open("a") as file:
        file.write(f"bounds: {{track: {{lidar: {KEPT}}}, other: {{lidar: {BROKEN}}}, absent: {{lidar: {KEPT}}}}}\n")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)

    def call(*arguments: str) -> Result:
        return CliRunner().invoke(main, ("algorithm", "test", *arguments))

    return call


def test_bounds_are_compared_with_runs(slamhive):
    tested = slamhive("tiny", "--json")
    assert tested.exit_code == 1
    kept, broken = json.loads(tested.stdout)
    assert (kept["bound"]["dataset"], kept["poses"], kept["problem"]) == ("track", 30, None)
    assert 0 < kept["ate_rmse_m"] < 0.1
    assert "the run is failed: " in broken["problem"]
    assert "not tested on absent, which is not here: tiny" in tested.stderr
    alone = slamhive("--all", "--dataset", "track")
    assert alone.exit_code == 0, alone.output
    assert alone.stdout.splitlines()[1].split()[-1] == "kept"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "name the algorithms to test, or give --all"),
        (("tny",), "did you mean 'tiny'?"),
        (("tiny", "--dataset", "nowhere"), "no bounds are stated for tiny on nowhere"),
        (("tiny", "--dataset", "absent"), "no dataset of the bounds is here: absent"),
    ],
)
def test_what_cannot_be_tested_is_one_line(slamhive, arguments, message):
    refused = slamhive(*arguments)
    assert refused.exit_code == 1
    assert message in refused.stderr
    assert len(refused.stderr.splitlines()) == 1
