"""Creates variants and checks datasets when a page asks for it."""

from __future__ import annotations

import threading

from slamhive.domain.dataset import Dataset
from slamhive.domain.variant import Variant
from slamhive.services.hive import Hive
from slamhive.web.background import Background, Progress, Work


class VariantMaker(Background):
    """Creates one variant at a time. Runs that need the same variant wait for it."""

    def __init__(self, hive: Hive) -> None:
        super().__init__("variant", "a variant of {} is being created")
        self._hive = hive

    def start(self, dataset: Dataset, variant: Variant) -> threading.Thread:
        """Start creating ``variant``, which is already checked; raises Conflict while another one is being created."""

        def make(progress: Progress) -> None:
            with self._hive.variants.hold(dataset, variant, progress):
                pass

        began = self.begin(Work(dataset.name, tuple(str(step) for step in variant)), make)
        self._hive.store.note_act()
        return began


class DatasetChecker(Background):
    """Checks one dataset at a time."""

    def __init__(self, hive: Hive) -> None:
        super().__init__("check", "dataset {} is being checked")
        self._hive = hive

    def start(self, dataset: Dataset) -> threading.Thread:
        """Start checking ``dataset``; raises InvalidInput without a recording, Conflict while another check runs."""
        dataset.check_recorded()
        began = self.begin(Work(dataset.name), lambda progress: self._hive.dataset_checks.check(dataset, progress))
        self._hive.store.note_act()
        return began
