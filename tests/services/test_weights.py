"""Weights of a package: added, checked, refused, and found by a run."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.base.settings import Settings
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.domain.packages import Weights
from slamhive.services.weights import WeightsStore
from tests.downloads.file_server import serving

CONTENT = b"numbers"
KNOWN = Weights("known.pth", "MIT", "https://example.org/page", sha256=hashlib.sha256(CONTENT).hexdigest())
OPEN = Weights("open.pth", "CC-BY-NC-4.0", "https://example.org/page")


@pytest.fixture
def store(tmp_path):
    return WeightsStore(Settings(data=tmp_path / "data"))


def package(tmp_path, *weights):
    return AlgorithmPackage("deep", tmp_path, "Deep", "1", "https://x", "MIT", "c", weights=weights)


def test_a_file_with_the_published_checksum_is_taken(store, tmp_path):
    deep = package(tmp_path, KNOWN)
    (tmp_path / "known.pth").write_bytes(CONTENT)
    with pytest.raises(InvalidInput, match=r"needs the weights known\.pth, which are not here"):
        store.check_present(deep)
    store.add(deep, tmp_path / "known.pth")
    (entry,) = store.checked(deep)
    assert entry.path.read_bytes() == CONTENT


def test_a_file_with_another_checksum_is_refused_in_one_line_and_not_kept(store, tmp_path):
    deep = package(tmp_path, KNOWN)
    (tmp_path / "download").write_bytes(b"other")
    with pytest.raises(InvalidInput) as refused:
        store.add(deep, tmp_path / "download", "known.pth")
    found = hashlib.sha256(b"other").hexdigest()
    assert str(refused.value) == (
        f"{tmp_path}/download is not what the weights known.pth were: SHA-256 {found}, expected {KNOWN.sha256}; "
        "use the file that https://example.org/page publishes"
    )
    assert "\n" not in str(refused.value)
    assert not any((tmp_path / "data").rglob("*.pth"))


def test_without_a_published_checksum_the_first_file_counts(store, tmp_path):
    deep = package(tmp_path, OPEN)
    (tmp_path / "open.pth").write_bytes(CONTENT)
    entry = store.add(deep, tmp_path / "open.pth")
    assert store.checked(deep) == (entry,)
    entry.path.write_bytes(b"changed")
    with pytest.raises(InvalidInput, match=r"weights/deep/open\.pth is not what .* were: SHA-256 \w+, expected"):
        store.checked(deep)
    (tmp_path / "open.pth").write_bytes(b"newer")
    with pytest.raises(InvalidInput, match="expected"):
        store.add(deep, tmp_path / "open.pth")


def test_a_file_of_another_name_needs_to_be_named(store, tmp_path):
    (tmp_path / "download").write_bytes(CONTENT)
    with pytest.raises(NotFound, match=r"has no weights 'download'; known: open\.pth; name the file with --as"):
        store.add(package(tmp_path, OPEN), tmp_path / "download")


def test_weights_without_an_address_are_taken_by_hand(store, tmp_path):
    with pytest.raises(InvalidInput, match=r"take it from https://example\.org/page"):
        store.fetch(package(tmp_path, OPEN), lambda _done, _size: None)


def test_missing_weights_are_downloaded_once(store, tmp_path):
    told = []
    with serving() as server:
        deep = package(
            tmp_path, *(replace(entry, address=server.add(f"/{entry.name}", CONTENT)) for entry in (KNOWN, OPEN))
        )
        for _ in range(2):
            found = store.fetch(deep, lambda done, size: told.append((done, size)))
        counts = [
            len([1 for request in server.asked(f"/{entry.name}") if not request.is_probe]) for entry in (KNOWN, OPEN)
        ]
    assert found == store.checked(deep)
    assert [entry.path.read_bytes() for entry in found] == [CONTENT, CONTENT]
    assert {entry.sha256 for entry in found} == {KNOWN.sha256}
    assert counts == [1, 1]
    assert told[-1] == (len(CONTENT), len(CONTENT))


def test_a_download_with_another_checksum_is_refused_and_not_kept(store, tmp_path):
    with serving() as server:
        deep = package(tmp_path, replace(KNOWN, address=server.add("/known.pth", b"forged!")))
        with pytest.raises(InvalidInput, match="sha256") as refused:
            store.fetch(deep, lambda _done, _size: None)
    assert "\n" not in str(refused.value)
    assert not store.stored(deep)[0].present
    assert not any(path.is_file() and path.read_bytes() == b"forged!" for path in (tmp_path / "data").rglob("*"))
