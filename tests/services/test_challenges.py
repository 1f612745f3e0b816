"""Challenges: what is refused, limits that survive, scores, ranks and phases."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound, SlamHiveError, TooManyRequests
from slamhive.base.files import TEMPORARY
from slamhive.domain.challenge import Failure
from slamhive.services.challenges import Entrant, opened_files, sweep_challenges
from slamhive.services.challenges.definition import ChallengeFolder
from slamhive.services.evaluations import Evaluations
from tests.services import challenge_world as made
from tests.services.challenge_world import (
    InThisProcess,
    World,
    entry_of,
    noisy,
    road,
    rooms,
    text,
    truth,
    write_challenge,
)
from tests.web.web_world import make_hive

pytestmark = pytest.mark.quick

FEW = 2


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A challenge of two rooms."""
    found = World(tmp_path)
    found.challenges.create(write_challenge(tmp_path / "organiser", rooms(FEW)))
    return found


@pytest.fixture(scope="module")
def ranked(tmp_path_factory: pytest.TempPathFactory) -> World:
    """A challenge of seven rooms: a good team, two that are alike, one that fails in a room."""
    found = World(tmp_path_factory.mktemp("ranked"))
    found.challenges.create(write_challenge(found.folder / "organiser", rooms(7)))
    for team, sigma_m, wobble in (("good", 0.01, 0.0), ("alike-a", 0.05, 0.2), ("alike-b", 0.05, -0.2)):
        found.challenges.submit("rooms", Entrant(team), entry_of(7, sigma_m, 1, wobble))
    broken = entry_of(7, 0.01, 4)
    still = truth(6)
    still[:, 1:4] = 0.0
    broken["room-6.txt"] = text(still)
    del broken["room-5.txt"]
    found.challenges.submit("rooms", Entrant("broken"), broken)
    assert found.judge() == 4
    return found


def submit(world: World, team: str = "a", account: str = "", seed: int = 0, sigma_m: float = 0.02) -> Any:
    return world.challenges.submit("rooms", Entrant(team, account), entry_of(FEW, sigma_m, seed))


def test_the_ground_truth_is_kept_apart_and_only_its_owner_can_read_it(world: World):
    folder = world.settings.challenges_folder / "rooms"
    assert stat.S_IMODE((folder / "secret").stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in (folder / "secret").iterdir()} == {0o600}
    assert sorted(path.name for path in (folder / "secret").iterdir()) == ["room-0.tum", "room-1.tum"]
    public = (folder / "challenge.yaml").read_text()
    assert "groundtruth" not in public
    assert "truth-0" not in public
    submit(world)
    (submission,) = (path for path in (folder / "submissions").iterdir() if not path.name.startswith("."))
    assert stat.S_IMODE(submission.stat().st_mode) & 0o007 == 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"preset": "hilti"}, "preset: must be 'mean', 'eth3d', 'kitti' or 'hilti-2026'"),
        ({"preset": "hilti-2026", "protocol": None, "metric": None}, "counts a failed sequence as 0"),
        ({"worst": None}, "the preset mean needs worst"),
        ({"metric": "ate.rms"}, "did you mean 'ate.rmse'?"),
        ({"metric": "cpu.mean"}, "cpu.mean ranks nobody"),
        ({"protocol": "kitti"}, "matches by time"),
        ({"preset": "eth3d"}, "the preset eth3d says what protocol is"),
        ({"phases": [{"name": "p", "sequences": ["room-7"]}]}, "phase p: unknown sequence 'room-7'"),
        ({"phases": [{"name": "p"}, {"name": "P"}]}, "two entries name the phase p"),
        ({"phases": [{"name": "p", "begins": "2026-05-04T12:00"}]}, "lacks its UTC offset"),
        ({"sequences": [{"name": "room-0", "time_range_s": [999, 1004]}]}, "names no groundtruth"),
        ({"sequences": [{"name": "room-0", "groundtruth": "t.txt"}]}, "needs time_range_s"),
        (
            {"sequences": [{"name": "room-0", "groundtruth": "t.txt", "time_range_s": [999, 1001]}]},
            "the time range of room-0 is 999 to 1001 s",
        ),
        ({"submissions_per_days": 3}, "did you mean 'submissions_per_day'?"),
    ],
)
def test_a_challenge_that_cannot_be_held_is_refused_and_leaves_nothing(tmp_path: Path, changes, words: str):
    world = World(tmp_path)
    content = {key: value for key, value in {**rooms(FEW), **changes}.items() if value is not None}
    with pytest.raises(InvalidInput) as error:
        world.challenges.create(write_challenge(tmp_path / "organiser", content))
    assert words in str(error.value)
    assert "rooms.yaml" in str(error.value) or "organiser" in str(error.value) or "sequence" in str(error.value)
    assert not world.settings.challenges_folder.exists()


