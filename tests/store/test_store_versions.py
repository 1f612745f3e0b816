"""Versions of packages: numbered in the order of their use, found by name and number, never renumbered."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from slamhive.filters.binding import read_search
from slamhive.filters.fields import Vocabulary
from slamhive.filters.syntax import FilterError
from slamhive.store import AlgorithmVersion, RunFields, Store, Transaction
from tests.store.store_samples import Samples

NOW = datetime(2026, 5, 4, tzinfo=UTC)


def version(digit: str, number: int | None = None) -> AlgorithmVersion:
    return AlgorithmVersion(f"sha256:{digit * 64}", "sha256:" + "f" * 64, "1.0", number)


def ran(store: Store, run_id: int, package: str, used: AlgorithmVersion) -> int:
    """Note which version a run used; its number."""

    def work(tx: Transaction) -> int:
        row, number = tx.versions.put(package, used, NOW)
        tx.runs.update(run_id, **RunFields(algorithm_version_id=row))
        return number

    return store.write(work)


def test_numbers_count_within_a_package_and_are_never_used_twice(store: Store) -> None:
    def put(package: str, used: AlgorithmVersion) -> int:
        return store.write(lambda tx: tx.versions.put(package, used, NOW))[1]

    assert [put("aloam", version(digit)) for digit in "aba"] == [1, 2, 1]
    assert put("loam", version("a")) == 1
    store.write(lambda tx: tx.versions.mark_removed("aloam", 2, NOW))
    assert put("aloam", version("c")) == 3
    assert store.read(lambda tx: tx.versions.of("aloam"))[1].removed_at == NOW
    assert put("aloam", version("b")) == 2
    assert store.read(lambda tx: tx.versions.of("aloam"))[1].removed_at is None


def test_a_version_keeps_its_number_unless_that_is_taken(store: Store) -> None:
    put = [version("a", 3), version("b", 3), version("c", 1), replace(version("a"), number=9)]
    numbers = store.write(lambda tx: [tx.versions.put("aloam", used, NOW)[1] for used in put])
    assert numbers == [3, 4, 1, 3]


@pytest.mark.quick
def test_a_filter_names_a_version(store: Store, samples: Samples) -> None:
    first, second, third, waiting = samples.queued(4)
    ran(store, first, "orb-slam3", version("a"))
    ran(store, second, "orb-slam3", version("b"))
    ran(store, third, "orb-slam3", version("b"))
    name = store.read(lambda tx: tx.runs.get(first)).algorithm

    def found(text: str) -> list[int]:
        search = read_search(text, Vocabulary())
        return sorted(run.id for run in store.read(lambda tx: tx.runs.page(search)).records)

    assert found(f"algorithm = {name}@2") == [second, third]
    assert found("package = orb-slam3@1") == [first]
    assert found(f"algorithm in ({name}@1, kiss-icp@2)") == [first]
    assert found(f"algorithm != {name}@2") == [first]
    assert found(f"not algorithm = {name}@2") == [first, waiting]
    assert found("version = 2") == [second, third]
    assert found("version between 1 and 2") == [first, second, third]
    assert found("missing version") == [waiting]
    for text, told in ((f"algorithm = {name}@x", "names no version"), ("algorithm ~ a@1", "does not compare versions")):
        with pytest.raises(FilterError, match=told):
            found(text)
