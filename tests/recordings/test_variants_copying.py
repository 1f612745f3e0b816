"""What is not touched is copied by the kernel: whichever way it offers, and never less than was asked for."""

import errno
import hashlib
import os

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.configuration import VariantStep
from slamhive.recordings.variants.ros1_index import Ros1File
from slamhive.recordings.variants.ros1_output import Ros1Output
from slamhive.recordings.variants.ros1_rewrite import make_ros1
from slamhive.recordings.variants.streams import treat
from tests.recordings.variant_bags import dataset, stereo, write_bag

pytestmark = pytest.mark.quick


def half_rate(source, target):
    treatments = treat(source, (VariantStep("rate", ("cam0",), {"every": 2}),))
    return make_ros1(
        source.bag_path, target, lambda _present: {"/cam0/image_raw": treatments[0]}, lambda _fraction, _text: None
    )


@pytest.fixture
def source(tmp_path):
    write_bag(tmp_path / "d.bag", stereo())
    return dataset(tmp_path)


@pytest.fixture(params=[1, 1 << 30], ids=["all by the kernel", "all by hand"])
def copied_from(request, monkeypatch):
    """From which size on the kernel copies."""
    monkeypatch.setattr("slamhive.recordings.variants.ros1_output._COPY_BYTES", request.param)


@pytest.mark.usefixtures("copied_from")
def test_the_result_and_its_checksum_do_not_depend_on_how_bytes_travel(source, tmp_path):
    digest, _, _ = half_rate(source, tmp_path / "made.bag")
    assert digest == f"sha256:{hashlib.sha256((tmp_path / 'made.bag').read_bytes()).hexdigest()}"
    half_rate(source, tmp_path / "again.bag")
    assert (tmp_path / "again.bag").read_bytes() == (tmp_path / "made.bag").read_bytes()


def test_a_file_system_that_cannot_copy_ranges_gets_them_otherwise(source, tmp_path, monkeypatch):
    monkeypatch.setattr("slamhive.recordings.variants.ros1_output._COPY_BYTES", 1)
    expected, _, _ = half_rate(source, tmp_path / "made.bag")
    asked = []

    def refuse(*arguments):
        asked.append(arguments)
        raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))

    monkeypatch.setattr(os, "copy_file_range", refuse)
    assert half_rate(source, tmp_path / "otherwise.bag")[0] == expected
    assert len(asked) == 1, "asked once, then known"


def test_a_disk_that_refuses_is_no_file_system_that_cannot(source, tmp_path, monkeypatch):
    monkeypatch.setattr("slamhive.recordings.variants.ros1_output._COPY_BYTES", 1)

    def full(*_arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "copy_file_range", full)
    with pytest.raises(OSError, match="No space left"):
        half_rate(source, tmp_path / "made.bag")


def test_an_extent_that_ends_behind_the_file_is_damage(tmp_path):
    (tmp_path / "short.bag").write_bytes(b"x" * 100)
    with Ros1File(tmp_path / "short.bag") as file, (tmp_path / "target").open("wb") as target:
        with pytest.raises(InvalidInput, match=r"short\.bag cannot be read"):
            file.copy_to(target.fileno(), range(10, 150))
        with pytest.raises(InvalidInput, match=r"short\.bag cannot be read"):
            file.read(10, 140)


def test_writes_that_the_kernel_takes_in_parts_are_completed(source, tmp_path, monkeypatch):
    expected, _, _ = half_rate(source, tmp_path / "made.bag")
    write = os.write

    def first_bytes(descriptor, parts):
        return write(descriptor, b"".join(parts)[:7])

    monkeypatch.setattr(os, "writev", first_bytes)
    monkeypatch.setattr("slamhive.recordings.variants.ros1_output._COPY_BYTES", 1 << 30)
    assert half_rate(source, tmp_path / "parts.bag")[0] == expected
    assert (tmp_path / "parts.bag").read_bytes() == (tmp_path / "made.bag").read_bytes()


def test_an_output_never_replaces_a_file(tmp_path):
    (tmp_path / "there.bag").write_bytes(b"precious")
    with pytest.raises(FileExistsError):
        Ros1Output(tmp_path / "there.bag", [], 0, 0)
    assert (tmp_path / "there.bag").read_bytes() == b"precious"
