"""Variants of datasets: planned, made, used by runs, listed and removed."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from slamhive.bags.staging import Progress
from slamhive.bags.variants.build import build_variant
from slamhive.bags.variants.cache import CacheLimits, VariantCache, VariantEntry
from slamhive.bags.variants.manifest import VariantPlan
from slamhive.bags.variants.plan import plan_variant
from slamhive.bags.variants.rules import RegisteredSteps, on_all_sensors
from slamhive.domain.dataset import Dataset
from slamhive.domain.run import RunState
from slamhive.domain.variant import Variant
from slamhive.errors import Conflict, SlamHiveError
from slamhive.runs.folder import RunFolder
from slamhive.search.build import matching
from slamhive.settings import Settings
from slamhive.store import Store
from slamhive.sweep.variants import resolve_variant

logger = logging.getLogger(__name__)

IDENTITY = "identity"
"""The key of the variant that is the dataset itself."""

_MOST_ACTIVE = 1000


@dataclass(frozen=True, slots=True)
class UsedVariant:
    """What a run gets to see: ``dataset`` lies where it can be mounted, ``key`` is :data:`IDENTITY` or the cache's."""

    key: str
    dataset: Dataset


class Variants:
    """The variants of one installation.

    Args:
        settings: Where they lie and how much room they may take.
        store: Knows which runs are active.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        limits = CacheLimits(settings.variant_cache_bytes, settings.min_free_disk_mb * 1_000_000)
        self._cache = VariantCache(settings.variants_folder, limits, self._used_by_runs)

    def resolve(self, dataset: Dataset, variant: Variant) -> Variant:
        """``variant`` with every option spelt out and without what changes nothing; a step may name no sensors.

        Raises NotFound or InvalidInput naming the step and what it cannot do.
        """
        named = [on_all_sensors(dataset, step) for step in variant]
        return resolve_variant(RegisteredSteps(), dataset, named)

    def check(self, dataset: Dataset, variant: Variant) -> None:
        """Raise what would keep ``variant`` from being made, room included, as far as no data must be read for it."""
        plan = plan_variant(dataset, variant)
        if plan is not None:
            self._cache.check_room(plan)

    def plan(self, dataset: Dataset, variant: Variant) -> VariantPlan | None:
        """Key and estimated size of ``variant``, None if it is the dataset itself; raises as :meth:`check`."""
        return plan_variant(dataset, variant)

    @contextmanager
    def hold(self, dataset: Dataset, variant: Variant, progress: Progress) -> Iterator[UsedVariant]:
        """The variant, made if need be; it stays at least until the block ends.

        Raises:
            NotFound: a step or sensor that does not exist (any more).
            InvalidInput: steps that cannot be applied, a damaged recording, a variant that can never fit.
            Unavailable: no room now, or the disk refuses.
        """
        plan = plan_variant(dataset, variant)
        if plan is None:
            yield UsedVariant(IDENTITY, dataset)
            return

        def build(folder: Path, on_progress: Progress) -> Dataset:
            return build_variant(dataset, variant, folder, on_progress)

        with self._cache.hold(plan, build, progress) as made:
            yield UsedVariant(plan.key, made)

    @contextmanager
    def hold_made(self, key: str) -> Iterator[None]:
        """Keep the variant of a run that goes on."""
        if key == IDENTITY:
            yield
            return
        with self._cache.hold_made(key):
            yield

    def sweep(self) -> None:
        """Remove what killed builds have left behind."""
        self._cache.sweep()

    def entries(self, dataset: str | None = None) -> tuple[VariantEntry, ...]:
        """What lies in the cache, of one dataset or of all, the most recently used first."""
        return tuple(entry for entry in self._cache.entries() if dataset is None or entry.dataset == dataset)

    def find(self, key: str) -> VariantEntry:
        """The variant whose key begins with ``key``; raises NotFound, or InvalidInput if several do."""
        return self._cache.find(key)

    def drop(self, key: str) -> None:
        """Remove a variant; raises Conflict while a run uses it."""
        self._cache.drop(key)

    def drop_unused(self, dataset: str) -> tuple[VariantEntry, ...]:
        """Remove all variants of a dataset that no run uses; those removed."""
        dropped: list[VariantEntry] = []
        for entry in self.entries(dataset):
            try:
                self._cache.drop(entry.key)
            except Conflict:
                logger.info("variant %s of %s is in use and stays", entry.key, dataset)
            else:
                dropped.append(entry)
        return tuple(dropped)

    def verify(self, key: str) -> str | None:
        """Read every byte of a variant; what is wrong with it, None if nothing is."""
        return self._cache.verify(key)

    def _used_by_runs(self) -> set[str]:
        """Variants of active runs: their containers go on when a worker is killed, and its locks with it."""
        active = matching(states=tuple(state for state in RunState if state.active))
        records = self._store.read(lambda t: t.runs.page(active, limit=_MOST_ACTIVE)).records
        keys = {self._key_of(record.id) for record in records if record.variant}
        return {key for key in keys if key is not None}

    def _key_of(self, run_id: int) -> str | None:
        try:
            return variant_key(RunFolder(self._settings.runs_folder / str(run_id)).read_record())
        except SlamHiveError:
            return None


def variant_key(record: dict[str, object]) -> str | None:
    """The key that a run's record names, None while it names none."""
    dataset = record.get("dataset")
    key = dataset.get("variant") if isinstance(dataset, dict) else None
    return key if isinstance(key, str) else None