def test_a_mistake_in_the_file_has_its_line(tmp_path: Path):
    path = write_challenge(tmp_path / "organiser", rooms(FEW, digits=9))
    line = path.read_text().splitlines().index("digits: 9") + 1
    with pytest.raises(InvalidInput, match=rf"rooms.yaml line {line}: digits"):
        World(tmp_path).challenges.create(path)


def test_a_ground_truth_that_is_too_slow_for_the_preset_is_refused(tmp_path: Path):
    content = {key: value for key, value in rooms(1, preset="eth3d").items() if key not in ("protocol", "metric")}
    content["sequences"][0]["time_range_s"] = [999, 1100]
    folder = tmp_path / "organiser"
    folder.mkdir()
    (folder / "truth-0.txt").write_bytes(text(truth(0, rate_hz=10)))
    with pytest.raises(InvalidInput, match=r"has a pose every 0\.1 s"):
        World(tmp_path).challenges.create(write_challenge(folder, content))


def test_a_name_is_taken_once(world: World, tmp_path: Path):
    with pytest.raises(Conflict, match="challenge rooms exists already"):
        world.challenges.create(tmp_path / "organiser" / "rooms.yaml")


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({}, "there is no trajectory"),
        ({"room-9.txt": b""}, "room-9.txt belongs to no sequence of phase public; did you mean"),
        ({"room-0.txt": b"1 2 3\n"}, "room-0.txt, line 1"),
        ({"room-0.txt": text(truth()), "room-0.tum": text(truth())}, "are of one sequence"),
        ({"room-0.txt": text(truth() + 5000.0 * np.eye(8)[0])}, "0 of 300 poses lie in the time range of room-0"),
        ({"room-0.txt": text(truth() * np.array([1e9, *[1] * 7]))}, "in seconds"),
    ],
)
def test_files_are_checked_by_what_is_public(world: World, files: dict[str, bytes], words: str):
    for attempt in (
        lambda: world.challenges.submit("rooms", Entrant("a"), files),
        lambda: world.challenges.check("rooms", files),
    ):
        with pytest.raises(InvalidInput, match=words):
            attempt()
    assert world.challenges.submissions("rooms") == []


def test_a_check_without_sending_counts_nothing(world: World):
    assert world.challenges.check("rooms", entry_of(FEW, 0.1)) == ["room-0: 300 poses", "room-1: 300 poses"]
    assert world.challenges.submissions("rooms") == []


def test_links_are_neither_challenges_nor_submissions(world: World, tmp_path: Path):
    submit(world)
    root = world.settings.challenges_folder
    submissions = root / "rooms" / "submissions"
    (sent,) = [path for path in submissions.iterdir() if not path.name.startswith(".")]
    elsewhere = tmp_path / "elsewhere"
    sent.rename(elsewhere)
    sent.symlink_to(elsewhere)
    (root / "halls").symlink_to(root / "rooms")
    assert world.judge() == 0
    assert world.challenges.submissions("rooms") == []
    assert not (elsewhere / "result.json").exists()
    with pytest.raises(NotFound, match="unknown challenge 'halls'"):
        world.challenges.submissions("halls")


def test_a_team_has_so_many_submissions_a_day_and_a_new_process_knows(world: World):
    for seed in range(3):
        submit(world, seed=seed)
    with pytest.raises(TooManyRequests, match="team A has sent 3 submissions to phase public today"):
        submit(world, team="A", seed=3)
    submit(world, team="b", seed=4)
    world.clock.forward(hours=12)
    submit(world, seed=5)
    assert len(world.challenges.submissions("rooms")) == 5


def test_an_account_cannot_multiply_its_tries_by_teams_or_take_those_of_others(world: World):
    for seed, team in enumerate(("a", "b", "c")):
        submit(world, team=team, account="rita", seed=seed)
    with pytest.raises(TooManyRequests, match="account rita has sent 3"):
        submit(world, team="d", account="rita", seed=3)
    with pytest.raises(Forbidden, match="team a belongs to another account"):
        submit(world, team="a", account="max", seed=4)
    assert {entry.team for entry in world.challenges.submissions("rooms", "rita")} == {"a", "b", "c"}
    assert world.challenges.submissions("rooms", "max") == []


