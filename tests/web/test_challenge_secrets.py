"""Who submits to a challenge finds nothing of its ground truth: on no page, in no answer, log or file."""

from __future__ import annotations

import io
import json
import logging
import re
import shutil
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import slamhive
from slamhive.base.settings import Mode
from slamhive.cli import main
from slamhive.domain.accounts import Role
from slamhive.domain.challenge import Failure
from slamhive.evaluation.runner import EvaluationRunner, ProcessStarter
from slamhive.services.challenges import ChallengeJudge, Entrant
from slamhive.services.evaluations import Evaluations
from slamhive.services.hive import Hive
from tests.services.challenge_world import Clock, World, entry_of, noisy, rooms, text, truth, write_challenge
from tests.web import web_world as world
from tests.web.account_world import AccountWeb, account_web
from tests.web.challenge_walk import walk
from tests.web.test_web_challenges import form
from tests.web.web_world import make_web

pytestmark = pytest.mark.integration

SOURCE = Path(slamhive.__file__).parent
KNOW_THE_FOLDER = {"base/settings.py", "services/worker/leftovers.py"}
"""Besides the use case itself; the second removes what killed processes have left."""
NUMBER = re.compile(rb"\d+\.\d{4,}")
TIME_OF_DAY = re.compile(rb"\d\d:\d\d:\d\d[.]\d+")
WORDS = (b"organiser", b"truth-0", b"data/challenges/")
"""Of paths to ground truths on this machine."""


@dataclass
class Site:
    """A challenge with evaluated submissions, on a server with accounts."""

    web: AccountWeb
    folder: Path
    log: str


def secret_numbers() -> set[str]:
    """Every coordinate of the ground truths, with four decimals."""
    values = np.concatenate([truth(number)[:, 1:4].ravel() for number in range(2)])
    return {f"{abs(value):.4f}" for value in values}


SECRETS = secret_numbers()


def coordinates_in(content: bytes) -> set[str]:
    """The coordinates of the ground truths in ``content``. The seconds of a time of day are none."""
    numbers = NUMBER.findall(TIME_OF_DAY.sub(b"", content))
    return {f"{float(found):.4f}" for found in numbers} & SECRETS


def points_in(content: bytes) -> set[str]:
    """The same, unless there are fewer than a point has: databases hold durations, which may be equal by chance."""
    found = coordinates_in(content)
    return found if len(found) >= 3 else set()


def leaks(content: bytes) -> list[str]:
    """What of the ground truths, and of where they lie, is in ``content``."""
    return [*sorted(coordinates_in(content))[:3], *(word.decode() for word in WORDS if word in content)]


