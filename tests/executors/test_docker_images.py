"""Images: the base without a registry, and packages whose image does not keep the contract."""

from __future__ import annotations

import contextlib
import gc
import subprocess
import tarfile
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import docker
import docker.errors
import pytest

from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import ExecutorContext, ImageMissing
from slamhive.executors.cgroup import cgroup_of
from slamhive.executors.docker import images as docker_build
from slamhive.executors.docker.engine import closing_chunks
from slamhive.executors.docker.executor import DockerExecutor
from slamhive.executors.docker.foreign_images import DockerImages
from slamhive.executors.docker.images import (
    choose_base,
    find_image,
    follow_build,
    kept_name,
    make_image,
    packed_context,
)

pytestmark = pytest.mark.quick

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "docker" / "base" / "make-base.sh"


def test_build_tells_the_digest():
    events: list[dict[str, Any]] = [
        {"stream": "Step 1/1 : FROM base\n"},
        {"aux": {"ID": "sha256:abc"}},
        {"stream": "Successfully built\n"},
    ]
    assert follow_build(events, "demo", lambda line: None) == "sha256:abc"
    assert follow_build(events[:1], "demo", lambda line: None) is None


def test_a_packed_context_has_no_name_that_a_killed_process_would_leave(tmp_path, monkeypatch):
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "Dockerfile").write_text("FROM base\n")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    with packed_context(tmp_path, ["temporary"]) as packed:
        assert list((tmp_path / "temporary").iterdir()) == []
        with tarfile.open(fileobj=packed) as archive:
            assert set(archive.getnames()) == {"part", "part/Dockerfile"}


@pytest.fixture
def script(tmp_path) -> Path:
    """The script that makes the base, on a machine that has what the test puts into ``bin`` and ``sbin``."""
    for folder in ("bin", "sbin"):
        (tmp_path / folder).mkdir()
    (tmp_path / "keyring").touch()
    for name in ("subuid", "subgid"):
        (tmp_path / name).write_text("dev:100000:65536\n")
    (tmp_path / "bin" / "grep").symlink_to("/bin/grep")
    places = {"/usr/local/sbin:/usr/sbin:/sbin": tmp_path / "sbin", "/etc/sub": tmp_path / "sub"}
    places["/usr/share/keyrings/debian-archive-keyring.gpg"] = tmp_path / "keyring"
    text = SCRIPT.read_text()
    for known, place in places.items():
        assert known in text
        text = text.replace(known, str(place))
    copy: Path = tmp_path / "make-base.sh"
    copy.write_text(text)
    return copy


def put(script: Path, folder: str, name: str, says: str = "exit 0") -> None:
    program = script.parent / folder / name
    program.write_text(f"#!/bin/sh\n{says}\n")
    program.chmod(0o755)


def check(script: Path, uid: int) -> tuple[int, str]:
    """Exit code and words of ``make-base.sh --check`` for a user."""
    put(script, "bin", "id", f'[ "$1" = -u ] && echo {uid} || echo dev')
    environment = {"PATH": str(script.parent / "bin")}
    made = subprocess.run(["/bin/sh", script, "--check"], env=environment, capture_output=True, text=True, check=False)
    return made.returncode, (made.stdout + made.stderr).strip()


@pytest.mark.parametrize(
    ("uid", "words"),
    [
        (0, "missing: debootstrap; apt-get install debootstrap"),
        (1000, "missing: mmdebstrap uidmap; sudo apt-get install mmdebstrap uidmap"),
    ],
)
def test_base_script_asks_for_what_is_missing_in_one_line(script, uid, words):
    assert check(script, uid) == (1, words)


def test_base_script_finds_programs_of_the_administrator(script):
    put(script, "sbin", "debootstrap")
    assert check(script, 0) == (0, "making a minimal Debian with debootstrap (this is root)")
    (script.parent / "keyring").unlink()
    assert check(script, 0)[1] == "missing: debian-archive-keyring; apt-get install debian-archive-keyring"


