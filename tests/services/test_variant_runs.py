"""Runs on variants of a dataset: what the run sees, what is written down, and what goes wrong."""

from __future__ import annotations

import dataclasses
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound, Unavailable
from slamhive.base.tree import folder_bytes
from slamhive.documents.run import RunDocument
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import Configuration, VariantStep, parse_step
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import RunHandle
from slamhive.recordings.reader import inspect_bag
from slamhive.recordings.variants import build as building
from slamhive.recordings.variants.build import build_variant
from slamhive.recordings.variants.cache import MANIFEST
from slamhive.runtime import config as run_config
from slamhive.services.datasets.variants import IDENTITY
from slamhive.services.experiments.context import GUESSED_BUILD_S, GUESSED_OVERHEAD_S, GUESSED_START_S
from slamhive.services.experiments.previewing import UNMEASURED_BYTES_PER_S
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex
from slamhive.services.worker import worker as worker_module
from tests.services.fake_executor import FakeExecutor, Running, write_trajectory
from tests.services.recorded_track import SCANS, make_recorded_track
from tests.services.tiny_project import environment, make_project

pytestmark = pytest.mark.integration

HALF = (
    VariantStep("rate", ("lidar",), {"every": 2}),
    VariantStep("point_range", ("lidar",), {"minimum_m": 0.0, "maximum_m": 20.0}),
)
REFUSED: dict[str, tuple[type[Exception], str]] = {
    "rate hz=50": (InvalidInput, r"step rate: 50 Hz is above the 10 Hz of lidar \(/points\)"),
    "resolution@lidar scale=0.5": (InvalidInput, r"step resolution cannot be used on lidar \(/points\)"),
    "resolution scale=0.5": (InvalidInput, "step resolution: dataset track has no sensor for it"),
    "resolution@lidar scale=0": (InvalidInput, "step resolution: scale: .*greater than 0"),
    "rate@cam0 every=2": (NotFound, "dataset track has no sensor 'cam0'"),
    "blur radius=2": (NotFound, "unknown pre-processing step 'blur'"),
    "fog visibility=2": (InvalidInput, "step fog: .*visibility"),
}


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path) -> Iterator[Hive]:
    make_project(tmp_path / "project")
    make_recorded_track(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    for key, value in environment(tmp_path / "project", tmp_path / "data", poll_interval_s="0.01").items():
        monkeypatch.setenv(key, value)
    for name in ("TROUBLE_PAUSE_S", "IDLE_PAUSE_S", "CANCEL_CHECK_S"):
        monkeypatch.setattr(worker_module, name, 0.01)
    opened = open_hive()
    yield opened
    opened.close()


def submit(hive: Hive, executor: FakeExecutor | None = None, **changes: Any) -> int:
    hive.executors.opened["process"] = executor or FakeExecutor(on_start=write_trajectory())
    return hive.runs.submit(Submission("tiny", "track", evaluate=False, **{"variant": HALF, **changes}))[0].id


def finish(hive: Hive, executor: FakeExecutor | None = None, **changes: Any):
    run_id = submit(hive, executor, **changes)
    hive.worker().run(until_idle=True)
    return hive.runs.get(run_id)


def inputs(executor: FakeExecutor) -> dict[str, Path]:
    return {entry.target: entry.source for entry in executor.starts[0].inputs}


def test_a_run_sees_the_variant_and_its_calibration(hive):
    executor = FakeExecutor(on_start=write_trajectory())
    run = finish(hive, executor)
    assert run.state is RunState.SUCCEEDED, run.detail
    (entry,) = hive.variants.entries()
    bag = inputs(executor)["/slamhive/dataset/track.bag"]
    assert bag == hive.settings.variants_folder / entry.key / "track.bag"
    assert inputs(executor)["/slamhive/dataset/dataset.yaml"].parent == bag.parent
    assert inspect_bag(bag).topics[0].count == SCANS // 2
    config = run_config.load(hive.runs.folder(run.id).config)
    assert config.dataset == "track"
    assert config.dataset_frequency == {"/points": 2}
    assert config.dataset_parameters["points_rate_hz"] == 5.0
    assert config.dataset_parameters["points_maximum_range_m"] == 20.0


def test_the_record_says_which_variant_it_was(hive):
    run = finish(hive)
    (entry,) = hive.variants.entries()
    record = hive.runs.record(run.id)
    source = hive.catalogue.dataset("track")
    assert record["dataset"]["variant"] == entry.key
    assert record["dataset"]["checksum"] == source.checksum != record["dataset"]["variant_checksum"]
    assert record["request"]["variant"] == RunDocument.of(run).content["variant"] == list(map(dict, entry.steps))
    assert run.variant == HALF
    assert run.dataset_checksum == source.checksum


def test_the_folder_alone_brings_the_variant_back(hive, tmp_path):
    run = finish(hive)
    other = open_hive({"database_url": f"sqlite:///{tmp_path}/other.db"})
    try:
        assert reindex(other, lambda _done, _total: None).skipped == []
        found = other.runs.get(run.id)
        assert found.variant == HALF
        assert other.store.read(lambda t: t.configurations.get(found.configuration_id)).variant == HALF
    finally:
        other.close()


def test_runs_of_one_variant_share_it(hive, monkeypatch):
    built: list[str] = []

    def build(dataset, variant, folder, progress):
        built.append(folder.name)
        return build_variant(dataset, variant, folder, progress)

    monkeypatch.setattr(building, "build_variant", build)
    first, second = submit(hive), submit(hive, repeat=2)
    hive.worker().run(until_idle=True)
    assert {hive.runs.get(run_id).state for run_id in (first, second, second + 1)} == {RunState.SUCCEEDED}
    assert len(built) == 1
    assert hive.runs.get(first).configuration_id == hive.runs.get(second).configuration_id


def test_the_identity_is_the_dataset_itself(hive):
    same = [(), (VariantStep("rate", ("lidar",), {"every": 1}),), (parse_step("rate hz=10"),)]
    runs = [hive.runs.get(submit(hive, variant=variant)) for variant in same]
    assert len({run.configuration_id for run in runs}) == 1
    executor = FakeExecutor(on_start=write_trajectory())
    run = finish(hive, executor, variant=same[1])
    assert run.variant == ()
    assert hive.runs.record(run.id)["dataset"]["variant"] == IDENTITY
    assert inputs(executor)["/slamhive/dataset/track.bag"] == hive.catalogue.dataset("track").bag_path
    assert not hive.settings.variants_folder.exists()
    assert hive.store.read(lambda t: t.configurations.get(run.configuration_id)) == Configuration(
        "tiny", "track", dict(run.parameters), run.playback
    )


def test_text_and_typed_options_are_one_configuration(hive):
    typed = hive.runs.get(submit(hive))
    text = hive.runs.get(
        submit(hive, variant=(parse_step("rate@lidar every=2"), parse_step("point_range maximum_m=20")))
    )
    assert typed.configuration_id == text.configuration_id


def test_steps_that_cannot_be_are_refused_before_anything_is_stored(hive):
    for step, (kind, message) in REFUSED.items():
        with pytest.raises(kind, match=message):
            submit(hive, variant=(parse_step(step),))
    assert hive.runs.counts() == dict.fromkeys(hive.runs.counts(), 0)


@pytest.mark.parametrize("text", ["", " ", "@lidar", "rate every", "rate =2", "rate every=2 every=3"])
def test_a_step_that_cannot_be_read_shows_the_form(text):
    with pytest.raises(InvalidInput, match="KIND@SENSOR,SENSOR OPTION=VALUE"):
        parse_step(text)


def test_a_cache_that_is_too_small_is_said_at_once(hive, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_VARIANT_CACHE_BYTES", "1000")
    small = open_hive()
    try:
        with pytest.raises(InvalidInput, match="the cache is to hold 0 MB; raise VARIANT_CACHE_BYTES"):
            submit(small)
    finally:
        small.close()


class MakingExecutor(FakeExecutor):
    """Its nodes make variants."""

    capabilities = dataclasses.replace(FakeExecutor.capabilities, makes_variants=True)

    def start(self, spec: RunSpec) -> RunHandle:
        return dataclasses.replace(super().start(spec), variant_checksum="sha256:made")


def test_a_node_that_makes_the_variant_gets_recording_and_recipe(hive, monkeypatch):
    """The worker makes nothing and needs no room for it; the record has the checksum that the node reports."""
    monkeypatch.setenv("SLAMHIVE_VARIANT_CACHE_BYTES", "1000")
    small = open_hive()
    try:
        executor = MakingExecutor(on_start=write_trajectory())
        run = finish(small, executor)
        assert run.state is RunState.SUCCEEDED, run.detail
        source = small.catalogue.dataset("track")
        assert small.variants.entries() == ()
        assert inputs(executor)["/slamhive/dataset/track.bag"] == source.bag_path
        order = executor.starts[0].variant
        assert order is not None
        assert (order.dataset, order.description) == ("track", (source.folder / "dataset.yaml").read_text())
        record = small.runs.record(run.id)
        assert record["dataset"]["variant"] == order.key
        assert record["dataset"]["checksum"] == source.checksum
        assert record["dataset"]["variant_checksum"] == "sha256:made"
        assert record["spec"]["variant"]["key"] == order.key
        config = run_config.load(small.runs.folder(run.id).config)
        assert config.dataset_parameters["points_rate_hz"] == 5.0
        assert reindex(small, lambda _done, _total: None).skipped == []
        preview = small.experiments.preview(ExperimentSource(HALVED), nodes=1)
        assert preview.refusals == ()
        assert preview.cluster is not None
        assert preview.cluster.moved_bytes == source.bag_path.stat().st_size, "the recording moves once"
        assert not [warning for warning in preview.warnings if "variants" in warning]
        small.executors.opened["process"] = FakeExecutor()
        (refusal,) = small.experiments.preview(ExperimentSource(HALVED)).refusals
        assert "the cache holds 0 MB; raise VARIANT_CACHE_BYTES" in refusal
    finally:
        small.close()


def test_a_disk_that_is_too_small_is_said_at_once(hive, monkeypatch):
    nearly_full = shutil.disk_usage(hive.settings.data)._replace(free=1_500_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: nearly_full)
    with pytest.raises(Unavailable, match=r"has 0 MB to spare, a variant of track needs about 1 MB"):
        submit(hive)
    assert sum(hive.runs.counts().values()) == 0


def test_a_recording_that_cannot_be_treated_fails_the_run(hive):
    run_id = submit(hive)
    bag = hive.catalogue.dataset("track").bag_path
    bag.write_bytes(bag.read_bytes()[:2000])
    hive.worker().run(until_idle=True)
    run = hive.runs.get(run_id)
    assert (run.state, run.reason) == (RunState.FAILED, FailureReason.PREPROCESS_ERROR)
    assert "track.bag cannot be read" in (run.detail or "")
    assert hive.variants.entries() == ()


def test_a_variant_in_use_stays(hive):
    tried: list[str] = []

    def on_start(spec) -> None:
        (entry,) = hive.variants.entries()
        assert entry.in_use
        with pytest.raises(Conflict, match="in use"):
            hive.variants.drop(entry.key)
        tried.append(entry.key)
        write_trajectory()(spec)

    finish(hive, FakeExecutor(on_start=on_start))
    (entry,) = hive.variants.entries()
    assert tried == [entry.key]
    assert not entry.in_use
    hive.variants.drop(entry.key)
    assert hive.variants.entries() == ()


def test_a_run_whose_worker_left_keeps_its_variant(hive):
    executor = FakeExecutor([Running()], write_trajectory())
    run_id = submit(hive, executor)
    worker = hive.worker()
    thread = threading.Thread(target=worker.run)
    thread.start()
    while hive.runs.get(run_id).state is not RunState.RUNNING:
        thread.join(0.01)
    worker.stop()
    thread.join()
    (entry,) = hive.variants.entries()
    assert entry.in_use
    with pytest.raises(Conflict, match="in use"):
        hive.variants.drop(entry.key)
    executor.stop(None, 0)  # type: ignore[arg-type]
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run_id).state.ended
    hive.variants.drop(entry.key)


def test_a_run_can_be_cancelled_while_its_variant_is_made(hive, monkeypatch):
    run_id = submit(hive)

    def build(dataset, variant, folder, progress):
        hive.runs.cancel(run_id)
        while True:
            progress(0.1, "making")

    monkeypatch.setattr(building, "build_variant", build)
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run_id).state is RunState.CANCELLED
    assert list(hive.settings.variants_folder.glob(".*.partial")) == []


