"""The images of the compose deployment, built and tried against a real database server."""

from __future__ import annotations

import json
import shutil
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Iterator
from pathlib import Path

import docker
import pytest
import yaml

from tests.services.docker_base import project_base
from tests.services.mariadb import DatabaseServer, reserve_port

ROOT = Path(__file__).resolve().parents[2]
HOST_CERTIFICATES = Path("/usr/local/share/ca-certificates")
START_S = 60.0
ALGORITHMS = {str(ROOT / "algorithms"): {"bind": "/opt/slamhive/share/slamhive/algorithms", "mode": "ro"}}

pytestmark = [pytest.mark.docker, pytest.mark.images, pytest.mark.mysql, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def engine() -> Iterator[docker.DockerClient]:
    client = docker.from_env()
    yield client
    client.close()


@pytest.fixture(scope="module")
def images(engine, tmp_path_factory) -> dict[str, str]:
    """Web and worker image, built as the compose file builds them, with the certificates of this machine."""
    context = tmp_path_factory.mktemp("context") / "project"
    shutil.copytree(ROOT, context, ignore=shutil.ignore_patterns(".git", ".venv", "data", "site", "tests", ".*_cache"))
    for path in HOST_CERTIFICATES.glob("*.crt"):
        shutil.copy(path, context / "docker" / "ca-certificates")
    base = project_base()
    tags = {}
    for name, service in yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"].items():
        if "build" in service:
            tags[name] = f"slam-hive-{name}:test"
            engine.images.build(
                path=str(context),
                dockerfile=service["build"]["dockerfile"],
                buildargs={"BASE_IMAGE": base},
                network_mode="host",
                tag=tags[name],
                rm=True,
            )
    return tags


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    folder.chmod(0o755)
    return folder


@pytest.fixture(scope="module")
def environment(database_server: DatabaseServer, data) -> Iterator[dict[str, str]]:
    name = f"slamhive_{uuid.uuid4().hex[:8]}"
    url = database_server.create_database(name)
    yield {
        "SLAMHIVE_DATABASE_URL": url,
        "SLAMHIVE_DATA": str(data),
        "SLAMHIVE_SECRET_KEY": "test",
        "SLAMHIVE_EXECUTOR": "docker",
        "HOME": "/tmp",
    }
    database_server.drop_database(name)


def run_container(engine, image: str, environment: dict[str, str], **options):
    name = f"slamhive-{uuid.uuid4().hex}"
    return engine.containers.run(
        image, detach=True, network_mode="host", hostname="slamhive", environment=environment, name=name, **options
    )


def health_check(name: str) -> list[str]:
    """The command of the compose file that tells whether a service is healthy."""
    kind, *words = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"][name]["healthcheck"]["test"]
    words = [word.replace("$$", "$") for word in words]
    return ["sh", "-c", *words] if kind == "CMD-SHELL" else words


def test_a_worker_that_has_not_started_is_not_healthy(engine, images, tmp_path):
    with pytest.raises(docker.errors.ContainerError) as raised:
        engine.containers.run(
            images["worker"],
            health_check("worker"),
            environment={"SLAMHIVE_DATA": "/data"},
            volumes={str(tmp_path): {"bind": "/data", "mode": "rw"}},
            hostname="slamhive",
            remove=True,
        )
    assert raised.value.exit_status == 1
    assert list(tmp_path.iterdir()) == []


def test_a_web_server_before_the_first_worker_says_what_is_missing(engine, images, tmp_path):
    tmp_path.chmod(0o755)
    with pytest.raises(docker.errors.ContainerError) as raised:
        engine.containers.run(
            images["web"],
            environment={"SLAMHIVE_DATA": "/data", "HOME": "/tmp", "SLAMHIVE_AUTH": "none"},
            volumes={str(tmp_path): {"bind": "/data", "mode": "ro"}},
            remove=True,
        )
    said = str(raised.value)
    assert "the folder /data/runs is missing, and cannot be made on a read-only file system; start" in said
    assert "Traceback" not in said


@pytest.fixture(scope="module")
def worker(engine, images, environment, data):
    """The worker as the compose file starts it: the engine's socket, the data root under the host's path."""
    volumes = {
        "/var/run/docker.sock": {"bind": "/var/run/docker.sock", "mode": "rw"},
        "/sys/fs/cgroup": {"bind": "/sys/fs/cgroup", "mode": "ro"},
        str(data): {"bind": str(data), "mode": "rw"},
        **ALGORITHMS,
    }
    service = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]["worker"]
    command = [word.replace("$$", "$") for word in service["command"]]
    container = run_container(engine, images["worker"], environment, command=command, volumes=volumes)
    yield container
    container.remove(force=True)


