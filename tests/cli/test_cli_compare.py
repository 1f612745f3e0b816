"""``slamhive compare``: the table, JSON, the path of the page, mistakes in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from slamhive.domain.protocol import Alignment, Protocol
from tests.web import web_world as world

pytestmark = pytest.mark.quick


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with runs 1 and 6, evaluated; they differ in one parameter and in their error."""
    folder = tmp_path_factory.mktemp("compare")
    hive = world.make_hive(folder)
    world.fill(hive)
    (other,) = world.add_runs(hive, nFeatures=500)
    world.finish_run(hive, other)
    world.evaluate_run(hive, other, 0.5)
    hive.close()
    return folder / "data"


def compare(data: Path, *arguments: str) -> Result:
    return CliRunner().invoke(main, ["--data", str(data), "compare", *arguments])


def test_the_table_shows_what_differs_and_marks_the_better_value(data: Path):
    result = compare(data, "1", "6")
    assert result.exit_code == 0, result.output
    rows = [line.split() for line in result.stdout.splitlines()]
    assert ["parameter.nFeatures", "2000", "500"] in rows
    assert ["ATE", "RMSE", "m", "*", "0.0457", "0.5"] in rows
    assert "parameter.scale" not in result.stdout
    assert "parameter.scale" in compare(data, "1", "6", "--all").stdout
    assert rows[-1] == [f"/compare?runs=1,6&protocol={world.PROTOCOL.fingerprint}"]


def test_json_names_the_best_run_and_the_runs_that_lack_the_protocol(data: Path):
    content = json.loads(compare(data, "1", "2", "6", "--json").stdout)
    assert content["metrics"]["ate.rmse"]["best"] == "1"
    assert content["metrics"]["ate.rmse"]["values"]["2"] is None
    assert content["protocol"]["lacking"] == [2]
    assert content["settings"]["parameter.nFeatures"] == {"1": "2000", "2": "2000", "6": "500"}


def test_runs_under_several_protocols_are_named_with_the_remedy(data: Path):
    hive = world.make_hive(data.parent)
    (mono,) = world.add_runs(hive, 1, "eye-slam-mono")
    world.finish_run(hive, mono)
    world.evaluate_run(hive, mono, protocol=Protocol(Alignment.SIM3))
    fingerprint = Protocol(Alignment.SIM3).fingerprint
    hive.close()
    said = (
        "2 runs use SE(3), 1 Sim(3): not comparable. "
        f"Evaluate all under Sim(3): slamhive evaluate RUNS --protocol {fingerprint} --current"
    )
    assert said in compare(data, "1", "6", str(mono)).stderr
    assert json.loads(compare(data, "1", "6", str(mono), "--json").stdout)["not_comparable"] == said
    assert "not comparable" not in compare(data, "1", "6").stderr
    assert json.loads(compare(data, "1", "6", "--json").stdout)["not_comparable"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("1",), "1 run cannot be compared"), (("1", "99"), "unknown run 99"), (("1", "1"), "run 1 is named twice")],
)
def test_mistakes_are_one_line(data: Path, arguments: tuple[str, ...], message: str):
    result = compare(data, *arguments)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith(f"error: {message}")
    assert len(result.stderr.splitlines()) == 1