@pytest.fixture(scope="module")
def site(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A member has sent good, broken and hostile trajectories; a process of its own has evaluated them."""
    folder = tmp_path_factory.mktemp("secrets")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    phases = [{"name": "public", "submissions_per_day": 20}, {"name": "hidden", "scores": "at_end"}]
    World(folder).challenges.create(write_challenge(folder / "organiser", rooms(2, phases=phases)))
    with account_web(folder) as made:
        member, hive = made.of(Role.MEMBER), made.web.hive
        for files in hostile_entries():
            assert form(member, files, team="probe").status_code == 303
        assert form(member, entry_of(2, 0.02), team="probe", phase="hidden").status_code == 303
        log = io.StringIO()
        handler, logger = logging.StreamHandler(log), logging.getLogger("slamhive")
        logger.addHandler(handler)
        logger.setLevel(logging.DEBUG)
        try:
            assert judge_of(hive).work_once(threading.Event()) == len(hostile_entries()) + 1
        finally:
            logger.removeHandler(handler)
            logger.setLevel(logging.NOTSET)
        for path in hive.settings.challenges_folder.glob("*/submissions/*/result.json"):
            result = json.loads(path.read_text())
            path.write_text(json.dumps({**result, "shown_at": "2026-01-01T00:00:00+00:00"}))
        yield Site(made, folder, log.getvalue())


def judge_of(hive: Hive) -> ChallengeJudge:
    """What evaluates submissions, in a process of its own whatever else is here."""
    process = EvaluationRunner(ProcessStarter(SOURCE.parent))
    evaluations = Evaluations(hive.settings, hive.store, hive.catalogue, hive.protocols, lambda: process)
    return ChallengeJudge(hive.settings, evaluations)


def hostile_entries() -> list[dict[str, bytes]]:
    """Submissions that try to make an error or a value talk."""
    exact, still, far, late = truth(0), truth(0), truth(0), truth(0)
    exact[:, 1:4] -= exact[0, 1:4]
    still[:, 1:4] = 0.0
    far[:, 1:4] *= 1e6
    late[:, 0] += 0.5
    two = np.vstack([noisy(truth(0), 0.01)[:3]])
    return [{"room-0.txt": text(rows)} for rows in (exact, still, far, late, two)] + [entry_of(2, 0.01)]


def test_the_search_sees_a_leak():
    assert leaks(b"nothing but 12.3456 and 417.3") == []
    value = truth(0)[100, 1]
    assert leaks(b"at %.6f m" % value) == [f"{value:.4f}"]
    assert leaks(b"no such file: /data/challenges/rooms/secret/room-0.tum") == ["data/challenges/"]


def test_no_address_gives_the_ground_truth_to_a_submitter(site: Site):
    seen, found = walk(site.web.of(Role.MEMBER), site.web.web.app, leaks)
    assert found == {}
    assert seen > 60


def test_no_address_gives_it_to_strangers_or_visitors(site: Site):
    _, found = walk(site.web.web.app.test_client(), site.web.web.app, leaks)
    assert found == {}
    viewing = make_web(world.make_hive(site.folder, Mode.VIEW_ONLY))
    for address in ("/challenges", "/challenges/rooms", "/api/v1/challenges/rooms/ranking", "/challenges/rooms/secret"):
        assert leaks(viewing.client.get(address).data) == []
    viewing.hive.close()


def test_the_submitter_sees_values_reasons_and_logs_of_a_fixed_kind(site: Site):
    found = site.web.web.hive.challenges.submissions("rooms")
    assert {entry.reason for entry in found} <= {None, *Failure}
    assert {entry.state for entry in found if entry.phase == "public"} == {"evaluated", "failed"}
    lines = {re.sub(r"\d[\d.,]*\d|\d", "N", line) for entry in found for line in entry.log}
    assert lines <= {
        "room-N: N poses, N % of the time range",
        "room-N: no value, counts as N",
        "evaluated",
        "evaluated; scores are shown when the phase has ended",
        f"failed: {Failure.NOT_COMPARABLE}",
    }
    for path in site.web.web.hive.settings.challenges_folder.glob("*/submissions/*/result.json"):
        result = json.loads(path.read_text())
        assert set(result) == {"format", "shown_at", "values", "weights", "failure", "reasons"}
        assert result["reasons"] == {}
        known = [value for value in result["values"].values() if value is not None]
        assert all(value == float(f"{value:.3g}") for value in known)


def test_neither_the_log_of_the_worker_nor_what_it_leaves_quotes_the_ground_truth(site: Site):
    assert "is evaluated" in site.log
    assert not coordinates_in(site.log.encode())
    data = site.web.web.hive.settings.data
    kept = [path for path in data.rglob("*") if path.is_file() and "secret" not in path.parts]
    estimates = {path for path in kept if path.match("submissions/*/*.tum")}
    assert len(kept) > len(estimates) > 0
    assert [path for path in kept if path not in estimates and points_in(path.read_bytes())] == []


def test_no_archive_holds_anything_of_a_challenge(site: Site, tmp_path: Path):
    path = tmp_path / "all.zip"
    data = site.web.web.hive.settings.data
    result = CliRunner().invoke(main, ["--data", str(data), "archive", "export", str(path), "--all", "--unpublished"])
    assert result.exit_code == 0, result.output
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        assert not [name for name in names if "challenge" in name]
        assert not [name for name in names if points_in(archive.read(name))]


def test_only_the_use_case_itself_knows_where_the_secret_lies():
    knowing = {
        str(path.relative_to(SOURCE)) for path in SOURCE.rglob("*.py") if "challenges_folder" in path.read_text()
    }
    assert {name for name in knowing if not name.startswith("services/challenges/")} == KNOW_THE_FOLDER


def test_what_is_shown_of_a_hidden_phase_does_not_depend_on_the_ground_truth(tmp_path: Path):
    shown = []
    for number in (0, 1):  # two challenges that differ in the secret alone
        found = World(tmp_path / str(number), Clock())
        organiser = tmp_path / f"organiser-{number}"
        organiser.mkdir()
        (organiser / "truth-0.txt").write_bytes(text(truth(10 * number)))
        hidden = rooms(1, phases=[{"name": "hidden", "scores": "at_end"}])
        found.challenges.create(write_challenge(organiser, hidden))
        ids = []
        for team, files in (("a", entry_of(1, 0.01)), ("b", {"room-0.txt": text(truth(3)[:120])})):
            ids.append(found.challenges.submit("rooms", Entrant(team), files).id)
            found.clock.forward(seconds=1)
        found.judge()
        documents = [entry.content for entry in found.challenges.submissions("rooms")]
        text_of_all = json.dumps([documents, found.challenges.ranking("rooms").content])
        for submission_id in ids:
            text_of_all = text_of_all.replace(submission_id, "ID")
        shown.append(text_of_all)
    assert shown[0] == shown[1]
    assert "evaluated" in shown[0]
