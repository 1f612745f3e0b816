"""A hostile image on a secret recording: its team, others and strangers find nothing of it. In a real engine."""

from __future__ import annotations

import base64
import io
import json
import logging
import re
import shutil
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.base.settings import Mode
from slamhive.cli import main
from slamhive.domain.accounts import Role
from slamhive.domain.challenge import RunFailure
from slamhive.services.challenges import Entrant
from tests.services import image_world as made
from tests.services.challenge_world import World
from tests.services.docker_base import run_docker
from tests.web import web_world as world
from tests.web.account_world import NAMES, AccountWeb, account_web
from tests.web.challenge_walk import walk
from tests.web.web_world import make_web

pytestmark = [pytest.mark.integration, pytest.mark.docker, pytest.mark.timeout(600)]

MARK = made.MARKS[made.SECRET]
CRASH = made.GOOD + 'print(recorded)\nraise SystemExit(3 if b"secret" in recorded else 0)\n'
COMMANDS = (
    ("runs", "--json"),
    ("find", "hidden", "--json"),
    ("algorithm", "list", "--json"),
    ("dataset", "list", "--json"),
    ("challenge", "show", "rooms", "--json"),
    ("challenge", "status", "rooms", "--json"),
    ("challenge", "ranking", "rooms", "--json"),
)


@dataclass
class Site:
    """A challenge whose images have run."""

    web: AccountWeb
    folder: Path
    log: str
    images: list[str] = field(default_factory=list)

    @property
    def secret(self) -> Path:
        return self.web.web.hive.settings.challenges_folder / "rooms" / "secret"


def secrets_of() -> list[bytes]:
    """The recording in the codings that the image uses, its times, and the ground truth."""
    numbers = [f"{value:.4f}".encode() for value in made.truth(made.SECRET)[3:, 1]]
    coded = [base64.b64encode(b"xxx"[:shift] + MARK)[4:-4] for shift in range(3)]
    return [MARK, MARK.hex().encode(), *coded, b"50331728", b"50331727.5", b"50331738.5", b"47114711", *numbers]


SECRETS = secrets_of()


def leaks(content: bytes) -> list[str]:
    """What of the secret recording is in ``content``."""
    return [found.decode() for found in SECRETS if found in content]