def test_the_same_files_sent_again_are_the_same_submission(world: World):
    assert submit(world).id == submit(world).id
    assert submit(world, team="b").id != submit(world).id
    assert len(world.challenges.submissions("rooms")) == 2


def test_the_limit_holds_for_submissions_at_the_same_moment(world: World):
    def attempt(seed: int) -> bool:
        try:
            submit(world, seed=seed)
        except TooManyRequests:
            return False
        return True

    with ThreadPoolExecutor(6) as pool:
        assert sum(pool.map(attempt, range(6))) == 3


def test_what_a_killed_process_left_counts_nothing_and_is_swept(world: World):
    aside = world.settings.challenges_folder / "rooms" / "submissions" / ".20260504-abc"
    aside.mkdir()
    (aside / "room-0.tum").touch()
    for seed in range(3):
        submit(world, seed=seed)
    sweep_challenges(world.settings.challenges_folder)
    assert not aside.exists()
    assert len(world.challenges.submissions("rooms")) == 3


def test_phases_open_and_end(world: World):
    files = entry_of(FEW, 0.02)
    with pytest.raises(Conflict, match="phase final is not open yet; it opens at 2026-06-01 00:00 UTC"):
        world.challenges.submit("rooms", Entrant("a"), files, "final")
    world.clock.forward(days=40)
    with pytest.raises(Conflict, match="phase public ended at 2026-06-01"):
        world.challenges.submit("rooms", Entrant("a"), files, "public")
    assert world.challenges.submit("rooms", Entrant("a"), files).phase == "final"
    with pytest.raises(NotFound, match="unknown phase 'finale'; did you mean 'final'"):
        world.challenges.submit("rooms", Entrant("a"), files, "finale")
    world.challenges.close("rooms")
    with pytest.raises(Conflict, match="no phase of challenge rooms is open"):
        world.challenges.submit("rooms", Entrant("a"), files)


def test_scores_of_a_hidden_phase_are_shown_when_it_has_ended(world: World):
    world.clock.forward(days=40)
    submit(world)
    world.judge()
    (hidden,) = world.challenges.submissions("rooms")
    assert (hidden.state, hidden.values, hidden.score) == ("evaluated", None, None)
    assert not any(character in " ".join(hidden.log[2:]) for character in "0123456789")
    ranking = world.challenges.ranking("rooms", "final")
    assert (ranking.shown, ranking.teams) == (False, ())
    world.challenges.end_phase("rooms", "final", world.clock.now)
    assert world.challenges.submissions("rooms")[0].score is not None
    assert [entry.team for entry in world.challenges.ranking("rooms", "final").teams] == ["a"]
    with pytest.raises(Conflict, match="phase final has ended, and its scores are shown"):
        world.challenges.end_phase("rooms", "final", world.clock.now.replace(year=2027))


def test_the_end_of_a_phase_can_move(world: World):
    later = world.clock.now.replace(year=2027)
    assert world.challenges.end_phase("rooms", "public", later).phases[0].ends == later
    with pytest.raises(InvalidInput, match="phase final begins at 2026-06-01"):
        world.challenges.end_phase("rooms", "final", world.clock.now)


def test_an_answer_is_shown_at_a_full_minute_whatever_the_evaluation_took(world: World):
    submit(world)
    world.judge()
    result = json.loads(next(world.settings.challenges_folder.glob("rooms/submissions/*/result.json")).read_text())
    assert result["shown_at"] == "2026-05-04T12:01:00+00:00"
    world.clock.now = made.NOW.replace(second=59)
    (waiting,) = world.challenges.submissions("rooms")
    assert (waiting.state, waiting.values) == ("queued", None)
    assert world.challenges.ranking("rooms").teams == ()
    world.clock.forward(seconds=1)
    assert world.challenges.submissions("rooms")[0].state == "evaluated"


def test_values_are_those_of_the_protocol_rounded(ranked: World):
    found = next(entry for entry in ranked.challenges.submissions("rooms") if entry.team == "good")
    assert found.values is not None
    errors_m = (noisy(truth(3), 0.01 * 1.3, 103) - truth(3))[:, 1:4]
    errors_m -= errors_m.mean(axis=0)  # as the alignment does; its rotation takes little of so small a noise
    rms_m = float(np.sqrt((errors_m**2).sum(axis=1).mean()))
    assert found.values["room-3"] == pytest.approx(rms_m, rel=0.03)
    assert all(value is not None and value == float(f"{value:.3g}") for value in found.values.values())
    assert found.score == pytest.approx(np.mean([value for value in found.values.values() if value]), rel=1e-2)


