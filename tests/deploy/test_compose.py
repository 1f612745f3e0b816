"""``docker-compose.yml``: valid, and secure unless somebody decides otherwise."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
COMPOSE_FILE = ROOT / "docker-compose.yml"
FILLED_IN = {"MYSQL_PASSWORD": "secret1", "SLAMHIVE_SECRET_KEY": "secret2", "SLAMHIVE_DATA": "/srv/slamhive"}


@functools.cache
def compose_command() -> list[str]:
    """``docker compose`` or ``docker-compose``, whichever works here."""
    for command in (["docker", "compose"], ["docker-compose"]):
        if (
            shutil.which(command[0])
            and subprocess.run([*command, "version"], check=False, capture_output=True).returncode == 0
        ):
            return command
    pytest.skip("neither docker compose nor docker-compose is installed")


def compose_config(tmp_path: Path, values: dict[str, str]) -> subprocess.CompletedProcess[str]:
    project = tmp_path / "project"
    project.mkdir()
    shutil.copy(COMPOSE_FILE, project)
    environment = {"PATH": os.environ["PATH"], "HOME": str(tmp_path), **values}
    return subprocess.run(
        [*compose_command(), "-f", str(project / "docker-compose.yml"), "config"],
        check=False,
        capture_output=True,
        text=True,
        env=environment,
    )


@pytest.mark.integration
def test_config_is_valid_once_filled_in(tmp_path):
    result = compose_config(tmp_path, FILLED_IN)
    assert result.returncode == 0, result.stderr
    services = yaml.safe_load(result.stdout)["services"]
    assert set(services) == {"database", "web", "worker"}
    assert services["worker"]["environment"]["SLAMHIVE_DATA"] == "/srv/slamhive"
    assert services["database"]["image"] == "mysql:8.0"


@pytest.mark.integration
@pytest.mark.parametrize("name", sorted(FILLED_IN))
def test_missing_value_is_named_with_the_remedy(tmp_path, name):
    values = {key: value for key, value in FILLED_IN.items() if key != name}
    result = compose_config(tmp_path, values)
    assert result.returncode != 0
    assert f"set {name} in .env" in result.stderr
    assert ".env.example" in result.stderr


@pytest.fixture(scope="module")
def services():
    return yaml.safe_load(COMPOSE_FILE.read_text())["services"]


def test_every_service_has_a_health_check(services):
    assert all("healthcheck" in service for service in services.values())


def test_web_starts_when_the_worker_has_made_what_it_mounts(services):
    assert services["web"]["depends_on"]["worker"] == {"condition": "service_healthy"}
    check = services["worker"]["healthcheck"]["test"][-1]
    assert f"worker-{services['worker']['hostname']}.lock" in check


def test_no_password_is_written_down(services):
    database = services["database"]["environment"]
    assert database["MYSQL_PASSWORD"].startswith("${MYSQL_PASSWORD:?")
    assert "MYSQL_ROOT_PASSWORD" not in database
    assert ":${MYSQL_PASSWORD:?" in services["web"]["environment"]["SLAMHIVE_DATABASE_URL"]


def test_web_is_local_unprivileged_and_without_the_engine(services):
    web = services["web"]
    assert web["ports"] == ["${SLAMHIVE_WEB_ADDRESS:-127.0.0.1}:${SLAMHIVE_WEB_PORT:-5000}:5000"]
    assert web["user"].split(":")[0] != "0"
    assert web["cap_drop"] == ["ALL"]
    assert web["read_only"] is True
    assert not any("docker.sock" in volume for volume in web["volumes"])


def test_web_writes_what_pages_store_and_nothing_else(services):
    data = [volume for volume in services["web"]["volumes"] if "SLAMHIVE_DATA" in volume]
    assert [volume.rpartition("}")[2] for volume in data] == [":ro", "/experiments", "/challenges", "/ledger"]
    command = services["worker"]["command"][-1]
    group = services["web"]["user"].partition(":")[2]
    folders = " ".join(f'"$$SLAMHIVE_DATA/{name}"' for name in ("experiments", "challenges", "ledger"))
    assert f"-g {group} -m 2775 {folders}" in command
    assert command.endswith("exec slamhive worker"), "it must get the signals"


def test_worker_sees_the_data_root_under_the_path_of_the_host(services):
    data = next(volume for volume in services["worker"]["volumes"] if "SLAMHIVE_DATA" in volume)
    source, target = data.rsplit(":", 1)
    assert source.startswith("${SLAMHIVE_DATA:?")
    assert target == "${SLAMHIVE_DATA}"


def test_only_the_worker_reaches_the_engine_and_only_web_holds_the_key(services):
    holders = {name for name, service in services.items() if "docker.sock" in str(service.get("volumes"))}
    assert holders == {"worker"}
    keyed = {name for name, service in services.items() if "SECRET_KEY" in str(service.get("environment"))}
    assert keyed == {"web"}


def test_nobody_has_more_rights_over_the_host_than_that(services):
    for service in services.values():
        assert {"pid", "privileged", "cap_add", "ipc", "network_mode"}.isdisjoint(service)
    assert "/sys/fs/cgroup:/sys/fs/cgroup:ro" in services["worker"]["volumes"]


def test_example_environment_names_every_variable(services):
    example = (ROOT / ".env.example").read_text()
    used = {part.split("}")[0].split(":")[0] for part in COMPOSE_FILE.read_text().split("${")[1:]}
    assert [name for name in sorted(used) if f"{name}=" not in example] == []
    assert not any(line.startswith(f"{name}=") and line != f"{name}=" for name in used for line in example.splitlines())