def test_base_script_takes_a_user_namespace_without_root(script):
    put(script, "sbin", "debootstrap")
    for name in ("mmdebstrap", "newuidmap", "unshare"):
        put(script, "bin", name)
    way = "making a minimal Debian with mmdebstrap in a user namespace (only root can use debootstrap)"
    assert check(script, 1000) == (0, way)
    (script.parent / "subgid").write_text("")
    code, words = check(script, 1000)
    assert code == 1
    assert "dev has no user numbers" in words
    assert "sudo usermod --add-subuids 100000-165535 --add-subgids 100000-165535 dev" in words
    put(script, "bin", "unshare", "exit 1")
    code, words = check(script, 1000)
    assert code == 1
    assert "user namespaces are forbidden here" in words
    assert "sudo sh docker/base/make-base.sh base.tar" in words


def test_base_script_does_not_use_docker():
    """The worker's container runs it too, and has no command of that name."""
    commands = [line for line in SCRIPT.read_text().splitlines() if not line.lstrip().startswith(("#", "base image:"))]
    assert not any(line.lstrip().startswith("docker") for line in commands)


@pytest.fixture
def name(engine) -> Iterator[str]:
    """A name for an image, removed at the end."""
    name = f"slam-hive-test:{uuid.uuid4().hex}"
    yield name
    with contextlib.suppress(docker.errors.ImageNotFound):
        engine.images.remove(name, force=True)


@pytest.mark.docker
def test_base_is_imported_without_the_docker_command(engine, name, tmp_path, monkeypatch):
    folder = tmp_path / "docker" / "base"
    folder.mkdir(parents=True)
    (tmp_path / "hello").write_text("hello")
    (folder / "make-base.sh").write_text(f'[ "$1" = --check ] || tar -C {tmp_path} -cf "$1" hello\necho by hand\n')
    monkeypatch.setattr(docker_build, "OWN_BASE", name)
    monkeypatch.setattr(docker_build, "PUBLIC_BASE", "localhost:9/nowhere:none")
    monkeypatch.setenv("PATH", "/bin")
    monkeypatch.setattr(docker_build, "SAME_AS_PUBLIC", ())
    said: list[str] = []
    assert choose_base(engine, tmp_path, said.append) == name
    assert f"{name}: by hand" in said
    assert engine.images.get(name).attrs["Config"]["Cmd"] == ["/bin/sh"]


@pytest.fixture
def no_public_base(name, monkeypatch) -> None:
    """An engine without a base image, where no registry answers."""
    monkeypatch.setattr(docker_build, "OWN_BASE", name)
    monkeypatch.setattr(docker_build, "PUBLIC_BASE", "localhost:9/nowhere:none")
    monkeypatch.setattr(docker_build, "SAME_AS_PUBLIC", ())


@pytest.mark.docker
def test_base_is_made_in_a_container_of_the_worker_where_this_machine_cannot(
    engine, name, base_image, no_public_base, tmp_path, monkeypatch
):
    folder = tmp_path / "docker" / "base"
    folder.mkdir(parents=True)
    script = '[ "$1" = /base.tar ] || { echo missing: mmdebstrap >&2; exit 1; }\necho x > /x; tar -C / -cf "$1" x\n'
    (folder / "make-base.sh").write_text(script)
    monkeypatch.setattr(docker_build, "WORKER_IMAGE", base_image)
    said: list[str] = []
    assert choose_base(engine, tmp_path, said.append) == name
    assert f"missing: mmdebstrap; so it is made in a container of {base_image}" in said
    assert engine.images.get(name)


@pytest.mark.docker
def test_a_base_that_cannot_be_made_names_the_command(engine, no_public_base, tmp_path, monkeypatch):
    folder = tmp_path / "docker" / "base"
    folder.mkdir(parents=True)
    (folder / "make-base.sh").write_text("echo 'missing: x; sudo apt-get install x' >&2; exit 1\n")
    monkeypatch.setattr(docker_build, "WORKER_IMAGE", "localhost:9/nowhere:worker")
    with pytest.raises(ImageMissing, match="cannot be made here: missing: x; sudo apt-get install x"):
        choose_base(engine, tmp_path, lambda line: None)


