"""Packages that name their image by digest: from a registry, loaded from an archive, and refused if it is another."""

from __future__ import annotations

import contextlib
import io
import tarfile
import uuid
from collections.abc import Iterator

import docker
import pytest

from slamhive.base.project import project_root
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.domain.packages import PinnedImage
from slamhive.executors.base import ExecutorContext, ImageMissing
from slamhive.executors.docker.executor import DockerExecutor
from slamhive.executors.docker.foreign_images import DockerImages, repository_and_tag
from slamhive.executors.kubernetes.run_jobs import NodeImages
from tests.executors.registry_server import running_registry

pytestmark = pytest.mark.quick

NOWHERE = "127.0.0.1:9/nothing"
DIGEST = "sha256:" + "0" * 64


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("loam", ("loam", "latest")),
        ("lab/loam:2", ("lab/loam", "2")),
        ("host:5000/loam", ("host:5000/loam", "latest")),
        (f"host:5000/loam@{DIGEST}", ("host:5000/loam", DIGEST)),
        (f"host:5000/loam:2@{DIGEST}", ("host:5000/loam", DIGEST)),
    ],
)
def test_what_the_engine_is_asked_to_pull(name, parts):
    assert repository_and_tag(name) == parts


def test_nodes_of_kubernetes_pull_it_by_its_digest_whatever_the_registry_of_own_images(tmp_path):
    (tmp_path / "Dockerfile").write_text("FROM scratch\n")
    images = NodeImages(ExecutorContext(tmp_path, project_root(), "installation"), "registry.example.org/ours")
    assert images.identity(pinned(tmp_path, f"lab/deep:1@{DIGEST}")) == f"lab/deep@{DIGEST}"


@pytest.fixture
def executor(tmp_path) -> Iterator[DockerExecutor]:
    with contextlib.closing(DockerExecutor(ExecutorContext(tmp_path, project_root(), uuid.uuid4().hex))) as opened:
        yield opened


def import_files(engine, repository: str, tag: str, *names: str) -> str:
    """Make an image of empty files, which nobody else has; its id."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for name in (*names, uuid.uuid4().hex):
            archive.addfile(tarfile.TarInfo(name))
    engine.api.import_image_from_data(packed.getvalue(), repository, tag)
    return str(engine.images.get(f"{repository}:{tag}").id)


def forget(engine, *names: str) -> None:
    for name in names:
        with contextlib.suppress(docker.errors.APIError):
            engine.images.remove(name, force=True)


def pinned(folder, image: str) -> AlgorithmPackage:
    return AlgorithmPackage("deep", folder, "Deep", "1", "https://x", "MIT", "c", pinned_image=PinnedImage.parse(image))


def refusal(executor, package) -> str:
    with pytest.raises(ImageMissing) as refused:
        executor.build(package, lambda _line: None)
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.docker
def test_an_image_of_a_registry_is_pulled_by_its_digest_and_no_other_is_taken(engine, executor, tmp_path):
    (tmp_path / "Dockerfile").write_text("FROM scratch\n")
    with running_registry(tmp_path) as address:
        repository = f"{address}/lab/deep"
        try:
            image = import_files(engine, repository, "1", "slamhive/mapping.py")
            engine.images.push(repository, tag="1")
            (reference,) = engine.images.get(image).attrs["RepoDigests"]
            digest = reference.partition("@")[2]
            assert digest != image
            package = pinned(tmp_path, f"{repository}:1@{digest}")
            forget(engine, image)
            assert executor.identity(package) is None
            assert executor.build(package, lambda _line: None) == image
            assert executor.identity(package) == image
            # Somebody gives the name and the tag to another image. The digest still means the first one.
            other = import_files(engine, repository, "1", "slamhive/mapping.py")
            engine.images.push(repository, tag="1")
            assert executor.identity(package) == image
            wrong = pinned(tmp_path, f"{repository}:1@{DIGEST}")
            said = refusal(executor, wrong)
            assert said.startswith(f"deep wants the image {repository}@{DIGEST}, but {repository}:1 is sha256:")
            assert other[:19] in said
            assert said.endswith("; push or load that image, or correct image in its algorithm.yaml")
            empty = import_files(engine, repository, "empty")
            engine.images.push(repository, tag="empty")
            (reference,) = engine.images.get(empty).attrs["RepoDigests"]
            forget(engine, empty)
            assert "lacks /slamhive/mapping.py" in refusal(executor, pinned(tmp_path, reference))
            tools = DockerImages(engine, uuid.uuid4().hex)
            assert tools.pull(f"{repository}:1@{digest}", lambda _line: None) == image
        finally:
            names = [name for entry in engine.images.list(repository) for name in (*entry.tags, entry.id)]
            forget(engine, *names)


@pytest.mark.docker
def test_a_loaded_image_is_known_by_its_id(engine, executor, tmp_path):
    repository, tag = f"slam-hive-test-{uuid.uuid4().hex[:8]}", "1"
    image = import_files(engine, repository, tag)
    try:
        saved = list(engine.images.get(f"{repository}:{tag}").save())
        forget(engine, f"{repository}:{tag}")
        package = pinned(tmp_path, f"{NOWHERE}@{image}")
        assert executor.identity(package) is None
        said = refusal(executor, package)
        assert said.startswith(f"deep wants the image {NOWHERE}@{image}, which is not here: ")
        engine.images.load(b"".join(saved))
        assert executor.identity(package) == executor.build(package, lambda _line: None) == image
    finally:
        forget(engine, image)
