"""The cache of variants: made once, whole or absent, removed oldest first, never under anybody's feet."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound, Unavailable
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.staging import checksum, seal
from slamhive.recordings.variants.cache import MANIFEST, CacheLimits, VariantCache, VariantPlan, is_held

pytestmark = pytest.mark.quick

SIZE = 1000
ROOMY = CacheLimits(10**9)


def plan(key: str = "aa11", needed_bytes: int = SIZE) -> VariantPlan:
    return VariantPlan(
        key, "track", ({"kind": "rate", "sensors": ["lidar"], "options": {"every": 2}},), needed_bytes, 2000
    )


def silent(_fraction: float, _text: str) -> None:
    pass


class Builder:
    """Writes a recording of ``SIZE`` bytes and counts how often."""

    def __init__(self, content: bytes = b"x" * SIZE) -> None:
        self.content = content
        self.calls = 0

    def __call__(self, folder: Path, progress) -> Dataset:
        self.calls += 1
        progress(0.5, "writing")
        bag = folder / "track.bag"
        bag.write_bytes(self.content)
        sensor = Sensor("lidar", SensorKind.LIDAR, "/points", 5.0)
        made = Dataset("track", folder, "track.bag", 10.0, (sensor,), None, checksum(bag))
        seal(folder, made)
        return made


def make(cache: VariantCache, key: str, builder: Builder | None = None, needed_bytes: int = SIZE) -> Dataset:
    with cache.hold(plan(key, needed_bytes), builder or Builder(), silent) as dataset:
        return dataset


def keys(cache: VariantCache) -> list[str]:
    return [entry.key for entry in cache.entries()]


def age(root: Path, key: str, seconds: float) -> None:
    stamp = time.time() - seconds
    os.utime(root / key / MANIFEST, (stamp, stamp))


def test_a_variant_is_made_once_and_found_again(tmp_path):
    builder = Builder()
    cache = VariantCache(tmp_path / "variants", ROOMY)
    first = make(cache, "aa11", builder)
    second = make(VariantCache(tmp_path / "variants", ROOMY), "aa11", builder)
    assert builder.calls == 1
    assert first == second
    assert first.bag_path == tmp_path / "variants" / "aa11" / "track.bag"
    assert first.bag_path.read_bytes() == builder.content


def test_many_threads_that_ask_at_once_share_one_build(tmp_path):
    builder = Builder()
    start = threading.Barrier(8)

    def ask(_number: int) -> Path:
        start.wait()
        return make(VariantCache(tmp_path, ROOMY), "aa11", builder).bag_path

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(ask, range(8))) == {tmp_path / "aa11" / "track.bag"}
    assert builder.calls == 1


def test_entries_tell_what_there_is(tmp_path):
    cache = VariantCache(tmp_path, ROOMY)
    assert cache.entries() == ()
    make(cache, "aa11")
    (entry,) = cache.entries()
    assert (entry.key, entry.dataset, entry.in_use) == ("aa11", "track", False)
    assert entry.steps[0]["options"] == {"every": 2}
    assert SIZE < entry.size_bytes < SIZE + 10_000
    assert entry.used_at >= entry.made_at.replace(microsecond=0)
    with cache.hold(plan(), Builder(), silent):
        assert cache.entries()[0].in_use


def test_find_takes_the_beginning_of_a_key(tmp_path):
    cache = VariantCache(tmp_path, ROOMY)
    make(cache, "aa11")
    make(cache, "ab22")
    assert cache.find("aa").key == "aa11"
    with pytest.raises(InvalidInput, match="'a' is not clear: aa11, ab22"):
        cache.find("a")
    for absent in ("cc", ""):
        with pytest.raises(NotFound, match="unknown variant"):
            cache.find(absent)


# -- builds that go wrong ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (InvalidInput("damaged"), InvalidInput),
        (OSError(28, "No space left on device"), Unavailable),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_build_that_fails_leaves_nothing(tmp_path, error, expected):
    def build(folder: Path, progress) -> Dataset:
        (folder / "track.bag").write_bytes(b"half")
        raise error

    cache = VariantCache(tmp_path, ROOMY)
    with pytest.raises(expected), cache.hold(plan(), build, silent):
        pytest.fail("must not be reached")
    assert cache.entries() == ()
    assert list(tmp_path.glob(".*.partial")) == []
    make(cache, "aa11")


KILLED = """
    import sys, time
    from pathlib import Path
    from slamhive.recordings.variants.cache import CacheLimits, VariantCache
    from slamhive.recordings.variants.cache import VariantPlan

    def build(folder, progress):
        (folder / "track.bag").write_bytes(b"half")
        (folder / "dataset.yaml").write_text("format: 1")
        print("building", flush=True)
        time.sleep(60)

    cache = VariantCache(Path(sys.argv[1]), CacheLimits(10**9))
    with cache.hold(VariantPlan("aa11", "track", (), 1000, 2000), build, lambda fraction, text: None):
        print("never", flush=True)