HALVED = """
name: halved
algorithms: tiny
datasets: track
steps:
  scans: {step: rate, sensors: lidar, every: 1 | 2 | 3}
evaluate: false
executor: process
"""


def test_a_plan_counts_the_time_of_making_variants(hive):
    source = ExperimentSource(HALVED)
    bag_bytes = hive.catalogue.dataset("track").bag_path.stat().st_size
    before = hive.experiments.preview(source)
    assert [need.make_s for need in before.variants] == [pytest.approx(bag_bytes / UNMEASURED_BYTES_PER_S)] * 2
    run_s = GUESSED_START_S + 1.9 + GUESSED_OVERHEAD_S
    assert before.time_s == pytest.approx(3 * run_s + GUESSED_BUILD_S + before.variant_time_s)

    with hive.variants.hold(hive.catalogue.dataset("track"), HALF[:1], lambda _fraction, _text: None):
        pass
    (entry,) = hive.variants.entries()
    after = hive.experiments.preview(source)
    assert [need.made for need in after.variants] == [True, False]
    assert after.variant_time_s == pytest.approx(bag_bytes / entry.bytes_per_s)

    # Made before it was written down how fast.
    manifest = hive.settings.variants_folder / entry.key / MANIFEST
    manifest.write_text(manifest.read_text().replace("bytes_per_s", "other"))
    assert hive.experiments.preview(source).variant_time_s == pytest.approx(bag_bytes / UNMEASURED_BYTES_PER_S)


def test_a_run_folder_that_changes_while_it_is_measured_is_no_error(hive):
    folder = hive.settings.runs_folder / "1"
    folder.mkdir()
    (folder / "a").write_bytes(bytes(1000))
    (folder / "gone").symlink_to("gone")
    (folder / "large").symlink_to("/dev/zero")
    assert folder_bytes(folder) < 1100
    assert folder_bytes(folder / "absent") == 0
    assert hive.experiments.preview(ExperimentSource(HALVED)).run_bytes < 3300
