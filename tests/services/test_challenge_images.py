"""Images in challenges: what is taken, runs that survive kills, cancelling, and what is left behind."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import random
import stat
import tarfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner, Result

from slamhive.base.errors import Conflict, InvalidInput, NotFound, TooManyRequests
from slamhive.cli import main
from slamhive.domain.challenge import Failure, RunFailure
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.base import EngineUnavailable, PackageNeed
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, Gone, Running
from slamhive.services.challenges import Entrant, ImageWork
from slamhive.services.challenges.images import check_image
from slamhive.services.challenges.judging import middle
from slamhive.services.challenges.views import shown_at
from slamhive.services.executors import Executors
from slamhive.services.hive import Hive
from slamhive.services.weights import WeightsStore
from tests.fuzzing import mutated
from tests.services import image_world as made
from tests.services.challenge_world import kept, text
from tests.services.fake_executor import FakeExecutor
from tests.services.image_world import OPEN, SECRET
from tests.waiting import eventually

pytestmark = pytest.mark.integration

LAYER = b"what is in the image"
DIGEST = f"sha256:{sha256(LAYER).hexdigest()}"


class Engine(FakeExecutor):
    """Holds images by digest. Its runs leave the trajectory of the sequence that they got."""

    name = "docker"
    capabilities = replace(FakeExecutor.capabilities, isolates=True, needs=PackageNeed.IMAGE, preference=10)

    def __init__(self) -> None:
        super().__init__(on_start=self._leave)
        self.images: set[str] = set()
        self.scale = 1.0

    def _leave(self, spec: RunSpec) -> None:
        bag = next(entry.source for entry in spec.inputs if entry.source.suffix == ".bag")
        rows = made.truth(bag.stem)
        rows[:, 1:4] = self.scale * (rows[:, 1:4] - rows[0, 1:4])
        (spec.output("result").destination / "traj.txt").write_bytes(text(rows))

    def has(self, package, identity) -> bool:
        return identity in self.images

    def forget(self, package, identity, number) -> None:
        self.images.discard(identity)

    def save_image(self, identity) -> Iterator[bytes]:
        saved = io.BytesIO()
        with tarfile.open(fileobj=saved, mode="w") as archive:
            _add(archive, "layer.tar", LAYER)
        yield saved.getvalue()

    def load_image(self, chunks) -> str:
        with tarfile.open(fileobj=io.BytesIO(b"".join(chunks))) as archive:
            stream = archive.extractfile("layer.tar")
            assert stream is not None
            digest = f"sha256:{sha256(stream.read()).hexdigest()}"
        self.images.add(digest)
        return digest


def _add(archive: tarfile.TarFile, name: str, content: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(content)
    archive.addfile(member, io.BytesIO(content))


@pytest.fixture
def engine(hive: Hive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Engine:
    """The engine of all installations; the challenge ``rooms`` is there."""
    found = Engine()
    monkeypatch.setattr(Executors, "get", lambda _self, _name: found)
    monkeypatch.setattr(Executors, "choose", lambda _self, _asked=None: "docker")
    hive.settings = hive.settings.with_values({"executor": "docker"})
    hive.challenges.create(made.image_challenge(tmp_path / "organiser"))
    return found


@pytest.fixture
def archive(hive: Hive, engine: Engine, tmp_path: Path) -> Path:
    """An exported package, whose image the engine has no more."""
    engine.images.add(DIGEST)
    with made.exported(hive, engine, DIGEST, made.GOOD, tmp_path / "image.tar") as path:
        engine.images.clear()
        return path


def send(hive: Hive, archive: Path, team: str = "a", phase: str = "public", account: str = ""):
    return hive.challenges.submit_image("rooms", Entrant(team, account), archive, phase)


def work(hive: Hive) -> int:
    """Run images as a process does that has just started; how many steps that took."""
    images, stopping, done = again(hive), threading.Event(), 0
    while images.work_once(stopping):
        done += 1
    made.judge(hive).work_once(stopping)
    return done


def again(hive: Hive) -> ImageWork:
    return ImageWork(hive.settings, hive._installation_below)


def only(hive: Hive):
    (found,) = hive.challenges.submissions("rooms")
    return found


def secret(hive: Hive) -> Path:
    return hive.settings.challenges_folder / "rooms" / "secret"


# -- what is taken ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"images": None}, "say with images how these run"),
        ({"images": {"time_limit_s": 0, "cpu_cores": 1, "memory_mb": 500}}, "time_limit_s"),
        ({"images": {"time_limit_s": 9, "cpu_cores": 1, "memory_mb": 500, "answers_every_h": 5}}, "answers_every_h"),
        (
            {"sequences": [{"name": "a", "secret": True}], "phases": [{"name": "p"}]},
            "sequence a is secret, and names no recording",
        ),
        ({"sequences": [{"name": "a", "time_range_s": [1, 2]}], "phases": [{"name": "p"}]}, "no phase can take images"),
        (
            {"sequences": [{"name": "a", "recording": "nowhere", "secret": True}], "phases": [{"name": "p"}]},
            "groundtruth",
        ),
    ],
)
def test_a_challenge_with_images_that_cannot_be_held_is_refused(hive: Hive, tmp_path: Path, changes, words: str):
    path = made.image_challenge(tmp_path / "organiser")
    content = {**yaml.safe_load(path.read_text()), **changes}
    path.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not None}))
    with pytest.raises(InvalidInput) as error:
        hive.challenges.create(path)
    assert words in str(error.value)
    assert not hive.settings.challenges_folder.exists()


def test_a_secret_recording_is_kept_apart_and_its_times_are_not_published(hive: Hive, engine: Engine, tmp_path: Path):
    folder = hive.settings.challenges_folder / "rooms"
    assert stat.S_IMODE((folder / "secret").stat().st_mode) == 0o700
    public = (folder / "challenge.yaml").read_text()
    assert f"{made.START_S[SECRET] - 0.5}" not in public
    assert f"{made.START_S[OPEN] - 0.5}" in public
    assert "organiser" not in public
    found = hive.challenges.get("rooms")
    shown = {entry.name: (entry.secret, entry.time_range_s is None) for entry in found.sequences}
    assert shown == {SECRET: (True, True), OPEN: (False, False)}
    assert {phase.name: list(phase.takes) for phase in found.phases} == {
        "public": ["images"],
        "open": ["trajectories", "images"],
    }
    assert not (folder / "secret" / "recordings" / SECRET / "groundtruth.txt").exists()
    with pytest.raises(Conflict, match="phase public takes no trajectories"):
        hive.challenges.submit("rooms", Entrant("a"), kept(tmp_path, {f"{SECRET}.txt": b""}), "public")


def test_what_is_no_image_is_refused_and_counts_nothing(hive: Hive, engine: Engine, archive: Path, tmp_path: Path):
    broken = tmp_path / "broken.tar"
    content = archive.read_bytes()
    broken.write_bytes(content[: len(content) // 2])
    text = tmp_path / "text.tar"
    text.write_text("no archive")
    for path, words in ((broken, "broken.tar"), (text, "cannot be read as an archive")):
        with pytest.raises(InvalidInput, match=words):
            send(hive, path)
    with pytest.raises(InvalidInput, match="has no algorithm 'other'"):
        hive.challenges.submit_image("rooms", Entrant("a", algorithm="other"), archive, "public")
    assert hive.challenges.submissions("rooms") == []


def test_mutated_archives_give_a_reason(hive: Hive, archive: Path, tmp_path: Path):
    path, draw, said = tmp_path / "mutated.tar", random.Random(5), []
    for _ in range(60):
        path.write_bytes(mutated(archive.read_bytes(), draw))
        with contextlib.suppress(InvalidInput):
            check_image(path, None, 100)
            continue
        said.append(path)
    assert len(said) > 20


def test_a_small_archive_that_unpacks_to_much_is_refused(tmp_path: Path):
    layer = io.BytesIO()
    with tarfile.open(fileobj=layer, mode="w") as inner:
        _add(inner, "zeros", bytes(30_000_000))
    path = tmp_path / "bomb.tar"
    with tarfile.open(path, mode="w") as outer:
        _add(outer, "layer", gzip.compress(layer.getvalue()))
    assert path.stat().st_size < 100_000
    with pytest.raises(InvalidInput, match=r"bomb\.tar has more than 20 MB when it is unpacked"):
        check_image(path, None, 20)
    whole = tmp_path / "whole.tar.gz"
    whole.write_bytes(gzip.compress(path.read_bytes() + bytes(30_000_000)))
    with pytest.raises(InvalidInput, match="more than 20 MB"):
        check_image(whole, None, 20)
    zstd = tmp_path / "zstd.tar"
    with tarfile.open(zstd, mode="w") as outer:
        _add(outer, "layer", b"\x28\xb5\x2f\xfd" + bytes(100))
    with pytest.raises(InvalidInput, match="zstd"):
        check_image(zstd, None, 20)


def test_limits_and_repeated_sending_are_those_of_trajectories(hive: Hive, archive: Path, tmp_path: Path):
    first = send(hive, archive, phase="open")
    assert send(hive, archive, phase="open").id == first.id
    files = [{f"{OPEN}.txt": text(made.truth(OPEN) + number * 1e-3)} for number in range(3)]
    for entry in files[:2]:
        hive.challenges.submit("rooms", Entrant("a"), kept(tmp_path, entry), "open")
    with pytest.raises(TooManyRequests, match="team a has sent 3"):
        hive.challenges.submit("rooms", Entrant("a"), kept(tmp_path, files[2]), "open")


# -- runs ------------------------------------------------------------------------------------------------------------


def test_an_image_runs_on_all_sequences_and_is_ranked(hive: Hive, engine: Engine, archive: Path):
    sent = send(hive, archive)
    assert work(hive) == 3  # two runs, and the end
    assert [spec.limits.memory_bytes for spec in engine.starts] == [500_000_000] * 2
    assert engine.starts[0].timeout_s == 60
    assert [spec.identity for spec in engine.starts] == [DIGEST] * 2
    waiting = only(hive)
    assert (waiting.state, waiting.values, waiting.run_logs) == ("queued", None, {})
    made.show_results(hive)
    shown = only(hive)
    assert (shown.id, shown.state, shown.log) == (sent.id, "evaluated", ("evaluated",))
    assert shown.values == {SECRET: 0.0, OPEN: 0.0} or max(filter(None, shown.values.values())) < 1e-3
    assert list(shown.run_logs) == [OPEN]
    (team,) = hive.challenges.ranking("rooms", "public").teams
    assert team.team == "a"
    assert engine.images == set()
    assert work(hive) == 0


def test_nothing_of_it_is_in_the_installation_of_the_organiser(hive: Hive, engine: Engine, archive: Path):
    before = (hive.runs.page().records, hive.catalogue.datasets(), [a.name for a in hive.catalogue.algorithms()])
    send(hive, archive)
    work(hive)
    hive.catalogue._parsed.clear()
    assert (
        hive.runs.page().records,
        hive.catalogue.datasets(),
        [a.name for a in hive.catalogue.algorithms()],
    ) == before


@pytest.mark.parametrize("step", range(3))
def test_a_worker_that_is_killed_at_any_step_loses_nothing(hive: Hive, engine: Engine, archive: Path, step: int):
    send(hive, archive)
    for _ in range(step):
        assert again(hive).work_once(threading.Event())
    work(hive)
    made.show_results(hive)
    assert only(hive).state == "evaluated"
    assert len(engine.starts) == 2


def test_a_run_goes_on_after_its_worker_was_stopped(hive: Hive, engine: Engine, archive: Path):
    send(hive, archive)
    engine.statuses = [Running()]
    stopping = threading.Event()
    threading.Timer(2.0, stopping.set).start()
    assert again(hive).work_once(stopping)
    assert not (secret(hive) / "runs" / only(hive).id / "runs.json").exists()
    assert len(engine.starts) == 1
    assert engine.stopped == 0
    engine.statuses = [Exited(0)]
    work(hive)
    made.show_results(hive)
    assert only(hive).state == "evaluated"


def test_a_run_whose_end_nobody_knows_is_made_again(hive: Hive, engine: Engine, archive: Path):
    send(hive, archive)
    engine.on_start = lambda spec: None
    engine.statuses = [Gone("the machine crashed")]
    again(hive).work_once(threading.Event())
    engine.on_start, engine.statuses = engine._leave, [Exited(0)]
    work(hive)
    made.show_results(hive)
    assert only(hive).state == "evaluated"
    assert len(engine.starts) == 3


def test_an_engine_that_is_away_is_asked_again_and_holds_up_nothing(
    hive: Hive, engine: Engine, archive: Path, monkeypatch, caplog: pytest.LogCaptureFixture
):
    send(hive, archive)

    def away(_chunks) -> str:
        raise EngineUnavailable("the engine is away")

    with monkeypatch.context() as patch:
        patch.setattr(engine, "load_image", away)
        images = again(hive)
        assert images.work_once(threading.Event()) == 0
        assert images.work_once(threading.Event()) == 0
    assert caplog.text.count("the engine is away") == 1
    work(hive)
    made.show_results(hive)
    assert only(hive).state == "evaluated"


def test_an_executor_that_does_not_isolate_images_runs_none(
    hive: Hive, engine: Engine, archive: Path, monkeypatch, caplog: pytest.LogCaptureFixture
):
    send(hive, archive)
    monkeypatch.setattr(Engine, "capabilities", replace(Engine.capabilities, isolates=False))
    assert again(hive).work_once(threading.Event()) == 0
    assert "does not isolate images" in caplog.text
    assert engine.starts == []
    assert only(hive).state == "queued"


def test_an_image_that_is_not_the_one_of_its_archive_is_told_in_words(
    hive: Hive, engine: Engine, archive: Path, monkeypatch
):
    send(hive, archive)
    monkeypatch.setattr(engine, "load_image", lambda _chunks: "sha256:" + "0" * 64)
    assert again(hive).work_once(threading.Event())
    made.show_results(hive)
    found = only(hive)
    assert (found.state, found.reason) == ("failed", f"the archive holds image sha256:{'0' * 12}, not {DIGEST[:19]}")
    assert engine.starts == []


def test_failures_are_few_words_for_secret_recordings(hive: Hive, engine: Engine, archive: Path):
    send(hive, archive)
    engine.statuses = [Exited(139)]
    work(hive)
    made.show_results(hive)
    found = only(hive)
    assert (found.state, found.reason) == ("failed", Failure.NO_RUN)
    assert found.log[:2] == (f"{SECRET}: {RunFailure.CRASHED}", f"{OPEN}: {RunFailure.CRASHED}")
    assert "139" in found.run_logs[OPEN]
    assert "139" not in " ".join(found.log)


def test_every_reason_of_a_run_has_few_words():
    found = {reason: RunFailure.of(reason) for reason in FailureReason}
    assert set(found.values()) <= set(RunFailure)
    assert found[FailureReason.TIMEOUT] is found[FailureReason.OUT_OF_MEMORY] is RunFailure.LIMIT
    assert found[FailureReason.LOST] is RunFailure.ORGANISER


def test_the_median_of_repeats_counts_and_a_failure_is_worst():
    assert middle([3.0, 1.0, 2.0], higher_is_better=False) == 2.0
    assert middle([3.0, None, 2.0], higher_is_better=False) == 3.0
    assert middle([None, None, 2.0], higher_is_better=False) is None
    assert middle([1.0, 2.0], higher_is_better=False) == 2.0
    assert middle([1.0, 2.0], higher_is_better=True) == 1.0
    assert middle([], higher_is_better=True) is None


def test_results_are_shown_at_fixed_hours():
    at = datetime(2026, 5, 4, 17, 59, 59, 5, tzinfo=UTC)
    assert shown_at(at, 6) == datetime(2026, 5, 4, 18, tzinfo=UTC)
    assert shown_at(at.replace(hour=18), 6) == datetime(2026, 5, 5, tzinfo=UTC)
    assert shown_at(at, None) == datetime(2026, 5, 4, 18, 0, tzinfo=UTC)


def test_with_constant_time_a_run_takes_its_slot_for_the_whole_limit(
    hive: Hive, engine: Engine, archive: Path, monkeypatch
):
    from slamhive.services.challenges import image_runs  # noqa: PLC0415

    monkeypatch.setattr(image_runs, "SETTLE_S", 2.0)
    path = hive.settings.challenges_folder / "rooms" / "challenge.yaml"
    path.write_text(
        path.read_text()
        .replace("constant_time: false", "constant_time: true")
        .replace("time_limit_s: 60.0", "time_limit_s: 4")
    )
    send(hive, archive)
    taken_s = []
    for _ in range(2):
        began = datetime.now(UTC)
        assert again(hive).work_once(threading.Event())
        taken_s.append((datetime.now(UTC) - began).total_seconds())
    assert all(entry >= 6.0 for entry in taken_s)
    assert abs(taken_s[0] - taken_s[1]) < 3.0


# -- cancelling, removing --------------------------------------------------------------------------------------------


def test_a_cancelled_submission_ends_and_counts_for_its_day(hive: Hive, engine: Engine, archive: Path):
    sent = send(hive, archive, account="rita")
    with pytest.raises(NotFound, match="unknown submission"):
        hive.challenges.cancel("rooms", sent.id, "max")
    again(hive).work_once(threading.Event())
    assert hive.challenges.cancel("rooms", sent.id, "rita").state == "cancelled"
    work(hive)
    made.show_results(hive)
    found = only(hive)
    assert (found.state, found.reason, found.values, found.run_logs) == ("cancelled", None, None, {})
    assert engine.images == set()
    assert hive.challenges.ranking("rooms", "public").teams == ()
    assert hive.challenges.submissions("rooms", "rita")[0].id == sent.id


def test_a_run_is_ended_when_its_submission_is_cancelled(hive: Hive, engine: Engine, archive: Path):
    sent = send(hive, archive)
    engine.statuses = [Running()]

    def cancel_once_it_runs() -> None:
        eventually(lambda: bool(engine.starts), "the start of the run")
        hive.challenges.cancel("rooms", sent.id)

    team = threading.Thread(target=cancel_once_it_runs)
    team.start()
    work(hive)
    team.join()
    assert engine.stopped == 1
    assert only(hive).state == "cancelled"


def test_whether_a_result_waits_to_be_shown_cannot_be_found_out_by_cancelling(
    hive: Hive, engine: Engine, archive: Path
):
    sent = send(hive, archive)
    work(hive)
    assert only(hive).state == "queued"
    assert hive.challenges.cancel("rooms", sent.id).state == "cancelled"
    made.show_results(hive)
    assert hive.challenges.ranking("rooms", "public").teams == ()


def test_a_result_that_is_shown_cannot_be_cancelled(hive: Hive, engine: Engine, archive: Path):
    sent = send(hive, archive)
    work(hive)
    made.show_results(hive)
    with pytest.raises(Conflict, match="is shown already"):
        hive.challenges.cancel("rooms", sent.id)


def test_removing_a_challenge_takes_its_images_along(hive: Hive, engine: Engine, archive: Path):
    send(hive, archive)
    again(hive).work_once(threading.Event())
    assert engine.images == {DIGEST}
    done = call(hive, "remove", "rooms", "--yes")
    assert (done.exit_code, done.stdout) == (0, "challenge rooms is removed\n")
    assert engine.images == set()
    assert list(hive.settings.challenges_folder.iterdir()) == []


# -- commands --------------------------------------------------------------------------------------------------------


def call(hive: Hive, *arguments: str) -> Result:
    return CliRunner().invoke(main, ["--data", str(hive.settings.data), "challenge", *arguments])


def test_the_commands_for_images(hive: Hive, engine: Engine, archive: Path):
    shown = call(hive, "show", "rooms").stdout
    assert "Images: 1 run on each sequence with 1 core, 500 MB and 60 s." in shown
    assert "secret" in shown
    checked = call(hive, "submit", "rooms", "--image", str(archive), "--team", "a", "--phase", "public", "--dry-run")
    assert checked.stdout.startswith("package team-"), checked.output
    assert hive.challenges.submissions("rooms") == []
    sent = call(hive, "submit", "rooms", "--image", str(archive), "--team", "a", "--phase", "public", "--json")
    name = json.loads(sent.stdout)["id"]
    cancelled = call(hive, "cancel", "rooms", name)
    assert cancelled.stdout == f"submission {name} of team a is cancelled\n"
    assert "it was cancelled" in call(hive, "log", "rooms", name).stdout
    both = call(hive, "submit", "rooms", "--image", str(archive), "--package", "tiny", "--team", "a")
    assert "Give either FILES, or --image, or --package" in both.stderr


def test_a_package_of_the_installation_can_be_named(hive: Hive, engine: Engine):
    engine.images.add(DIGEST)
    hive.versions.register(engine, hive.catalogue.package("tiny"), DIGEST)
    sent = call(hive, "submit", "rooms", "--package", "tiny", "--team", "a", "--phase", "public", "--json")
    assert sent.exit_code == 0, sent.output
    assert json.loads(sent.stdout)["image"] == "tiny@1"
    work(hive)
    made.show_results(hive)
    assert only(hive).state == "evaluated"
    unknown = call(hive, "submit", "rooms", "--package", "tiny@7", "--team", "a", "--phase", "public")
    assert "there is no version 7 of tiny" in unknown.stderr


def test_runs_of_an_image_can_be_looked_at_by_the_organiser(hive: Hive, engine: Engine, archive: Path):
    sent = send(hive, archive)
    work(hive)
    data = secret(hive) / "runs" / sent.id
    shown = CliRunner().invoke(main, ["--data", str(data), "runs", "--json"])
    assert {entry["dataset"] for entry in json.loads(shown.stdout)} == {OPEN, SECRET}
    assert {entry["state"] for entry in json.loads(shown.stdout)} == {RunState.SUCCEEDED}


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("weights:\n- {name: net.pth, licence: MIT, page: https://example.org/page}\n", "needs the weights net.pth"),
        ("gpu: required\n", "requires a GPU"),
    ],
)
def test_what_no_recording_could_change_is_told_in_full(hive: Hive, engine: Engine, tmp_path: Path, more, words: str):
    """These reasons cannot carry anything of a recording."""
    engine.images.add(DIGEST)
    package = made.write_package(hive.project_root / "algorithms" / "demanding", name="demanding")
    with (package / "algorithm.yaml").open("a") as stream:
        stream.write(more)
    hive.versions.register(engine, hive.catalogue.package("demanding"), DIGEST)
    version = hive.versions.find("demanding")
    hive.challenges.submit_version("rooms", Entrant("a"), version, "public")
    work(hive)
    made.show_results(hive)
    found = only(hive)
    assert (found.state, words in str(found.reason)) == ("failed", True), found.reason
    assert engine.starts == []


def test_weights_of_a_package_of_the_server_are_there(hive: Hive, engine: Engine, tmp_path: Path):
    engine.images.add(DIGEST)
    package = made.write_package(hive.project_root / "algorithms" / "learned", name="learned")
    with (package / "algorithm.yaml").open("a") as stream:
        stream.write("weights:\n- {name: net.pth, licence: MIT, page: https://example.org/page}\n")
    (tmp_path / "net.pth").write_bytes(b"numbers")
    WeightsStore(hive.settings).add(hive.catalogue.package("learned"), tmp_path / "net.pth")
    hive.versions.register(engine, hive.catalogue.package("learned"), DIGEST)
    hive.challenges.submit_version("rooms", Entrant("a"), hive.versions.find("learned"), "public")
    work(hive)
    made.show_results(hive)
    assert only(hive).state == "evaluated"