"""


@pytest.mark.integration
def test_a_killed_build_is_not_taken_for_good(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "building\n"
    cache = VariantCache(tmp_path, ROOMY)
    waited: list[str] = []

    def waiting(_fraction: float, text: str) -> None:
        if not waited:
            process.send_signal(signal.SIGKILL)
        waited.append(text)

    assert cache.entries() == ()
    builder = Builder()
    with cache.hold(plan(), builder, waiting) as dataset:
        assert dataset.bag_path.read_bytes() == builder.content
    process.wait()
    process.stdout.close()
    assert waited[0] == "waiting for another process"
    assert builder.calls == 1
    assert list(tmp_path.glob(".*.partial")) == []


def test_what_a_killed_build_left_behind_makes_room(tmp_path):
    cache = VariantCache(tmp_path, ROOMY)
    left = tmp_path / ".dead.partial"
    left.mkdir()
    (left / "track.bag").write_bytes(b"half")
    make(cache, "aa11")
    assert not left.exists()


def test_waiting_for_another_process_can_be_ended(tmp_path):
    cache = VariantCache(tmp_path, ROOMY)
    building, go_on = threading.Event(), threading.Event()

    def slow(folder: Path, progress) -> Dataset:
        building.set()
        go_on.wait(10)
        return Builder()(folder, progress)

    def give_up(_fraction: float, _text: str) -> None:
        raise Conflict("cancelled")

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(lambda: contextlib.ExitStack().enter_context(cache.hold(plan(), slow, silent)))
        assert building.wait(5)
        with pytest.raises(Conflict, match="cancelled"), cache.hold(plan(), Builder(), give_up):
            pytest.fail("must not be reached")
        go_on.set()
        assert first.result().name == "track"


# -- damage ------------------------------------------------------------------------------------------------------------


def test_a_truncated_variant_is_made_anew(tmp_path):
    cache = VariantCache(tmp_path, ROOMY)
    bag = make(cache, "aa11").bag_path
    bag.write_bytes(b"short")
    assert cache.verify("aa11") == "track.bag has 5 bytes, 1000 were written"
    builder = Builder()
    make(cache, "aa11", builder)
    assert builder.calls == 1
    assert cache.verify("aa11") is None


@pytest.mark.parametrize("damaged", [MANIFEST, "dataset.yaml", "track.bag"])
def test_a_variant_with_a_file_lost_or_emptied_is_made_anew(tmp_path, damaged):
    cache = VariantCache(tmp_path, ROOMY)
    for harm in (Path.unlink, lambda path: path.write_text("{}")):
        folder = make(cache, "aa11").folder
        harm(folder / damaged)
        assert cache.verify("aa11") is not None
        builder = Builder()
        make(cache, "aa11", builder)
        assert builder.calls == 1


def test_verify_reads_every_byte(tmp_path):
    cache = VariantCache(tmp_path, ROOMY)
    bag = make(cache, "aa11").bag_path
    bag.write_bytes(b"y" + bag.read_bytes()[1:])
    assert cache.verify("aa11") == "track.bag has changed since it was written"
    assert json.loads((bag.parent / MANIFEST).read_text())["files"]["track.bag"][0] == SIZE


# -- room --------------------------------------------------------------------------------------------------------------


def entry_bytes(root: Path) -> int:
    cache = VariantCache(root, ROOMY)
    make(cache, "size")
    size = cache.entries()[0].size_bytes
    cache.drop("size")
    return size


def test_the_least_recently_used_goes_first(tmp_path):
    size = entry_bytes(tmp_path)
    cache = VariantCache(tmp_path, CacheLimits(3 * size))
    for key in ("aa11", "bb22", "cc33"):
        make(cache, key)
    for seconds, key in enumerate(("cc33", "bb22", "aa11")):
        age(tmp_path, key, 100 * (seconds + 1))
    make(cache, "aa11")
    make(cache, "dd44")
    assert keys(cache) == ["dd44", "aa11", "cc33"]


def test_what_is_in_use_stays_although_there_is_no_room(tmp_path):
    size = entry_bytes(tmp_path)
    cache = VariantCache(tmp_path, CacheLimits(2 * size))
    with cache.hold(plan("aa11"), Builder(), silent), cache.hold(plan("bb22"), Builder(), silent):
        make(cache, "cc33")
        assert set(keys(cache)) == {"aa11", "bb22"} | {"cc33"} & set(keys(cache))
        with pytest.raises(Conflict, match="variant aa11 is in use"):
            cache.drop("aa11")
    cache.drop("aa11")
    assert "aa11" not in keys(cache)


def test_what_runs_without_a_worker_stays(tmp_path):
    size = entry_bytes(tmp_path)
    cache = VariantCache(tmp_path, CacheLimits(2 * size), lambda: {"aa11"})
    for key in ("aa11", "bb22", "cc33"):
        make(cache, key)
    age(tmp_path, "aa11", 1000)
    make(cache, "dd44")
    assert set(keys(cache)) == {"aa11", "dd44"}
    with pytest.raises(Conflict, match="variant aa11 is in use"):
        cache.drop("aa11")


def test_a_run_that_goes_on_keeps_its_variant(tmp_path):
    cache = VariantCache(tmp_path, ROOMY)
    make(cache, "aa11")
    with cache.hold_made("aa11"), pytest.raises(Conflict, match="in use"):
        VariantCache(tmp_path, ROOMY).drop("aa11")
    cache.drop("aa11")
    with cache.hold_made("aa11"):
        assert cache.entries() == ()


@pytest.mark.integration
def test_a_killed_process_uses_nothing_any_more(tmp_path):
    make(VariantCache(tmp_path, ROOMY), "aa11")
    script = """
        import sys, time
        from pathlib import Path
        from slamhive.recordings.variants.cache import CacheLimits, VariantCache
        with VariantCache(Path(sys.argv[1]), CacheLimits(10**9)).hold_made("aa11"):
            print("holding", flush=True)
            time.sleep(60)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "holding\n"
    cache = VariantCache(tmp_path, ROOMY)
    assert cache.entries()[0].in_use
    process.kill()
    process.wait()
    process.stdout.close()
    assert not cache.entries()[0].in_use
    cache.drop("aa11")
    assert list(tmp_path.glob("aa11*")) == []


