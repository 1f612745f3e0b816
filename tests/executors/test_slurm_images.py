"""Images as folders, and the commands of container runtimes: archives as ``docker save`` writes them, made by hand."""

from __future__ import annotations

import io
import json
import tarfile
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import ExecutorContext, ImageMissing
from slamhive.executors.host import describe_host
from slamhive.executors.slurm.containers import container_orders, make_mount_points
from slamhive.executors.slurm.executor import SlurmExecutor, describe_node
from slamhive.executors.slurm.image_folders import ImageFolder, ImageFolders
from slamhive.executors.slurm.node import NodeReport
from slamhive.executors.slurm.remote import open_slurm
from slamhive.executors.slurm.runtimes import (
    ContainerOrders,
    Tried,
    apptainer,
    charliecloud,
    choose_runtime,
    podman,
    try_runtimes,
    write_sif,
)
from slamhive.executors.spec import RunInput, RunOutput
from tests.executors.test_slurm_units import SPEC

Entry = tuple[str, bytes | str | None]
"""A name, with the content of a file, ``->`` and target of a symbolic link, ``=`` and that of a hard link, or None."""

ORDERS = ContainerOrders(
    runtime="auto",
    image="/data/image/root",
    command=["python3", "/slamhive/mapping.py"],
    environment={"HOME": "/tmp", "A": "1,2 $X"},
    read={"/slamhive/dataset": "/work/dataset", "/slamhive/dataset/a.bag": "/bags/a.bag"},
    written={"/slamhive/result": "/runs/1/result"},
)


def add_file(archive: tarfile.TarFile, name: str, content: bytes, mode: int = 0o644) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.mode, member.mtime = len(content), mode, 1_000_000_000
    archive.addfile(member, io.BytesIO(content))


def layer_of(*entries: Entry) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as layer:
        for name, content in entries:
            if isinstance(content, bytes):
                add_file(layer, name, content, 0o4555)
                continue
            member = tarfile.TarInfo(name)
            member.type, member.mode = tarfile.DIRTYPE, 0o555
            if content is not None:
                member.type = tarfile.SYMTYPE if content.startswith("->") else tarfile.LNKTYPE
                member.linkname = content.lstrip("->=")
            layer.addfile(member)
    return stream.getvalue()


def archive_of(*layers: bytes) -> bytes:
    config = {"config": {"Env": ["PATH=/bin", "EMPTY="], "Labels": {"slamhive.content": "abc"}}}
    names = [f"blobs/sha256/{number}" for number in range(len(layers))]
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for name, layer in zip(names, layers, strict=True):
            add_file(archive, name, layer)
        add_file(archive, "config.json", json.dumps(config).encode())
        add_file(archive, "manifest.json", json.dumps([{"Config": "config.json", "Layers": names}]).encode())
    return stream.getvalue()


@pytest.fixture
def images(tmp_path: Path) -> ImageFolders:
    return ImageFolders(tmp_path)


def unpacked(images: ImageFolders, *layers: bytes) -> Path:
    found = images.find(images.add([archive_of(*layers)]))
    assert found is not None
    return found.root


def test_upper_layers_replace_and_remove_what_is_below(images):
    below = layer_of(
        ("usr", None), ("usr/a", b"old"), ("usr/b", b"b"), ("gone", None), ("gone/x", b"x"), ("link", "->usr/a"),
        ("emptied", None), ("emptied/old", b"1"), ("was-folder", None), ("was-folder/x", b"x"),
    )  # fmt: skip
    above = layer_of(
        ("usr/a", b"new"), (".wh.gone", b""), ("emptied/new", b"2"), ("emptied/.wh..wh..opq", b""), ("link", b"file"),
        ("was-folder", b"now a file"), ("usr/hard", "=usr/a"),
    )  # fmt: skip
    root = unpacked(images, below, above)
    assert (root / "usr/a").read_bytes() == (root / "usr/hard").read_bytes() == b"new"
    assert (root / "usr/b").exists()
    assert not (root / "gone").exists()
    assert [path.name for path in (root / "emptied").iterdir()] == ["new"]
    assert (root / "link").read_bytes() == b"file"
    assert (root / "was-folder").read_bytes() == b"now a file"
    assert (root / "slamhive/config.yaml").exists()


def test_files_belong_to_the_user_and_keep_their_time_but_no_special_rights(images):
    root = unpacked(images, layer_of(("bin", None), ("bin/program", b"x")))
    found = (root / "bin/program").stat()
    assert (found.st_mode & 0o7777, found.st_mtime) == (0o755, 1_000_000_000)
    assert (root / "bin").stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize(
    "layer",
    [
        [("../out", b"x")],
        [("a", "->/etc"), ("a/out", b"x")],
        [("a", "->.."), ("a/.wh.out", b"")],
        [("hard", "=../out")],
        [("slamhive", "->/tmp")],
    ],
)
def test_a_layer_that_leads_out_of_the_image_is_refused(images, tmp_path, layer):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(InvalidInput, match="a file behind a link"):
        images.add([archive_of(layer_of(*layer))])
    assert [path for path in (tmp_path / "image-folders").iterdir() if not path.name.endswith(".lock")] == []
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("content", [b"", b"no archive", archive_of()[:700]])
def test_what_is_no_archive_of_an_image(images, content):
    with pytest.raises(InvalidInput):
        images.add([content])