@pytest.mark.integration
def test_teams_that_no_test_tells_apart_share_a_rank(ranked: World):
    ranking = ranked.challenges.ranking("rooms")
    assert [(entry.rank, entry.team, entry.tied) for entry in ranking.teams][:1] == [(1, "good", False)]
    by_team = {entry.team: entry for entry in ranking.teams}
    assert by_team["alike-a"].rank == by_team["alike-b"].rank == 2
    assert by_team["alike-a"].tied
    assert by_team["alike-a"].score != by_team["alike-b"].score
    for entry in ranking.teams:
        assert entry.low is not None
        assert entry.high is not None
        assert entry.low <= entry.score <= entry.high
    assert ranking.test == "Wilcoxon's signed-rank test over 7 sequences at the level 0.05"


def test_a_sequence_that_fails_or_lacks_counts_as_the_worst(ranked: World):
    found = next(entry for entry in ranked.challenges.submissions("rooms") if entry.team == "broken")
    assert found.values is not None
    assert (found.values["room-5"], found.values["room-6"]) == (None, None)
    known = [value for value in found.values.values() if value is not None]
    assert found.score == pytest.approx((sum(known) + 2.0) / 7, rel=1e-2)
    assert "room-6: no value, counts as 1" in found.log
    assert next(entry.rank for entry in ranked.challenges.ranking("rooms").teams if entry.team == "broken") > 1


def test_a_submission_without_any_value_fails_for_a_fixed_reason(world: World):
    still = truth()
    still[:, 1:4] = 0.0
    world.challenges.submit("rooms", Entrant("a"), {"room-0.txt": text(still)})
    world.judge()
    (found,) = world.challenges.submissions("rooms")
    assert (found.state, found.reason) == ("failed", Failure.NOT_COMPARABLE.value)
    assert world.challenges.ranking("rooms").teams == ()


def test_a_trajectory_that_covers_too_little_of_the_public_time_range_counts_as_failed(tmp_path: Path):
    world = World(tmp_path)
    world.challenges.create(write_challenge(tmp_path / "organiser", rooms(1, least_coverage=0.7)))
    world.challenges.submit("rooms", Entrant("half"), {"room-0.txt": text(truth()[:150])})
    world.challenges.submit("rooms", Entrant("whole"), {"room-0.txt": text(truth())})
    world.judge()
    whole, half = sorted(world.challenges.submissions("rooms"), key=lambda entry: entry.team, reverse=True)
    assert (half.state, half.reason) == ("failed", Failure.TOO_LITTLE.value)
    assert half.log[0] == "room-0: 150 poses, 37.3 % of the time range, less than 70 %, so it counts as failed"
    assert whole.state == "evaluated"


def test_the_last_submission_counts_where_the_challenge_says_so(tmp_path: Path):
    world = World(tmp_path)
    for name, counted in (("best", "best"), ("last", "last")):
        world.challenges.create(write_challenge(tmp_path / name, rooms(1, name=name, counted=counted)))
        for seed, sigma_m in ((1, 0.01), (2, 0.1)):
            world.clock.forward(seconds=1)
            world.challenges.submit(name, Entrant("a"), entry_of(1, sigma_m, seed))
    world.judge()
    scores = {name: world.challenges.ranking(name).teams[0].score for name in ("best", "last")}
    assert scores["best"] < 0.05 < scores["last"]


def test_kitti_pools_the_segments_of_all_sequences(tmp_path: Path):
    world = World(tmp_path)
    content = {
        **{key: value for key, value in rooms(1).items() if key not in ("protocol", "metric", "worst")},
        "name": "roads",
        "preset": "kitti",
        "digits": 5,
        "sequences": [
            {"name": f"0{number}", "groundtruth": f"{number}.txt", "poses": made.FRAMES} for number in (0, 1)
        ],
    }
    organiser = tmp_path / "organiser"
    organiser.mkdir()
    short = road()[:130]
    (organiser / "1.txt").write_bytes(text(short))
    content["sequences"][1]["poses"] = 130
    world.challenges.create(write_challenge(organiser, content))
    with pytest.raises(InvalidInput, match="1 sequence without a trajectory: 01; every sequence is needed"):
        world.challenges.submit("roads", Entrant("a"), {"00.txt": text(road(0.1))})
    with pytest.raises(InvalidInput, match=r"00\.txt has 229 poses, 00 has 230 frames; write them all"):
        world.challenges.submit("roads", Entrant("a"), {"00.txt": text(road(0.1)[1:]), "01.txt": text(short)})
    world.challenges.submit("roads", Entrant("a"), {"00.txt": text(road(0.1)), "01.txt": text(short)})
    world.judge()
    (found,) = world.challenges.submissions("roads")
    assert found.values is not None
    assert found.values["01"] == 0.0
    assert found.values["00"] is not None
    assert found.values["00"] > 0.1
    # Segments from every tenth frame: of 100 m there are 13 and 3, of 200 m 3 and none.
    assert found.score == pytest.approx(found.values["00"] * 16 / 19, rel=1e-4)


