"""The part of the package that goes into the evaluation image works without the rest."""

import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.base.errors import Unavailable
from slamhive.evaluation.image_context import EvaluationContext

ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.mark.integration
def test_the_staged_script_runs_on_its_own(tmp_path: Path) -> None:
    certificate = tmp_path / "lab.crt"
    certificate.write_text("x")
    context = tmp_path / "context"
    context.mkdir()
    EvaluationContext(ROOT).stage(context, [certificate])
    assert {path.name for path in context.iterdir()} == {
        "Dockerfile",
        "requirements.txt",
        "evaluate.py",
        "package",
        "plugins",
        "ca-certificates",
    }
    assert (context / "ca-certificates" / "lab.crt").exists()
    job = tmp_path / "job.json"
    job.write_text('{"format": 1, "tasks": []}')
    environment = {"PYTHONPATH": str(context / "package"), "TMPDIR": str(tmp_path)}
    command = [sys.executable, str(context / "evaluate.py"), str(job)]
    ended = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, ""), ended.stderr


def test_a_missing_script_is_named(tmp_path: Path) -> None:
    (tmp_path / "context").mkdir()
    with pytest.raises(Unavailable, match="Dockerfile"):
        EvaluationContext(tmp_path).stage(tmp_path / "context")
