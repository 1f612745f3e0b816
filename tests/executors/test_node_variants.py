"""Variants that a node makes: the bytes are those that the controller would make, and nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.tree import folder_bytes
from slamhive.documents.model import adapter, dump
from slamhive.domain.configuration import VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.executors.node_store.controller import make
from slamhive.executors.node_store.on_node.cache import Cache, Item, sha256_of
from slamhive.executors.node_store.on_node.run import _MODULE, WrongNode, hold_variant, item_of, make_apart, read_made
from slamhive.executors.slurm.jobs import job_request
from slamhive.executors.spec import VariantOrder
from slamhive.packages.dataset_file import dataset_to_yaml, load_dataset
from slamhive.recordings.staging import checksum
from slamhive.recordings.variants import build as planning
from slamhive.recordings.variants.build import build_variant, plan_variant
from tests.executors.test_slurm_units import SPEC
from tests.services.recorded_track import make_recorded_track

pytestmark = pytest.mark.integration

MAKER = [sys.executable, "-m", _MODULE]
STEPS = (VariantStep("rate", ("lidar",), {"every": 2}), VariantStep("range_noise", ("lidar",), {"sigma_m": 0.1}))


def order_of(dataset: Dataset, steps: tuple[VariantStep, ...] = STEPS) -> VariantOrder:
    plan = plan_variant(dataset, steps)
    assert plan is not None
    return VariantOrder(
        plan.key, dataset.name, dataset_to_yaml(dataset), tuple(map(dict, plan.steps)), plan.needed_bytes
    )


def content_of(order: VariantOrder) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(json.dumps(dump(VariantOrder, order)))
    return content


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return load_dataset(make_recorded_track(tmp_path / "data").folder)


@pytest.fixture
def recording(dataset: Dataset, tmp_path: Path) -> Path:
    """As it lies in the cache of a node: alone, under another name."""
    return dataset.bag_path.rename(tmp_path / "0123abcd")


@pytest.fixture
def controller_made(dataset: Dataset, tmp_path: Path) -> Dataset:
    folder = tmp_path / "controller"
    folder.mkdir()
    return build_variant(dataset, STEPS, folder, lambda _done, _words: None)


def test_it_is_the_variant_that_the_controller_would_make(dataset, controller_made, recording, tmp_path):
    (folder := tmp_path / "node").mkdir()
    fractions: list[float] = []
    make_apart(MAKER, content_of(order_of(dataset)), recording, folder, fractions.append)
    made = load_dataset(folder)
    assert made.checksum == controller_made.checksum == checksum(made.bag_path)
    assert (folder / "dataset.yaml").read_bytes() == (controller_made.folder / "dataset.yaml").read_bytes()
    others = {path.name for path in controller_made.folder.iterdir()} - {"groundtruth.txt"} | {"made.json"}
    assert {path.name for path in folder.iterdir()} == others
    assert read_made(folder) == {"checksum": made.checksum, "bag": "track.bag"}
    assert fractions == sorted(fractions)
    assert fractions


def test_an_order_survives_json(dataset):
    order = order_of(dataset)
    content = json.loads(json.dumps(dump(VariantOrder, order)))
    assert adapter(VariantOrder).validate_python(content) == order
    assert item_of(content_of(order)).sha256 != item_of(content_of(order_of(dataset, STEPS[:1]))).sha256
    assert Item.of(item_of(content_of(order))._asdict()) == item_of(content)


def test_a_node_that_would_make_other_bytes_makes_none(dataset, recording, tmp_path, monkeypatch):
    order = order_of(dataset)
    monkeypatch.setattr(planning, "ENGINE_VERSION", 99)
    (folder := tmp_path / "node").mkdir()
    with pytest.raises(Exception, match="OpenCV, NumPy or SLAM Hive have other versions here than on the worker"):
        make(order, recording, folder, lambda _done: None)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("key", "OpenCV, NumPy or SLAM Hive have other versions"),
        ("recording", "cannot be made"),
        ("step", "unknown pre-processing step 'blur'"),
    ],
)
def test_what_cannot_be_made_is_one_line(dataset, recording, tmp_path, damage, message):
    order = order_of(dataset)
    if damage == "key":
        order = replace(order, key="ab" * 16)
    elif damage == "step":
        order = replace(order, steps=({**order.steps[0], "kind": "blur"},))
    else:
        recording.write_bytes(b"nothing")
    cache = Cache(tmp_path / "cache", 10**9)

    def fill(_item: Item, folder: Path) -> None:
        make_apart(MAKER, content_of(order), recording, folder, lambda _done: None)

    with pytest.raises(WrongNode, match=message) as found:
        cache.hold(item_of(content_of(order)), fill)
    assert "\n" not in str(found.value)
    assert "of track cannot be made on its node" in str(found.value)
    assert cache.used_bytes() == 0
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file() and path.suffix != ".lock"]


def test_it_is_made_once_and_takes_what_it_takes(dataset, recording, tmp_path):
    order, cache, made = order_of(dataset), Cache(tmp_path / "cache", 10**9), []

    def fill(item: Item, folder: Path) -> None:
        made.append(item)
        make_apart(MAKER, content_of(order), recording, folder, lambda _done: None)

    for _ in range(2):
        held = cache.hold(item_of(content_of(order)), fill)
        held.release()
    assert len(made) == 1
    assert cache.used_bytes() == folder_bytes(held.path) < item_of(content_of(order)).room_bytes


def test_an_end_of_the_wait_ends_the_process(dataset, recording, tmp_path):
    (folder := tmp_path / "node").mkdir()

    def stop(_done: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_apart(MAKER, content_of(order_of(dataset)), recording, folder, stop)


def test_a_python_without_slam_hive_is_named(dataset, recording, tmp_path):
    cache = Cache(tmp_path / "cache", 10**9)
    source = Item(sha256_of(recording), recording.stat().st_size)

    def fetch(_item: Item, part: Path) -> None:
        part.write_bytes(recording.read_bytes())

    with pytest.raises(WrongNode, match="of track cannot be made on its node"):
        hold_variant(cache, content_of(order_of(dataset)), source, fetch, "/bin/false", lambda _done: None)


def test_what_libraries_print_says_nothing(dataset, tmp_path):
    lines = ["[ WARN] GPU", "3", '{"fraction": 0.5}', '{"problem": "no room"}', ""]
    script = f"print({chr(10).join(lines)!r})"
    fractions: list[float] = []
    with pytest.raises(WrongNode, match=r"cannot be made on its node: no room$"):
        make_apart([sys.executable, "-c", script], content_of(order_of(dataset)), tmp_path, tmp_path, fractions.append)
    assert fractions == [0.5]


def test_the_job_has_time_to_make_it(dataset):
    order = replace(order_of(dataset), room_bytes=6_000_000_000)
    plain, longer = (
        int(next(option for option in job_request(spec, "home", [], "gpu:1", "").options if "--time" in option)[7:])
        for spec in (SPEC, replace(SPEC, variant=order))
    )
    assert longer - plain == 20


def test_the_agent_loads_none_of_its_libraries():
    """They would take memory of the run for as long as it goes on."""
    script = "import sys, slamhive.executors.slurm.agent; print('cv2' in sys.modules, 'rosbags' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["False", "False"]