def test_eth3d_ranks_by_the_area_under_its_curve(tmp_path: Path):
    world = World(tmp_path)
    content = {
        key: value for key, value in rooms(3, preset="eth3d").items() if key not in ("protocol", "metric", "worst")
    }
    world.challenges.create(write_challenge(tmp_path / "organiser", content))
    world.challenges.submit("rooms", Entrant("fine"), entry_of(3, 0.01))
    world.challenges.submit("rooms", Entrant("rough"), entry_of(3, 0.2))
    world.judge()
    fine, rough = world.challenges.ranking("rooms").teams
    assert (fine.team, rough.team, rough.score) == ("fine", "rough", 0.0)
    expected = np.mean([100 * (0.1 - value) / 0.1 for value in fine.values.values() if value is not None])
    assert fine.score == pytest.approx(expected, rel=1e-2)
    assert (fine.rank, rough.rank) == (1, 2)


def test_an_evaluation_that_is_stopped_begins_again_later(world: World):
    submit(world)
    stopping = threading.Event()
    stopping.set()
    assert world.judge(stopping) == 0
    assert world.challenges.submissions("rooms")[0].state == "queued"
    assert world.judge() == 1


def test_two_processes_do_not_evaluate_the_same(world: World):
    submit(world)
    with ChallengeFolder(world.settings.challenges_folder / "rooms").judging() as free:
        assert free
        assert world.judge() == 0
    assert world.judge() == 1


def test_a_worker_evaluates_submissions(tmp_path: Path, sqlite_template: Path, monkeypatch: pytest.MonkeyPatch):
    engine = InThisProcess()
    monkeypatch.setattr(Evaluations, "measure", lambda _, *arguments: engine.measure(*arguments))
    world = World(tmp_path)
    world.challenges.create(write_challenge(tmp_path / "organiser", rooms(FEW, phases=[{"name": "public"}])))
    sent = submit(world)
    hive = make_hive(tmp_path, empty=True, template=sqlite_template)
    hive.worker().run(until_idle=True)
    hive.close()
    assert engine.seen == [f"{sent.id}/room-0", f"{sent.id}/room-1"]
    assert (world.settings.challenges_folder / "rooms" / "submissions" / sent.id / "result.json").is_file()


def test_a_damaged_submission_holds_up_nobody(world: World, caplog: pytest.LogCaptureFixture):
    broken = submit(world, seed=1)
    submit(world, seed=2)
    path = world.settings.challenges_folder / "rooms" / "submissions" / broken.id / "submission.json"
    path.write_text("{")
    assert world.judge() == 1
    assert f"submission {broken.id}" in caplog.text


def test_a_challenge_that_somebody_has_broken_holds_up_no_other(world: World, caplog: pytest.LogCaptureFixture):
    submit(world)
    other = world.folder / "other"
    world.challenges.create(write_challenge(other, rooms(1, name="a-first")))
    world.challenges.submit("a-first", Entrant("a"), entry_of(1, 0.02))
    path = world.settings.challenges_folder / "a-first" / "challenge.yaml"
    path.write_text(path.read_text().replace("preset: mean", "preset: median"))
    assert [entry.name for entry in world.challenges.briefs()] == ["rooms"]
    with pytest.raises(InvalidInput, match="preset: must be"):
        world.challenges.get("a-first")
    assert world.judge() == 1
    assert "challenge a-first" in caplog.text


def test_a_worker_of_another_user_leaves_submissions_to_their_owner(
    world: World, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    submit(world)
    secret = world.settings.challenges_folder / "rooms" / "secret"
    opened = os.open

    def refuse(path, *arguments, **options):
        if Path(path) == secret:  # root may open everything
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, *arguments, **options)

    monkeypatch.setattr(os, "open", refuse)
    assert world.judge() == 0
    assert "run the worker as its owner" in caplog.text
    monkeypatch.undo()
    assert world.judge() == 1


