"""``slamhive cite``: BibTeX for a run, an experiment and an analysis."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.web import web_world as world

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cite")
    hive = world.make_hive(folder)
    world.fill(hive)
    hive.close()
    return folder / "data"


def cite(data: Path, what: str) -> Result:
    return CliRunner().invoke(main, ["--data", str(data), "cite", what])


def test_everything_that_a_run_used(data: Path, tmp_path: Path):
    result = cite(data, "1")
    assert result.exit_code == 0, result.output
    for part in (
        "% SLAM Hive\n@misc{liu2024benchmarking,",
        "% evo\n@misc{grupp2017python,",
        "% no citation is known for eye-slam-stereo, room\n",
    ):
        assert part in result.stdout
    analysis = tmp_path / "analysis.yaml"
    analysis.write_text("name: n\nselect: {a: {runs: [1]}}\nforms: [{form: table}]\n")
    assert cite(data, str(analysis)).stdout == result.stdout


def test_a_name_of_nothing_is_a_mistake(data: Path):
    result = cite(data, "nothing")
    assert result.exit_code != 0
    assert "'nothing' is no run, no file and no experiment" in result.stderr
    assert cite(data, "77").exit_code != 0
