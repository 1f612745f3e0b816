"""The commands of the job examples for continuous integration are executed, as the services would."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.services.imports.world import trajectory, write
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples" / "ci"


def example(name: str) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((EXAMPLES / name).read_text())
    return content


def call(command: str) -> Result:
    """A command of SLAM Hive in this process, with variables as the shell expands them."""
    program, *arguments = [os.path.expandvars(part) for part in shlex.split(command)]
    assert program == "slamhive"
    return CliRunner().invoke(main, arguments)


def execute(script: Sequence[str]) -> int:
    """The lines until one fails, as a job does; the exit code of the last."""
    for line in script:
        if line.startswith("slamhive "):
            result = call(line)
            if result.exit_code:
                assert result.exception is None or isinstance(result.exception, SystemExit), result.output
                return result.exit_code
        else:
            subprocess.run(["bash", "-euc", line], check=True)
    return 0


def enter(patch: pytest.MonkeyPatch, folder: Path, variables: Mapping[str, str]) -> None:
    """Work in ``folder``, the workspace of a job with these variables."""
    folder.mkdir(parents=True, exist_ok=True)
    patch.chdir(folder)
    for key, value in variables.items():
        patch.setenv(key, value.replace("${{ github.workspace }}", str(folder)))


def results_of_junit() -> dict[str, list[str]]:
    """{metric: what its test case holds}."""
    cases = ET.parse("gate.xml").getroot().iter("testcase")
    return {case.attrib["name"]: [child.tag for child in case] for case in cases}


def run_sequences(folder: Path, noise_m: float, seed: int) -> None:
    """What the project's script leaves: trajectories of five trials on two sequences, and ground truths."""
    for place, sequence in enumerate(("seq1", "seq2")):
        write(folder / sequence / "groundtruth.txt", trajectory())
        truth = np.array([line.split() for line in trajectory().splitlines()], dtype=float)
        for trial in range(5):
            noise = np.random.default_rng([seed, place, trial]).normal(0, noise_m, (len(truth), 3))
            moved = truth + np.column_stack([np.zeros(len(truth)), noise, np.zeros((len(truth), 4))])
            rows = "".join(" ".join(f"{value:.6f}" for value in row) + "\n" for row in moved)
            write(folder / "my-slam" / sequence / f"{trial}.txt", rows)


def test_the_job_for_github_compares_trajectories_with_a_committed_baseline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    workflow = example("github.yml")
    steps = workflow["jobs"]["gate"]["steps"]
    script = [step["run"] for step in steps if step.get("run", "").startswith("slamhive ")]
    assert [line.split()[1] for line in script] == ["runs", "gate"]
    make_project(tmp_path / "installation")
    variables = {**environment(tmp_path / "installation", tmp_path / "unused"), **workflow["env"]}

    enter(monkeypatch, tmp_path / "main", variables)
    run_sequences(Path("trajectories"), 0.02, seed=1)
    assert call(script[0]).exit_code == 0
    assert call('slamhive gate baseline main --where "algorithm = $ALGORITHM"').exit_code == 0
    (tmp_path / "branch" / "ci").mkdir(parents=True)
    assert call(f"slamhive gate export main {tmp_path}/branch/ci/baseline.json").exit_code == 0

    enter(monkeypatch, tmp_path / "branch", variables)
    run_sequences(Path("trajectories"), 0.03, seed=2)
    assert call(f"{script[0]} --no-evaluate").exit_code == 0
    assert execute([f"{script[1]} --evaluate"]) == 1
    assert results_of_junit() == {"failures": [], "ate.rmse": ["failure"], "tracked.path": []}
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "summary.md"))
    (summary,) = [step["run"] for step in steps if "GITHUB_STEP_SUMMARY" in step.get("run", "")]
    assert execute([summary]) == 0
    assert "SLAM Hive gate main: worse" in (tmp_path / "summary.md").read_text()


def repeat_in(file: Path, count: int) -> None:
    """Hold the run of a baseline ``count`` times: the algorithm gives the same trajectory each time."""
    content = json.loads(file.read_text())
    (configuration,) = content["configurations"]
    (run,) = configuration["runs"]
    configuration["runs"] = [{**run, "uid": f"{place:032x}", "seed": place} for place in range(count)]
    file.write_text(json.dumps(content))


def test_the_job_for_gitlab_runs_the_package_of_the_branch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    job = example("gitlab.yml")["slam-gate"]
    assert job["allow_failure"]["exit_codes"] == [3]
    project = make_project(tmp_path / "installation")
    make_dataset(tmp_path / "data")
    variables = {**job["variables"], **environment(project, tmp_path / "data"), "PACKAGE": "tiny", "ALGORITHM": "tiny"}
    variables["REPEATS"] = "3"  # each takes a second
    enter(monkeypatch, tmp_path / "checkout", variables)
    package = Path("ci") / "package" / "slamhive"
    package.mkdir(parents=True)
    assert call("slamhive run tiny track --set seconds=0 --evaluate --wait").exit_code == 0
    assert call("slamhive gate baseline main --where 'algorithm = tiny'").exit_code == 0
    assert call("slamhive gate export main ci/baseline.json").exit_code == 0
    repeat_in(Path("ci/baseline.json"), 15)

    code = (project / "algorithms" / "tiny" / "slamhive" / "mapping.py").read_text()
    (package / "mapping.py").write_text(f"{code}\nraise RuntimeError('broken by this branch')\n")
    assert execute(job["script"]) == 1
    results = results_of_junit()
    assert (results["failures"], results["ate.rmse"]) == (["failure"], ["failure"])
    assert "| tiny on track | Failed runs | 0 of 15 | 3 of 3 |" in Path("gate.md").read_text()
