"""Variants of datasets: plan, make, hold, list and remove them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from slamhive.base.bounds import read_record
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError
from slamhive.base.files import write_aside
from slamhive.base.settings import Mode, Settings
from slamhive.documents.catalogue import DatasetCheck
from slamhive.domain.configuration import Variant
from slamhive.domain.dataset import VERSION, Dataset
from slamhive.domain.run import RunState
from slamhive.executors.spec import VariantOrder
from slamhive.experiments.binding import resolve_variant, seen_dataset
from slamhive.filters.words import matching
from slamhive.packages.dataset_file import DATASET_FILE, dataset_to_yaml
from slamhive.recordings.staging import Progress
from slamhive.recordings.variants.cache import CacheLimits, VariantCache, VariantEntry, VariantPlan
from slamhive.recordings.variants.plan import plan_variant
from slamhive.recordings.variants.rules import RegisteredSteps, on_all_sensors
from slamhive.run_folder.folder import RunFolder
from slamhive.store import Store

logger = logging.getLogger(__name__)

IDENTITY = "identity"
"""The key of the unmodified dataset."""

_MOST_ACTIVE = 1000


@dataclass(frozen=True, slots=True)
class UsedVariant:
    """The variant that a run uses.

    Attributes:
        key: Its key, or :data:`IDENTITY`.
        dataset: As the run sees it, ready to be mounted. With an ``order``, as it will be; its files are the source's.
        order: What the node of the run has to make; None if there is nothing to make.
    """

    key: str
    dataset: Dataset
    order: VariantOrder | None = None


class VariantService:
    """The variants of one installation.

    Args:
        settings: The folder and the size of the cache.
        store: Knows which runs are active.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        limits = CacheLimits(settings.variant_cache_bytes, settings.min_free_disk_mb * 1_000_000)
        self._cache = VariantCache(settings.variants_folder, limits, self._used_by_runs)

    def resolve(self, dataset: Dataset, variant: Variant) -> Variant:
        """``variant`` with default options added and steps without effect removed; a step may leave sensors out.

        Raises NotFound or InvalidInput naming the step and what it cannot do.
        """
        named = [on_all_sensors(dataset, step) for step in variant]
        return resolve_variant(RegisteredSteps(), dataset, named)

    def check(self, dataset: Dataset, variant: Variant) -> None:
        """Raise whatever would keep ``variant`` from being made, disk space included; reads no recorded data."""
        plan = plan_variant(dataset, variant)
        if plan is not None:
            self._cache.check_room(plan)

    def plan(self, dataset: Dataset, variant: Variant) -> VariantPlan | None:
        """Key and estimated size of ``variant``; None for the unmodified dataset; raises as :meth:`check`."""
        return plan_variant(dataset, variant)

    def planned(self, dataset: Dataset, variant: Variant) -> Dataset:
        """``dataset`` with its sensors as ``variant`` will leave them; raises as :meth:`check`."""
        return seen_dataset(RegisteredSteps(), dataset, variant)

    def ordered(self, dataset: Dataset, variant: Variant) -> UsedVariant:
        """The variant as an order for the node of the run; raises NotFound or InvalidInput as :meth:`hold`."""
        plan = plan_variant(dataset, variant)
        if plan is None:
            return UsedVariant(IDENTITY, dataset)
        steps = tuple(dict(step) for step in plan.steps)
        order = VariantOrder(plan.key, dataset.name, dataset_to_yaml(dataset), steps, plan.needed_bytes)
        return UsedVariant(plan.key, self.planned(dataset, variant), order)

    @contextlib.contextmanager
    def hold(self, dataset: Dataset, variant: Variant, progress: Progress) -> Iterator[UsedVariant]:
        """Make the variant if necessary, and keep it in the cache until the block ends.

        Raises:
            NotFound: a step or sensor does not exist.
            InvalidInput: the steps cannot be applied, the recording is damaged, or the variant exceeds the cache.
            Unavailable: no disk space now, or a disk error.
        """
        plan = plan_variant(dataset, variant)
        if plan is None:
            yield UsedVariant(IDENTITY, dataset)
            return

        def build(folder: Path, on_progress: Progress) -> Dataset:
            from slamhive.recordings.variants.build import build_variant  # noqa: PLC0415 - loads OpenCV

            return build_variant(dataset, variant, folder, on_progress)

        with self._cache.hold(plan, build, progress) as made:
            yield UsedVariant(plan.key, made)

    @contextlib.contextmanager
    def hold_made(self, key: str) -> Iterator[None]:
        """Keep the variant of an active run in the cache until the block ends."""
        if key == IDENTITY:
            yield
            return
        with self._cache.hold_made(key):
            yield

    def sweep(self) -> None:
        """Remove the leftovers of killed builds."""
        self._cache.sweep()

    def entries(self, dataset: str | None = None) -> tuple[VariantEntry, ...]:
        """The variants in the cache, of one dataset or of all, most recently used first."""
        return tuple(entry for entry in self._cache.entries() if dataset is None or entry.dataset == dataset)

    def find(self, key: str) -> VariantEntry:
        """The variant whose key starts with ``key``; raises NotFound, or InvalidInput if there are several."""
        return self._cache.find(key)

    def drop(self, key: str) -> None:
        """Remove a variant; raises Conflict while a run uses it."""
        self._cache.drop(key)
        self._store.note_act()

    def drop_unused(self, dataset: str) -> tuple[VariantEntry, ...]:
        """Remove all unused variants of a dataset; returns those removed."""
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
        """Read every byte of a variant; returns what is wrong with it, None if nothing is."""
        return self._cache.verify(key)

    def _used_by_runs(self) -> set[str]:
        """The variants of active runs: their containers outlive a killed worker and its locks."""
        active = matching(states=tuple(state for state in RunState if state.active))
        records = self._store.read(lambda t: t.runs.page(active, limit=_MOST_ACTIVE)).records
        keys: set[str | None] = set()
        for record in records:
            if record.variant:
                with contextlib.suppress(SlamHiveError):  # a record that cannot be read names no variant
                    keys.add(variant_key(RunFolder(self._settings.runs_folder / str(record.id)).read_record()))
        return {key for key in keys if key is not None}


