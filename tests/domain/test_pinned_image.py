"""Images that packages name by the digest of their content."""

from __future__ import annotations

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.domain.packages import PinnedImage
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.image_context import dockerfile_of
from tests.services.tiny_project import ALGORITHM

DIGEST = "sha256:" + "0a" * 32


@pytest.mark.parametrize(
    ("text", "repository", "tag"),
    [
        (f"lab/dpvo@{DIGEST}", "lab/dpvo", None),
        (f"dpvo:1.0@{DIGEST}", "dpvo", "1.0"),
        (f"registry.example.org:5000/lab/dpvo@{DIGEST}", "registry.example.org:5000/lab/dpvo", None),
        (f"127.0.0.1:5000/dpvo:x@{DIGEST}", "127.0.0.1:5000/dpvo", "x"),
    ],
)
def test_the_parts_of_a_name_with_a_digest(text, repository, tag):
    pinned = PinnedImage.parse(text)
    assert pinned == PinnedImage(repository, DIGEST, tag)
    assert pinned.reference == f"{repository}@{DIGEST}"
    assert pinned.name == f"{repository}:{tag or 'latest'}"


@pytest.mark.parametrize(
    "text", ["dpvo", "dpvo:1", f"@{DIGEST}", DIGEST, f"dpvo@{DIGEST}0", f"--all@{DIGEST}", f"a b@{DIGEST}", "x" * 9999]
)
def test_a_name_without_a_digest_pins_nothing(text):
    with pytest.raises(InvalidInput, match="names no image by its digest") as refused:
        PinnedImage.parse(text)
    assert len(str(refused.value)) < 200


def write(folder, image):
    (folder / "slamhive").mkdir()
    (folder / "slamhive" / "mapping.py").touch()
    (folder / "algorithm.yaml").write_text(ALGORITHM + f"image: {image}\n")


def test_a_package_with_a_pinned_image_builds_nothing_even_if_it_keeps_its_dockerfile(tmp_path):
    write(tmp_path, f"lab/tiny:1@{DIGEST}")
    (tmp_path / "Dockerfile").write_text("FROM scratch\n")
    package = load_algorithms(tmp_path)[0].package
    assert package.image == f"lab/tiny@{DIGEST}"
    assert dockerfile_of(package, tmp_path) is None


def test_a_package_without_one_is_built(tmp_path):
    write(tmp_path, "own")
    package = load_algorithms(tmp_path)[0].package
    assert isinstance(package, AlgorithmPackage)
    assert (package.pinned_image, package.image) == (None, "slam-hive-algorithm:tiny")


def test_a_tag_alone_is_refused_in_one_line(tmp_path):
    write(tmp_path, "lab/tiny:1")
    with pytest.raises(InvalidInput) as refused:
        load_algorithms(tmp_path)
    assert str(refused.value) == (
        f"{tmp_path}/algorithm.yaml: image: 'lab/tiny:1' names no image by its digest; write NAME@sha256: and "
        "the 64 hex digits of its digest, or own, or standard"
    )