@pytest.fixture(scope="module")
def site(filled: Path, base_image: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A reader has sent a hostile image and one that fails on the secret recording alone; both have run."""
    folder = tmp_path_factory.mktemp("images")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    World(folder).challenges.create(made.image_challenge(folder / "organiser"))
    with account_web(folder) as web:
        hive = web.web.hive
        hive.settings = hive.settings.with_values({"executor": "docker"})
        docker = hive.executors.get("docker")
        images = []
        for number, script in enumerate((made.HOSTILE, CRASH)):
            images.append(made.own_image(base_image, folder / "image"))
            with made.exported(hive, docker, images[-1], script, folder / f"{number}.tar") as archive:
                entrant = Entrant("probe", NAMES[Role.READER])
                hive.challenges.submit_image("rooms", entrant, archive, "public")
        made.remove_images(folder / "data", images)
        log = io.StringIO()
        handler, logger = logging.StreamHandler(log), logging.getLogger("slamhive")
        logger.addHandler(handler)
        try:
            stopping = threading.Event()
            while hive.challenge_images.work_once(stopping):
                pass
        finally:
            logger.removeHandler(handler)
        assert made.judge(hive).work_once(stopping) == 2
        made.show_results(hive)
        yield Site(web, folder, log.getvalue(), images)
        made.remove_images(folder / "data", images)


def test_the_search_sees_a_leak():
    assert leaks(b"nothing but 12.3456") == []
    assert leaks(base64.b64encode(b"12" + MARK * 3)) != []


def test_the_image_has_seen_and_written_the_secret(site: Site):
    """Else the other tests prove nothing."""
    written = [path for path in site.secret.rglob("runs/*/**/*") if path.is_file() and MARK in path.read_bytes()]
    names = {path.name for path in written}
    assert {"traj.txt", "log.txt", "extra.bin", "frames.csv"} <= names
    logs = [path.read_text(errors="replace") for path in site.secret.glob("runs/*/runs/*/log.txt")]
    assert any("no net: " in log for log in logs)
    assert not any("reached the net" in log for log in logs)


def test_the_hostile_image_is_ranked_by_a_rounded_value(site: Site):
    hive = site.web.web.hive
    (team,) = hive.challenges.ranking("rooms", "public").teams
    assert set(team.values) == {made.OPEN, made.SECRET}
    assert all(value == float(f"{value:.3g}") for value in team.values.values() if value is not None)


def test_its_team_reads_reasons_and_the_log_of_the_public_recording(site: Site):
    first, second = reversed(site.web.web.hive.challenges.submissions("rooms"))
    assert (first.state, second.state) == ("evaluated", "failed")
    assert second.reason == "no run of the image left a trajectory that counts"
    assert second.log == (
        f"{made.SECRET}: {RunFailure.CRASHED}",
        f"{made.OPEN}: {RunFailure.NO_TRAJECTORY}",
        f"failed: {second.reason}",
    )
    for entry in (first, second):
        assert list(entry.run_logs) == [made.OPEN]
        assert made.MARKS[made.OPEN].decode() in entry.run_logs[made.OPEN]
        assert leaks(json.dumps(entry.content).encode()) == []


@pytest.mark.parametrize("role", [None, *Role])
def test_no_address_gives_it_to_anybody(site: Site, role: Role | None):
    client = site.web.web.app.test_client() if role is None else site.web.of(role)
    seen, found = walk(client, site.web.web.app, leaks)
    assert found == {}
    assert role is None or seen > 50


def test_no_address_gives_it_to_visitors(site: Site):
    viewing = make_web(world.make_hive(site.folder, Mode.VIEW_ONLY))
    _, found = walk(viewing.client, viewing.app, leaks)
    viewing.hive.close()
    assert found == {}


def test_other_members_do_not_see_the_submission(site: Site):
    for role in (Role.MEMBER, Role.ADMIN):
        client = site.web.of(role)
        assert client.get("/api/v1/challenges/rooms/submissions").json == {"submissions": []}
        assert made.MARKS[made.OPEN] not in client.get("/challenges/rooms").data


def test_runs_and_packages_are_nowhere_else(site: Site):
    hive = site.web.web.hive
    assert not [entry for entry in hive.catalogue.datasets() if entry.name in made.MARKS]
    runs = hive.runs.page(limit=1000).records
    assert not [run for run in runs if run.dataset in made.MARKS]
    for command in COMMANDS:
        done = CliRunner().invoke(main, ["--data", str(hive.settings.data), *command])
        assert done.exit_code == 0, done.output
        assert leaks(done.stdout.encode()) == []


def test_nothing_outside_the_secret_folder_holds_it(site: Site):
    data = site.web.web.hive.settings.data
    kept = [path for path in data.rglob("*") if path.is_file() and "secret" not in path.parts]
    assert len(kept) > 30
    found = {str(path): found for path in kept if (found := leaks(path.read_bytes()))}
    assert found == {}
    assert leaks(site.log.encode()) == []


def test_no_archive_of_runs_holds_it(site: Site, tmp_path: Path):
    path = tmp_path / "all.zip"
    data = str(site.web.web.hive.settings.data)
    command = ["--data", data, "archive", "export", str(path), "--all", "--unpublished"]
    assert CliRunner().invoke(main, command).exit_code == 0
    with zipfile.ZipFile(path) as archive:
        assert not [name for name in archive.namelist() if leaks(archive.read(name))]


def test_only_the_owner_can_read_the_installations_of_images(site: Site):
    for path in (site.secret, *site.secret.glob("runs/*")):
        assert path.stat().st_mode & 0o077 == 0
    assert json.loads((site.secret / "times.json").read_text())["time_ranges_s"] == {
        made.SECRET: [50331727.5, 50331738.5]
    }
    assert "time_range_s" in (site.secret.parent / "challenge.yaml").read_text()  # of the public recording


def test_the_engine_keeps_no_image_and_no_container(site: Site):
    for digest in site.images:
        assert run_docker("image", "inspect", digest).returncode != 0
    for path in site.secret.glob("runs/*/installation"):
        label = f"label=slamhive.installation={path.read_text()}"
        assert run_docker("ps", "--all", "--quiet", "--filter", label).stdout == ""


def test_times_are_shown_to_the_hour(site: Site):
    for path in site.secret.parent.glob("submissions/[0-9]*"):
        assert {entry.name for entry in path.iterdir()} == {"submission.json", "image.tar", "result.json", "logs"}
    found = site.web.web.hive.challenges.submissions("rooms")
    told = json.dumps([{**entry.content, "run_logs": {}} for entry in found])
    assert len(re.findall(r"\d\d:\d\d:\d\d", told)) == len(found)  # when it was sent
