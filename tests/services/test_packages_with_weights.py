"""A package with weights, a GPU or an image by digest: what its runs find, and what is refused before they start."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.base.errors import Unavailable
from slamhive.cli.main import main
from slamhive.documents.submission import Submission
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.gpu import list_gpus
from slamhive.services.hive import Hive, open_hive
from tests.services.docker_base import forget_kept_images, run_docker
from tests.services.tiny_project import ALGORITHM, environment, make_dataset, make_project

CONTENT = b"numbers"
WEIGHTS = f"""
weights:
- {{name: net.pth, licence: MIT, page: "https://example.org/page", sha256: {hashlib.sha256(CONTENT).hexdigest()}}}
"""
MAPPING = """
import json, os, pathlib
path = pathlib.Path(os.environ["SLAMHIVE_WEIGHTS"]) / "net.pth"
tried = {"path": str(path), "content": path.read_text()}
changes = {
    "written": lambda: path.write_text("x"), "removed": path.unlink, "moved": lambda: path.rename("/tmp/x")
}
for name, change in changes.items():
    try:
        change()
        tried[name] = None
    except OSError as error:
        tried[name] = error.strerror
result = pathlib.Path("/slamhive/result")
(result / "tried.json").write_text(json.dumps(tried))
(result / "traj.txt").write_text("".join(f"{100 + i / 3:.6f} {i} 0 0 0 0 0 1\\n" for i in range(30)))
(result / "finished").touch()
"""
EXPERIMENT = "name: two\nalgorithms: tiny\ndatasets: track\nrepeats: 2\n"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the package ``tiny``, in an installation."""
    root = make_project(tmp_path / "project")
    make_dataset(tmp_path / "data")
    for key, value in environment(root, tmp_path / "data", executor="docker").items():
        monkeypatch.setenv(key, value)
    return root / "algorithms" / "tiny"


@pytest.fixture
def hive(project: Path, base_image: str) -> Iterator[Hive]:
    """An installation whose package has weights, and the image of the tests by its digest."""
    digest = run_docker("image", "inspect", "--format", "{{.Id}}", base_image).stdout.strip()
    image = f"image: slam-hive-test@{digest}\n"
    (project / "algorithm.yaml").write_text(ALGORITHM + image + WEIGHTS)
    (project / "Dockerfile").unlink()
    (project / "slamhive" / "mapping.py").write_text(MAPPING)
    opened = open_hive()
    yield opened
    opened.close()
    forget_kept_images([path.read_text() for path in opened.settings.data.glob("installation")])


def run(hive: Hive) -> int:
    (submitted,) = hive.runs.submit(Submission("tiny", "track", executor="docker", evaluate=False))
    hive.worker().run(until_idle=True)
    return submitted.id


def call(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.mark.docker
def test_a_run_reads_its_weights_but_cannot_change_them(hive: Hive, tmp_path: Path) -> None:
    (tmp_path / "net.pth").write_bytes(CONTENT)
    refused = call("run", "tiny", "track")
    assert "tiny needs the weights net.pth, which are not here" in refused.stderr
    assert call("algorithm", "weights", "tiny", "--file", tmp_path / "net.pth").exit_code == 0
    good = hive.runs.get(run(hive))
    assert good.state is RunState.SUCCEEDED, good.detail
    tried = json.loads((hive.runs.folder(good.id).result / "tried.json").read_text())
    assert tried["path"] == "/slamhive-weights/net.pth"
    assert tried["content"] == CONTENT.decode()
    assert tried["written"] == "Read-only file system"
    assert tried["removed"] is not None
    assert tried["moved"] is not None
    assert hive.runs.record(good.id)["weights"] == {"net.pth": hashlib.sha256(CONTENT).hexdigest()}

    stored = hive.settings.data / "weights" / "tiny" / "net.pth"
    assert stored.read_bytes() == CONTENT
    stored.chmod(0o644)
    stored.write_bytes(b"changed")
    failed = hive.runs.get(run(hive))
    assert (failed.state, failed.reason) == (RunState.FAILED, FailureReason.PREPROCESS_ERROR)
    assert failed.started_at is None
    assert failed.detail == (
        "weights/tiny/net.pth is not what the weights net.pth were: "
        f"SHA-256 {hashlib.sha256(b'changed').hexdigest()}, expected "
        f"{hashlib.sha256(CONTENT).hexdigest()}; use the file that https://example.org/page publishes"
    )


@pytest.mark.docker
def test_a_run_whose_pinned_image_is_another_one_ends_with_one_line(hive: Hive, project: Path, tmp_path: Path) -> None:
    (tmp_path / "net.pth").write_bytes(CONTENT)
    assert call("algorithm", "weights", "tiny", "--file", tmp_path / "net.pth").exit_code == 0
    file = project / "algorithm.yaml"
    wanted = f"127.0.0.1:9/slam-hive-test@sha256:{'0' * 64}"
    file.write_text(ALGORITHM + f"image: {wanted}\n" + WEIGHTS)
    failed = hive.runs.get(run(hive))
    assert (failed.state, failed.reason) == (RunState.FAILED, FailureReason.IMAGE_MISSING)
    assert failed.detail is not None
    assert failed.detail.startswith(f"tiny wants the image {wanted}, which is not here: ")
    assert "\n" not in failed.detail


@pytest.mark.docker
@pytest.mark.parametrize("command", [("run", "tiny", "track"), ("experiment", "plan"), ("experiment", "start")])
def test_a_package_that_requires_a_gpu_is_refused_in_one_line_where_there_is_none(
    project: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    try:
        list_gpus()
    except Unavailable as error:
        reason = error.message
    else:
        pytest.skip("this machine has a GPU")
    (project / "algorithm.yaml").write_text(ALGORITHM + "gpu: required\n")
    file = tmp_path / "two.yaml"
    file.write_text(EXPERIMENT)
    refused = call(*command, *([file] if command[0] == "experiment" else []))
    assert refused.exit_code != 0
    told = [line for line in refused.stderr.splitlines() if not line.startswith("checking: ")]
    (line,) = told
    assert f"tiny requires a GPU: {reason}; " in line
    assert reason.startswith("there is no GPU here: ")
