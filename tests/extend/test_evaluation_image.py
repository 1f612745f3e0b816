"""The evaluation image: evaluators of plug-ins get into it, with what they need."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slamhive.evaluation.image_context import EvaluationContext, evaluator_code
from tests.extend.plugin_packages import CHECKOUT, EXTEND, Command, install, write_package
from tests.forked_commands import Run
from tests.services.docker_base import run_docker
from tests.services.tiny_project import make_dataset, make_project

NAME = "slam-hive-evaluation:evo"
NEEDY = """
import {1}
from slamhive.domain.metrics import Direction, Metric
from slamhive.evaluation.evaluators.base import MetricValues

POSES = Metric("{0}.poses", "Poses", "", Direction.NEUTRAL, "x")

class Count:
    keys = (POSES.key,)
    def evaluate(self, paired):
        return MetricValues({{POSES.key: float(len(paired.aligned))}})

COUNT = Count()
"""
NEEDY_TABLES = """
[project.entry-points."slamhive.metrics"]
{0} = "slamhive_{0}:POSES"
[project.entry-points."slamhive.evaluators"]
{0} = "slamhive_{0}:COUNT"
"""


def needy(folder: Path, name: str, dependency: str) -> Path:
    """A package whose evaluator needs another package."""
    module = f"slamhive_{name}"
    package = write_package(
        folder / module, module, NEEDY.format(name, dependency.partition(">")[0]), NEEDY_TABLES.format(name)
    )
    project = package / "pyproject.toml"
    project.write_text(project.read_text().replace("[project]", f'[project]\ndependencies = ["{dependency}"]'))
    return package


def test_without_plugins_it_is_as_ever(tmp_path: Path):
    context = EvaluationContext(CHECKOUT)
    assert context.image == NAME
    context.stage(tmp_path)
    assert list((tmp_path / "plugins").iterdir()) == []
    assert {path.name for path in (tmp_path / "package").iterdir()} == {"slamhive"}


@pytest.mark.integration
def test_plugins_make_another_image(examples: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    content = EvaluationContext(CHECKOUT).content
    monkeypatch.syspath_prepend(str(examples))
    context = EvaluationContext(CHECKOUT)
    assert context.image.startswith(f"{NAME}-")
    assert context.content != content
    context.stage(tmp_path)
    staged = {path.relative_to(tmp_path / "package").as_posix() for path in (tmp_path / "package").glob("slamhive_*/*")}
    assert staged == {f"slamhive_jerk-1.0.0.dist-info/{name}" for name in ("METADATA", "entry_points.txt")}
    assert (tmp_path / "package" / "slamhive_jerk.py").read_bytes() == (EXTEND / "metric.py").read_bytes()
    (examples / "__pycache__").mkdir(exist_ok=True)
    assert EvaluationContext(CHECKOUT).image == context.image


def test_a_package_that_is_edited_in_place_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder, code = tmp_path / "site" / "mine-2.0.dist-info", tmp_path / "code" / "mine"
    folder.mkdir(parents=True)
    code.mkdir(parents=True)
    (code / "__init__.py").write_text("EVALUATOR = 1\n")
    (code / "table.csv").write_text("1,2\n")
    (folder / "METADATA").write_text("Name: mine\nVersion: 2.0\nRequires-Dist: slamhive\nRequires-Dist: six>=1\n")
    (folder / "entry_points.txt").write_text("[slamhive.evaluators]\nmine = mine:EVALUATOR\n")
    (folder / "direct_url.json").write_text(json.dumps({"dir_info": {"editable": True}, "url": "file:///x"}))
    (folder / "RECORD").write_text("__editable__.mine.pth,,\n")
    monkeypatch.syspath_prepend(str(tmp_path / "code"))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    (found,) = evaluator_code()
    assert found.requirements == ("six>=1",)
    assert {"mine/__init__.py", "mine/table.csv"} < found.files.keys()
    (code / "table.csv").write_text("3,4\n")
    assert evaluator_code()[0].content != found.content


@pytest.mark.docker
def test_an_evaluator_works_in_the_image(examples: Path, carry_out: Run, tmp_path: Path, base_image: str):
    packages = [needy(tmp_path, "needy", "tabulate"), needy(tmp_path, "hopeless", "toolz>=999")]
    installed = install(packages, tmp_path / "installed")
    root = make_project(tmp_path / "project")
    (root / "docker").symlink_to(CHECKOUT / "docker")
    make_dataset(tmp_path / "data")
    Command(carry_out, root, tmp_path / "data").run(
        "run", "tiny", "track", "--set", "seconds=0.01", "--no-evaluate", "--wait"
    )
    command = Command(carry_out, root, tmp_path / "data", examples, installed, executor="docker")
    before = tags()
    try:
        told = command.run("evaluate", "1")
        metrics = command.json("runs", "show", "1")["metrics"]
        assert metrics["jerk.rms"]["value"] > 0, told.stderr
        assert metrics["needy.poses"]["value"] == 30
        assert "hopeless.poses" not in metrics
        (result,) = (tmp_path / "data").glob("runs/1/evaluation*/*/result.json")
        why = json.loads(result.read_text())["missing"]["hopeless"]
        assert "evaluator 'hopeless' of slamhive-hopeless 1.0.0 (slamhive_hopeless:COUNT) cannot be used" in why
        (made,) = tags() - before
        assert made.startswith(f"{NAME}-")
    finally:
        for tag in tags() - before:
            run_docker("rmi", "--force", tag)


def tags() -> set[str]:
    """The evaluation images with plug-ins that the engine has."""
    listed = run_docker("image", "ls", "--format", "{{.Repository}}:{{.Tag}}", NAME.partition(":")[0]).stdout
    return {tag for tag in listed.split() if tag.startswith(f"{NAME}-")}
