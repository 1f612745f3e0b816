"""What holds for every format of folders: it is detected, becomes a valid dataset, and equals itself."""

from pathlib import Path
from typing import Any

import pytest

from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.importers.registry import detect_format
from slamhive.trajectory.layout import read_tum
from tests.recordings.format_world import FORMATS, convert, options_of, recorded
from tests.recordings.range_formats import RANGE_FORMATS

pytestmark = pytest.mark.quick
ALL = {**FORMATS, **RANGE_FORMATS}


def made(name: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    source = ALL[name](folder)
    return source, {"accept_loss": True, **options_of(name, source)}


@pytest.mark.integration
@pytest.mark.parametrize("name", ALL)
def test_a_folder_is_detected_and_becomes_the_same_dataset_twice(tmp_path, name):
    source, options = made(name, tmp_path / "source")
    assert detect_format(source) == name
    dataset = convert(source, tmp_path / "a" / "made", **options)
    assert load_dataset(dataset.folder) == dataset
    assert dataset.title
    assert dataset.groundtruth is not None
    truth = read_tum(dataset.folder / "groundtruth.txt")
    seen = recorded(dataset)
    for sensor in dataset.sensors:
        stamps_s = [message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 for message in seen[sensor.topic]]
        assert stamps_s == sorted(stamps_s)
        assert truth.stamps_s[0] <= stamps_s[-1]
        assert truth.stamps_s[-1] >= stamps_s[0]
    assert convert(source, tmp_path / "b" / "made", **options).checksum == dataset.checksum