def doctor(container) -> tuple[int, dict[str, dict[str, str]]]:
    code, output = container.exec_run(["slamhive", "doctor", "--json"], demux=True)
    return code, {check["name"]: check for check in json.loads(output[0] or b"[]")}


def wait_for_tables(container, data: Path) -> dict[str, dict[str, str]]:
    deadline = time.monotonic() + START_S
    while not list(data.glob("worker-*.lock")) and time.monotonic() < deadline:
        time.sleep(0.1)  # doctor takes seconds of the processor, which the worker needs to start
    while True:
        code, checks = doctor(container)
        if code == 0 and checks.get("worker", {}).get("verdict") == "ok":
            return checks
        if time.monotonic() > deadline:
            pytest.fail(f"the worker does not come up: {checks}\n{container.logs(tail=20).decode()}")
        time.sleep(0.5)


def test_worker_reaches_database_and_engine(worker, data):
    checks = wait_for_tables(worker, data)
    assert checks["database"]["found"].startswith("mysql 127.0.0.1")
    assert checks["executor docker"]["verdict"] == "ok"
    assert checks["data root"]["verdict"] == "ok"
    code, output = worker.exec_run(health_check("worker"))
    assert code == 0, output


@pytest.fixture(scope="module")
def web(engine, images, environment, data, worker):
    """The web server as the compose file starts it, on a port of its own on 127.0.0.1."""
    wait_for_tables(worker, data)
    service = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]["web"]
    reserved, port = reserve_port()
    command = engine.images.get(images["web"]).attrs["Config"]["Cmd"]
    command = [{"0.0.0.0": "127.0.0.1", "5000": str(port)}.get(word, word) for word in command]
    container = run_container(
        engine,
        images["web"],
        environment,
        command=command,
        user=service["user"],
        cap_drop=service["cap_drop"],
        read_only=service["read_only"],
        security_opt=["no-new-privileges:true"],
        tmpfs=dict.fromkeys(service["tmpfs"], ""),
        volumes={
            str(data): {"bind": str(data), "mode": "ro"},
            **{
                str(data / name): {"bind": str(data / name), "mode": "rw"}
                for name in ("experiments", "challenges", "ledger")
            },
            **ALGORITHMS,
        },
    )
    yield container, f"http://127.0.0.1:{port}"
    container.remove(force=True)
    reserved.close()


def get(url: str) -> bytes:
    deadline = time.monotonic() + START_S
    while True:
        try:
            with urllib.request.urlopen(url, timeout=5) as response:
                return bytes(response.read())
        except (urllib.error.URLError, ConnectionError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.3)


def test_web_server_is_healthy_without_rights(web):
    container, url = web
    try:
        assert json.loads(get(f"{url}/healthz"))["status"] == "ok"
    except OSError:
        pytest.fail(f"the web server does not answer:\n{container.logs(tail=20).decode()}")
    code, output = container.exec_run(["id", "-u"])
    assert (code, output.strip()) == (0, b"65534")


def test_health_check_of_the_compose_file_passes(web):
    container, url = web
    get(f"{url}/healthz")
    code, output = container.exec_run([word.replace("http://127.0.0.1:5000", url) for word in health_check("web")])
    assert code == 0, output


def test_pages_show_the_algorithms(web):
    _, url = web
    assert b"<html" in get(f"{url}/")
    assert b"orb-slam3-stereo" in get(f"{url}/algorithms")


def test_web_server_can_write_experiments_but_neither_runs_nor_reach_the_engine(web, data):
    container, _ = web
    code, output = container.exec_run(["mkdir", str(data / "experiments" / "asked-for")])
    assert code == 0, output
    for folder in (data, data / "runs", data / "datasets"):
        code, _ = container.exec_run(["touch", str(folder / "forged")])
        assert code != 0
    code, _ = container.exec_run(["ls", "/var/run/docker.sock"])
    assert code != 0


def test_images_hold_no_source_of_the_builder(engine, images):
    for image in images.values():
        output = engine.containers.run(image, ["sh", "-c", "ls -d /source || true"], remove=True, network_mode="none")
        assert b"/source\n" not in output


def test_compose_deployment_can_be_stopped_politely(worker):
    grace = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]["worker"]["stop_grace_period"]
    worker.stop(timeout=int(grace.removesuffix("s")))
    worker.reload()
    assert worker.attrs["State"]["ExitCode"] in (0, 130, 143), "it had to be killed"
