"""``slamhive claims``: exit codes, tables, JSON, the badge, and mistakes in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from slamhive.documents.claims import ClaimsAnswer
from tests.services.gate_world import add_good, errors_m
from tests.web import web_world as world

pytestmark = pytest.mark.integration  # scipy takes a second to load

FILE = """\
format: 1
name: paper
title: A paper
source: Table 1
claims:
  - {algorithm: eye-slam-stereo, dataset: room, states: {ate.rmse: 5.0 cm}}
  - {algorithm: eye-slam-mono, dataset: room, states: {ate.rmse: 5.0 cm}}
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Path:
    """A data root with eight runs of 5 cm."""
    folder = tmp_path_factory.mktemp("claims")
    hive = world.make_hive(folder, template=sqlite_template)
    add_good(hive, errors_m(8))
    hive.close()
    shutil.copytree(folder / "project" / "algorithms", folder / "data" / "algorithms")
    return folder / "data"


def claims(data: Path, *arguments: str) -> Result:
    return CliRunner().invoke(main, ["--data", str(data), "claims", *arguments])


def write(folder: Path, stated: str = "5.0 cm") -> str:
    path = folder / "claims.yaml"
    path.write_text(FILE.replace("5.0 cm", stated, 1))
    return str(path)


def test_the_exit_code_is_the_answer(data: Path, tmp_path: Path):
    path = write(tmp_path)
    only = ("--algorithm", "eye-slam-stereo")
    held = claims(data, "check", path, *only)
    assert (held.exit_code, "claims paper: 1 of 1 hold" in held.stderr) == (0, True), held.output
    assert claims(data, "check", path).exit_code == 3
    assert claims(data, "check", write(tmp_path, "2.0 cm"), *only).exit_code == 1
    assert claims(data, "check", write(tmp_path, "2.0 inch")).exit_code == 2


def test_a_whole_answer_is_kept_and_a_part_is_not(data: Path, tmp_path: Path):
    claims(data, "remove", "paper")
    path = write(tmp_path)
    claims(data, "check", path, "--algorithm", "eye-slam-stereo")
    assert json.loads(claims(data, "list", "--json").stdout) == []
    checked = json.loads(claims(data, "check", path, "--json").stdout)
    assert ClaimsAnswer.read(checked).content == checked
    assert json.loads(claims(data, "show", "paper", "--json").stdout) == checked
    badge = tmp_path / "claims.svg"
    assert claims(data, "badge", "paper", str(badge)).exit_code == 0
    assert "claims: 1 of 2 hold" in badge.read_text()
    assert "1 of 2 hold" in claims(data, "list").stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--executor", "process"), "--executor is for runs that the check makes; give --run, or leave it out"),
        (("--algorithm", "eye-slam-stero"), "did you mean 'eye-slam-stereo'?"),
        (("--algorithm", "eye-slam-stereo", "--dataset", "hall"), "unknown dataset of claims paper 'hall'"),
    ],
)
def test_mistakes_end_in_one_line(data: Path, tmp_path: Path, arguments: tuple[str, ...], said: str):
    result = claims(data, "check", write(tmp_path), *arguments)
    assert result.exit_code == 2
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_file_that_is_not_there_is_named(data: Path):
    result = claims(data, "check", "nowhere.yaml")
    assert result.exit_code == 2
    assert "nowhere.yaml" in result.stderr
