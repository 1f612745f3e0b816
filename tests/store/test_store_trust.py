"""Filters by trust find the runs that the rule names."""

from __future__ import annotations

import itertools
import random
from typing import Any

import pytest

from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode
from slamhive.domain.run import RunState
from slamhive.domain.trust import CPU_LIMIT_USED, DROPPED_FRAMES, PLAYER_LAG, Disturbance, TrustLevel
from slamhive.filters.binding import read_search
from slamhive.filters.fields import Vocabulary
from slamhive.filters.words import in_words
from slamhive.store import RunSort, Store
from tests.store.conftest import NOW
from tests.store.store_samples import Samples, dataset
from tests.store.test_store_disturbance import BUSY, QUIET, UNKNOWN

pytestmark = pytest.mark.integration

CASES = random.Random(5).sample(
    list(
        itertools.product(
            (None, 0.0, 0.1, 0.8),
            (None, 0.1, 1.0, 3.0),
            (None, 0.5, 0.95),
            (None, QUIET, QUIET, BUSY, UNKNOWN),
        )
    ),
    25,
)


def sequential(samples: Samples) -> int:
    """A configuration that is played sequentially."""
    content = Configuration("a", "room", {}, Playback(PlaybackMode.SEQUENTIAL, 1.0))

    def work(tx: Any) -> int:
        algorithm_id = tx.catalogue.put_algorithm_named("a", "a", "stereo")
        dataset_id = tx.catalogue.put_dataset(dataset(), NOW)
        found: tuple[int, bool] = tx.configurations.get_or_create(content, algorithm_id, dataset_id, NOW)
        return found[0]

    return samples.store.write(work)


def measure(store: Store, run_id: int, metrics: dict[str, float], disturbance: Disturbance | None) -> None:
    """Store what was measured of a run."""

    def work(tx: Any) -> None:
        tx.metrics.put(run_id, None, metrics)
        tx.runs.update(run_id, disturbance=disturbance)

    store.write(work)


@pytest.fixture
def measured(store: Store, samples: Samples) -> list[int]:
    """Runs with some of all combinations of what was measured, and some that have no trust at all."""
    configurations = (samples.configuration(), sequential(samples))
    runs = []
    for place, (dropped, lag_s, used, disturbance) in enumerate(CASES):
        state = RunState.FAILED if place % 5 == 0 else RunState.SUCCEEDED
        run_id = samples.run_in(state, configuration_id=configurations[place % 3 == 0])
        values = {DROPPED_FRAMES: dropped, PLAYER_LAG: lag_s, CPU_LIMIT_USED: used}
        known = {key: value for key, value in values.items() if value is not None}
        measure(store, run_id, known, disturbance)
        runs.append(run_id)
    runs.append(samples.run_in(RunState.CANCELLED))
    runs.append(samples.run_in(RunState.SUCCEEDED, executor=IMPORTED))
    return [*runs, *samples.queued()]


LEVELS: dict[str, set[TrustLevel | None]] = {
    "trust = high": {TrustLevel.HIGH},
    "trust = limited": {TrustLevel.LIMITED},
    "trust = low": {TrustLevel.LOW},
    "trust = doubtful": {TrustLevel.LIMITED, TrustLevel.LOW},
    "trust != low": {TrustLevel.HIGH, TrustLevel.LIMITED},
    "trust in (high, low)": {TrustLevel.HIGH, TrustLevel.LOW},
    "has trust": set(TrustLevel),
    "missing trust": {None},
    "not trust = high and id > 0": {None, TrustLevel.LIMITED, TrustLevel.LOW},
    "trust = low or trust = high": {TrustLevel.HIGH, TrustLevel.LOW},
}


def test_filters_and_the_rule_agree(store: Store, measured: list[int]) -> None:
    records = store.read(lambda tx: tx.runs.get_many(measured, with_metrics=True))
    levels = {record.id: None if record.trust is None else record.trust.level for record in records}
    assert set(levels.values()) == {None, *TrustLevel}
    for where, wanted in LEVELS.items():
        search = read_search(where, Vocabulary())
        page = store.read(lambda tx, search=search: tx.runs.page(search, RunSort(), limit=100))  # type: ignore[misc]
        found = {record.id for record in page.records}
        assert found == {run_id for run_id, level in levels.items() if level in wanted}, where
        exact = store.read(lambda tx, search=search: tx.searches.exact_count(search))  # type: ignore[misc]
        assert exact == page.count.number == len(found), where
        ids = store.read(lambda tx, search=search: tx.searches.run_ids(search))  # type: ignore[misc]
        assert ids == sorted(found), where


def test_a_filter_says_in_words_what_it_looks_for() -> None:
    assert in_words(read_search("trust = doubtful", Vocabulary())) == "trust one of limited, low"