@pytest.mark.docker
def test_image_without_the_mapping_script_is_refused_every_time(engine, name, base_image, tmp_path, monkeypatch):
    monkeypatch.setenv("BASE_IMAGE", base_image)
    folder = tmp_path / "package"
    folder.mkdir()
    dockerfile = folder / "Dockerfile"
    dockerfile.write_text("ARG BASE_IMAGE\nFROM ${BASE_IMAGE}\n")
    tag = name.partition(":")[2]
    package = AlgorithmPackage(tag, folder, "Empty", "1", "", "", "")
    monkeypatch.setattr(AlgorithmPackage, "image", name)
    context = ExecutorContext(tmp_path, ROOT, installation=tag)
    for _ in range(2):
        with pytest.raises(ImageMissing, match=r"lacks /slamhive/mapping\.py"):
            make_image(engine, package, context, lambda line: None)
        assert find_image(engine, package, ROOT) is None
    (folder / "mapping.py").touch()
    dockerfile.write_text("ARG BASE_IMAGE\nFROM ${BASE_IMAGE}\nCOPY package/mapping.py /slamhive/mapping.py\n")
    digest = make_image(engine, package, context, lambda line: None)
    assert find_image(engine, package, ROOT) == digest


def open_sockets() -> int:
    return sum(path.is_socket() for path in Path("/proc/self/fd").iterdir())


@pytest.mark.docker
def test_what_is_refused_leaves_no_connection_open(engine, base_image, tmp_path):
    """Closing a client closes the connections at rest; an answer that was left in the middle keeps its own."""
    (tmp_path / "Dockerfile").write_text(f"FROM {base_image}\nRUN exit 3\n")
    container = engine.containers.create(base_image, ["true"], network_mode="none")
    gc.collect()  # what tests before this one have left
    open_before = open_sockets()
    kept: list[object] = []
    with contextlib.closing(docker.from_env()) as client:
        images = DockerImages(client, "test")
        with pytest.raises(ImageMissing, match="exit 3") as refused:
            images.build(tmp_path, "bad", lambda line: None)
        kept.append(refused)
        with pytest.raises(ImageMissing, match="pulling") as refused:
            images.pull("127.0.0.1:9/nothing:none", lambda line: None)
        kept.append(refused)
        stream = client.containers.get(container.id).get_archive("/etc")[0]
        kept.append(stream)
        with closing_chunks(stream) as chunks:
            assert next(chunks)
        stream = client.containers.get(container.id).get_archive("/etc/hostname")[0]
        kept.append(stream)
        with closing_chunks(stream):
            pass
    assert open_sockets() <= open_before, kept
    container.remove()


@pytest.mark.docker
def test_images_of_versions_are_kept_saved_loaded_and_forgotten(engine, name, tmp_path):
    repository, _, tag = name.partition(":")
    with tarfile.open(tmp_path / "files.tar", mode="w") as archive:
        archive.addfile(tarfile.TarInfo(tag))
    engine.api.import_image_from_file(str(tmp_path / "files.tar"), repository, tag)
    digest = engine.images.get(name).id
    package = AlgorithmPackage(f"test-{uuid.uuid4().hex[:8]}", tmp_path, "Kept", "1", "", "", "")
    executor = DockerExecutor(ExecutorContext(tmp_path, ROOT, installation=uuid.uuid4().hex))
    try:
        assert executor.has(package, digest)
        executor.keep(package, digest, 3)
        executor.keep(package, digest, 3)
        engine.images.remove(name)
        assert engine.images.get(digest).tags == [kept_name(package.name, 3, executor._context.installation)]
        saved = b"".join(executor.save_image(digest))
        executor.forget(package.name, digest, 3)
        assert not executor.has(package, digest)
        executor.forget(package.name, digest, 3)
        assert executor.load_image([saved]) == digest
        assert executor.has(package, digest)
        with pytest.raises(ImageMissing, match="is gone"):
            next(executor.save_image("sha256:" + "0" * 64))
    finally:
        executor.forget(package.name, digest, 3)
        executor.close()


@pytest.mark.docker
def test_control_group_is_found_without_the_processes_of_the_host(engine, base_image, tmp_path):
    container = engine.containers.run(base_image, ["sleep", "60"], detach=True, init=True, network_mode="none")
    try:
        group = cgroup_of(1, container.id, proc=tmp_path)
        assert group is not None
        usage = group.read()
        assert usage is not None
        assert usage[1] > 0
        assert cgroup_of(1, "0" * 64, proc=tmp_path) is None
    finally:
        container.remove(force=True)
