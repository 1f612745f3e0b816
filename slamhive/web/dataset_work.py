"""Creates variants and checks datasets when a page asks for it."""

from __future__ import annotations

import threading

from slamhive.domain.dataset import Dataset
from slamhive.domain.variant import Variant
from slamhive.errors import InvalidInput, NotFound
from slamhive.services.hive import Hive
from slamhive.services.runs import check_dataset_files
from slamhive.web.background import Background, Progress, Work
from slamhive.web.context import dataset_checker, variant_maker


class VariantMaker(Background):
    """Creates one variant at a time. Runs that need the same variant wait for it."""

    def __init__(self, hive: Hive) -> None:
        super().__init__(hive, "variant", "a variant of {} is being created")

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
        super().__init__(hive, "check", "dataset {} is being checked")

    def start(self, dataset: Dataset) -> threading.Thread:
        """Start checking ``dataset``; raises InvalidInput without a recording, Conflict while another check runs."""
        dataset.check_recorded()
        began = self.begin(Work(dataset.name), lambda progress: self._hive.dataset_checks.check(dataset, progress))
        self._hive.store.note_act()
        return began


def begin_check(hive: Hive, name: str) -> None:
    """Start checking the dataset called ``name``, for a page or a program."""
    hive.check_writable()
    dataset = hive.catalogue.dataset(name)
    check_dataset_files(dataset)
    dataset_checker().start(dataset)


def begin_variant(hive: Hive, name: str, steps: Variant) -> None:
    """Start making a variant of the dataset called ``name``, after all checks that are possible in advance."""
    hive.check_writable()
    dataset = hive.catalogue.dataset(name)
    variant = hive.variants.resolve(dataset, steps)
    if not variant:
        raise InvalidInput(f"these steps change nothing in {name}", "add a step that changes the data")
    check_dataset_files(dataset)
    hive.variants.check(dataset, variant)
    variant_maker().start(dataset, variant)


def drop_variant(hive: Hive, name: str, key: str) -> str:
    """Remove the variant of the dataset called ``name`` whose key begins with ``key``; its whole key."""
    hive.check_writable()
    entry = hive.variants.find(key)
    if entry.dataset != name:
        raise NotFound(f"{name} has no variant {key[:40]!r}")
    hive.variants.drop(entry.key)
    return entry.key