def test_a_process_that_only_asks_is_no_holder(tmp_path, monkeypatch):
    lock = tmp_path / "aa11.lock"
    asking = os.open(lock, os.O_RDONLY | os.O_CREAT)
    fcntl.flock(asking, fcntl.LOCK_EX)
    monkeypatch.setattr(time, "sleep", lambda _seconds: os.close(asking))  # meanwhile it has its answer
    assert not is_held(lock)


def test_what_can_never_fit_is_refused_before_anything_is_written(tmp_path):
    cache = VariantCache(tmp_path, CacheLimits(10_000_000))
    make(cache, "aa11")
    builder = Builder()
    with pytest.raises(InvalidInput, match="may need 20 MB, the cache is to hold 10 MB; raise VARIANT_CACHE_BYTES"):
        make(cache, "bb22", builder, needed_bytes=20_000_000)
    assert builder.calls == 0
    assert keys(cache) == ["aa11"]


def test_a_disk_that_is_too_small_is_seen_beforehand(tmp_path, monkeypatch):
    free_bytes = shutil.disk_usage(tmp_path).free
    builder = Builder()
    cache = VariantCache(tmp_path, CacheLimits(free_bytes * 4, free_bytes=free_bytes // 2))
    with pytest.raises(Unavailable, match="MB to spare, a variant of track needs about"):
        make(cache, "aa11", builder, needed_bytes=free_bytes)
    assert builder.calls == 0
    assert list(tmp_path.glob(".*.partial")) == []


def test_unused_variants_give_way_to_a_full_disk(tmp_path, monkeypatch):
    cache = VariantCache(tmp_path, CacheLimits(10**9))
    make(cache, "aa11")
    usage = shutil.disk_usage(tmp_path)

    def fuller(_path: Path) -> object:
        return usage._replace(free=100 if (tmp_path / "aa11").exists() else 5000)

    monkeypatch.setattr(shutil, "disk_usage", fuller)
    make(cache, "bb22")
    assert keys(cache) == ["bb22"]


def test_two_builds_count_on_the_same_disk_together(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=1_500)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage)
    cache = VariantCache(tmp_path, CacheLimits(10**9))

    def build(folder: Path, progress) -> Dataset:
        with pytest.raises(Unavailable, match="needs about"):
            make(VariantCache(tmp_path, CacheLimits(10**9)), "bb22")
        return Builder()(folder, progress)

    with cache.hold(plan("aa11"), build, silent) as dataset:
        assert dataset.name == "track"


def test_the_dataset_in_the_cache_lies_in_its_folder(tmp_path):
    made = make(VariantCache(tmp_path, ROOMY), "aa11")
    assert replace(made, folder=Path()) == replace(make(VariantCache(tmp_path, ROOMY), "aa11"), folder=Path())
    assert made.folder == tmp_path / "aa11"