def test_files_are_read_from_folders_and_archives(tmp_path: Path):
    folder = tmp_path / "mine" / "inner"
    folder.mkdir(parents=True)
    (folder / "room-0.txt").write_text("0")
    (folder / ".hidden").write_text("x")
    archive = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", tmp_path / "mine"))
    for sent in (folder.parent, archive):
        with opened_files([sent]) as files:
            assert {name: path.read_bytes() for name, path in files.items()} == {"room-0.txt": b"0"}
    with pytest.raises(InvalidInput, match=r"two files are called room-0\.txt"), opened_files([archive, folder]):
        pass
    (tmp_path / "torn.zip").write_bytes(archive.read_bytes()[:40])
    with pytest.raises(SlamHiveError), opened_files([tmp_path / "torn.zip"]):
        pass
    assert not list(tmp_path.glob(f"{TEMPORARY}*"))


def test_the_public_file_can_be_read_again(world: World):
    content = yaml.safe_load((world.settings.challenges_folder / "rooms" / "challenge.yaml").read_text())
    assert [entry["name"] for entry in content["sequences"]] == ["room-0", "room-1"]
    found = world.challenges.get("rooms")
    assert (found.metric, found.worst, found.score_unit) == ("ate.rmse", 1.0, "m")
    assert world.challenges.briefs()[0].open_phases == ("public",)


def test_the_preset_of_hilti_counts_scores(tmp_path: Path):
    world = World(tmp_path)
    content = {
        key: value for key, value in rooms(2, preset="hilti-2026").items() if key not in ("protocol", "metric", "worst")
    }
    stamps = {number: truth(number, rate_hz=20.0) for number in range(2)}
    folder = tmp_path / "organiser"
    folder.mkdir()
    for number, rows in stamps.items():
        (folder / f"truth-{number}.txt").write_bytes(text(rows))
        content["sequences"][number]["time_range_s"] = [999, 1016]
    world.challenges.create(write_challenge(folder, content))
    for team, sigma_m in (("good", 0.01), ("bad", 2.0)):
        files = {f"room-{number}.txt": text(noisy(rows, sigma_m, number)) for number, rows in stamps.items()}
        world.challenges.submit("rooms", Entrant(team), files)
    world.challenges.submit(
        "rooms", Entrant("half"), {"room-0.txt": text(stamps[0]), "room-1.txt": text(stamps[1][:150])}
    )
    world.judge()
    teams = world.challenges.ranking("rooms").teams
    assert teams[0].team == "good"
    scores = {team.team: team.score for team in teams}
    assert 95 < scores["good"] <= 100
    assert scores["half"] == 50.0
    assert 0 < scores["bad"] < 50


MEASURED = """
import re, sys
from pathlib import Path
from slamhive.base.budget import unbounded
from slamhive.domain.challenge import Format
from slamhive.services.challenges.checking import MEMORY_PER_LINE, in_memory
from slamhive.services.challenges.checking import frame_trajectory
from slamhive.trajectory.kitti import parse_kitti_matrices
from slamhive.trajectory.layout import parse_tum
def most_bytes():
    return int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024
path, kind = Path(sys.argv[1]), Format(sys.argv[2])
parse_tum(b"0 0 0 0 0 0 0 1\\n", "small")
before = most_bytes()
with in_memory(path, path.name, kind, unbounded("a submission")) as data:
    if kind is Format.KITTI:
        frame_trajectory(parse_kitti_matrices(data, path.name))
    else:
        parse_tum(data, path.name)
lines = int(sys.argv[3])
print(most_bytes() - before, path.stat().st_size + MEMORY_PER_LINE[kind] * lines)
"""


@pytest.mark.integration
@pytest.mark.parametrize(("kind", "lines"), [("tum", 1_000_000), ("kitti", 250_000)])
def test_a_check_takes_no_more_memory_than_it_asks_for(tmp_path: Path, kind: str, lines: int):
    """The shortest lines take the most memory for each of their bytes."""
    rows = (f"{n} 0 0 0 0 0 0 1\n" if kind == "tum" else "1 0 0 0 0 1 0 0 0 0 1 0\n" for n in range(lines))
    path = tmp_path / "room-0.txt"
    path.write_text("".join(rows))
    command = [sys.executable, "-c", MEASURED, str(path), kind, str(lines)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=100)
    taken, asked = map(int, done.stdout.split())
    assert 0.3 * asked < taken < asked