def test_an_image_is_unpacked_once_and_found_by_digest_and_label(images):
    content = archive_of(layer_of(("a", b"x")))
    identity = images.add([content[:1000], content[1000:]])
    (images.find(identity).root / "mark").touch()
    assert images.add([content]) == identity
    found = images.find(identity)
    assert (found.root / "mark").exists()
    assert found.environment == {"PATH": "/bin", "EMPTY": ""}
    assert images.with_label("slamhive.content", "abc") == identity
    assert images.with_label("slamhive.content", "other") is None
    images.remove(identity)
    assert images.find(identity) is None
    assert images.find("0123-4567") is None


def test_remains_of_a_killed_process_are_swept(images, tmp_path):
    left = tmp_path / "image-folders" / ".image-x"
    left.mkdir(parents=True)
    images.sweep()
    assert not left.exists()


def test_command_of_charliecloud():
    called = charliecloud("/usr/bin/ch-run", ORDERS)
    assert called.environment == {}
    assert called.arguments == [
        "/usr/bin/ch-run", "--unset-env=*", "--env-no-expand", "--set-env=HOME=/tmp", "--set-env=A=1,2 $X",
        "--private-tmp", "--bind=/work/dataset:/slamhive/dataset", "--bind=/bags/a.bag:/slamhive/dataset/a.bag",
        "--bind=/runs/1/result:/slamhive/result", "--cd=/tmp", "/data/image/root", "--", "python3",
        "/slamhive/mapping.py",
    ]  # fmt: skip


def test_command_of_apptainer():
    called = apptainer("apptainer", ORDERS)
    assert called.environment == {"APPTAINERENV_A": "1,2 $X"}
    assert called.arguments == [
        "apptainer", "--quiet", "exec", "--userns", "--containall", "--no-home", "--net", "--network=none",
        "--bind=/work/dataset:/slamhive/dataset:ro", "--bind=/bags/a.bag:/slamhive/dataset/a.bag:ro",
        "--bind=/runs/1/result:/slamhive/result:rw", "--pwd=/tmp", "/data/image/root", "python3",
        "/slamhive/mapping.py",
    ]  # fmt: skip


def test_the_home_folder_of_apptainer_is_an_option_of_its_own():
    called = apptainer("apptainer", replace(ORDERS, written={**ORDERS.written, "/tmp": "/runs/1/work/tmp"}))
    assert "--home=/runs/1/work/tmp:/tmp" in called.arguments
    assert "--no-home" not in called.arguments
    assert not [option for option in called.arguments if option.startswith("--bind") and ":/tmp:" in option]


def test_an_image_is_packed_once(tmp_path):
    images, written = ImageFolders(tmp_path), list[Path]()
    identity = images.add([archive_of(layer_of(("usr/bin/tool", b"x")))])

    def write(root: Path, file: Path) -> None:
        written.append(root)
        file.write_bytes(b"SIF")

    def fail(_root: Path, file: Path) -> None:
        file.write_bytes(b"half")
        raise Unavailable("the disk is full")

    with pytest.raises(Unavailable):
        images.pack(identity, fail)
    unpacked = images.find(identity)
    assert unpacked is not None
    assert unpacked.sif is None
    images.pack(identity, write)
    images.pack(identity, write)
    found = images.find(identity)
    assert found is not None
    assert found.sif is not None
    assert written == [found.root]
    assert found.sif.read_bytes() == b"SIF"
    assert container_orders(SPEC, found, "apptainer").image == str(found.sif)
    assert container_orders(SPEC, found, "auto").image == str(found.root)
    images.remove(identity)
    assert images.find(identity) is None
    assert not found.sif.exists()


def test_apptainer_that_fails_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Unavailable, match="apptainer cannot be started"):
        write_sif(tmp_path, tmp_path / "a.sif")
    (tmp_path / "apptainer").write_text("#!/bin/sh\necho 'FATAL: no\n mksquashfs' >&2\nexit 255\n")
    (tmp_path / "apptainer").chmod(0o755)
    with pytest.raises(Unavailable, match=r"apptainer build failed: FATAL: no mksquashfs$"):
        write_sif(tmp_path, tmp_path / "a.sif")