def variant_key(record: dict[str, object]) -> str | None:
    """The variant key in a run's record; None if there is none yet."""
    dataset = record.get("dataset")
    key = dataset.get("variant") if isinstance(dataset, dict) else None
    return key if isinstance(key, str) else None


# Reports of checks, the last of which lies beside each dataset.

REPORT_FILE = "check.json"


class DatasetChecks:
    """The checks of the datasets of one installation.

    Args:
        settings: Whether reports may be stored.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def check(self, dataset: Dataset, progress: Progress) -> DatasetCheck:
        """Check ``dataset``, and store the report unless this installation is view-only.

        Raises:
            InvalidInput: it has no recording, or the recording is damaged.
            Unavailable: the report cannot be written.
        """
        # OpenCV and rosbags take half a second to import, which other commands should not pay.
        from slamhive.recordings.checks.registry import check_dataset  # noqa: PLC0415

        files = dataset_files(dataset)
        report = DatasetCheck.of(check_dataset(dataset, progress), files=files)
        if self._settings.mode is not Mode.VIEW_ONLY:
            write_aside(_path(dataset), json.dumps(report.content, indent=1) + "\n")
        return report

    def stored(self, dataset: Dataset) -> DatasetCheck | None:
        """The last report; None if there is none, or if the data or the checks have changed since."""
        try:
            report = DatasetCheck.read(read_record(_path(dataset)))
        except (NotFound, InvalidInput):
            return None
        current = (dataset.checksum, dataset_files(dataset), VERSION)
        return report if (report.checksum, report.files, report.version) == current else None


def _path(dataset: Dataset) -> Path:
    return dataset.folder / REPORT_FILE


def dataset_files(dataset: Dataset) -> str:
    """Digest of ``dataset.yaml`` and the ground truth, which the checksum of the recording does not cover."""
    digest = hashlib.sha256()
    try:
        digest.update((dataset.folder / DATASET_FILE).read_bytes())
        if dataset.groundtruth_path is not None:
            status = dataset.groundtruth_path.stat()
            digest.update(f"{status.st_size} {status.st_mtime_ns}".encode())
    except OSError:
        digest.update(b"absent")
    return f"sha256:{digest.hexdigest()}"