def test_command_of_podman():
    called = podman("podman", ORDERS)
    assert called.environment == {}
    assert called.arguments == [
        "podman", "run", "--rm", "--network=none", "--cgroups=disabled", "--log-driver=none", "--cap-drop=all",
        "--security-opt=no-new-privileges", "--read-only", "--userns=keep-id", "--env=HOME=/tmp", "--env=A=1,2 $X",
        "--volume=/work/dataset:/slamhive/dataset:ro", "--volume=/bags/a.bag:/slamhive/dataset/a.bag:ro",
        "--volume=/runs/1/result:/slamhive/result:rw", "--workdir=/tmp", "--rootfs", "/data/image/root", "python3",
        "/slamhive/mapping.py",
    ]  # fmt: skip


def test_the_first_usable_runtime_is_chosen():
    tried = [Tried("charliecloud", problem="no"), Tried("apptainer", "1.3"), Tried("podman", "5.0")]
    assert choose_runtime(tried).text == "Apptainer 1.3"
    with pytest.raises(LookupError, match="Charliecloud: no"):
        choose_runtime(tried[:1])


def test_a_node_without_runtimes_says_why(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert [entry.text for entry in try_runtimes()] == [
        "Charliecloud: there is no ch-run in PATH",
        "Apptainer: there is no apptainer in PATH",
        "Podman: there is no podman in PATH",
    ]
    assert [entry.key for entry in try_runtimes("podman")] == ["podman"]
    (tmp_path / "podman").write_text("#!/bin/sh\nexit 3\n")
    (tmp_path / "podman").chmod(0o755)
    (tried,) = try_runtimes("podman")
    assert "failed" in tried.problem or "user namespaces" in tried.problem


def test_what_a_node_offers_in_words():
    host = replace(describe_host(), cpu_model="Xeon", cpu_count=8, memory_bytes=16_000_000_000)
    report = NodeReport("n1", host, [Tried("charliecloud", problem="no ch-run"), Tried("podman", "4.3")])
    found = describe_node("node n1", report, "auto")
    assert (found.found, found.remedy) == ("Xeon, 8 CPUs, 16.0 GB; Podman 4.3; not Charliecloud: no ch-run", None)
    assert describe_node("node n1", report, "charliecloud").remedy is not None
    assert describe_node("node n1", report, "none").remedy is None


def test_a_node_that_does_not_reach_the_worker_says_why():
    report = NodeReport("n1", describe_host(), [Tried("podman", "4.3")], "certificate verify failed")
    found = describe_node("node n1", NodeReport.loads(json.dumps(asdict(report))), "auto", "https://hive.lab")
    assert found.found.endswith("; does not reach https://hive.lab: certificate verify failed")
    assert found.remedy is not None
    assert "update-ca-certificates" in found.remedy


def test_mount_points_lie_in_the_image_or_in_folders_of_the_run_alone(tmp_path):
    root, bag, package = tmp_path / "root", tmp_path / "a.bag", tmp_path / "scripts"
    root.mkdir()
    bag.touch()
    package.mkdir()
    inputs = (
        RunInput("slamhive", package, "/slamhive", own_copy=True),
        RunInput("bag", bag, "/slamhive/dataset/a.bag"),
        RunInput("weights", bag, "/slamhive-weights/a"),
    )
    spec = replace(
        SPEC,
        inputs=inputs,
        outputs=(RunOutput("result", tmp_path / "result", "/slamhive/result"),),
        work=tmp_path / "w",
    )
    make_mount_points(container_orders(spec, ImageFolder(root, {}, {}), "auto"))
    assert (tmp_path / "w/dataset/a.bag").is_file()
    assert (tmp_path / "w/slamhive/result").is_dir()
    assert (tmp_path / "w/slamhive/dataset").is_dir()
    assert (root / "slamhive-weights/a").is_file()
    assert not list(package.iterdir())


def test_containers_are_a_setting(tmp_path):
    context = ExecutorContext(tmp_path, tmp_path, "home")
    assert type(open_slurm(replace(context, options={"containers": "none"}))) is SlurmExecutor
    assert open_slurm(context).capabilities.needs != SlurmExecutor.capabilities.needs
    with pytest.raises(InvalidInput, match="SLURM_CONTAINERS='docker' is unknown"):
        open_slurm(replace(context, options={"containers": "docker"}))


@pytest.mark.parametrize("dockerfile", [True, False])
def test_without_docker_an_imported_image_without_a_dockerfile_is_asked_for_by_its_number(
    tmp_path, monkeypatch, dockerfile
):
    monkeypatch.setenv("DOCKER_HOST", f"unix://{tmp_path}/none")
    package = AlgorithmPackage("demo", tmp_path / "demo", "Demo", "1", "", "", "")
    (package.folder / "slamhive").mkdir(parents=True)
    if dockerfile:
        (package.folder / "Dockerfile").write_text("FROM scratch\n")
    executor = open_slurm(ExecutorContext(tmp_path, tmp_path, "home"))
    with pytest.raises(ImageMissing, match="demo has no image here, and Docker cannot build it") as caught:
        executor.build(package, lambda _line: None)
    assert ("import FILE, and run demo@NUMBER" in str(caught.value.remedy)) is not dockerfile
