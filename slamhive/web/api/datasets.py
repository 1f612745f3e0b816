"""Datasets, their checks and their variants."""

from __future__ import annotations

from flask import Response, request

from slamhive.errors import NotFound
from slamhive.schema.api_answers import BackgroundWork, Datasets, DatasetWork, PublicDatasets, Removal, Variants
from slamhive.schema.api_requests import VariantRequest
from slamhive.schema.catalogue import Dataset
from slamhive.schema.checks import DatasetCheck
from slamhive.schema.looks import Sweep
from slamhive.schema.variant import CachedVariant
from slamhive.services.datasets import dataset_document
from slamhive.web.api.arguments import PUBLIC_ARGUMENTS, TIME_ARGUMENTS
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.background import Work
from slamhive.web.context import dataset_checker, hive, variant_maker
from slamhive.web.dataset_work import begin_check, begin_variant, drop_variant
from slamhive.web.views.datasets import asked_time_s, frame_answer


@TABLE.get(Section.DATASETS, "/datasets", Datasets)
def datasets() -> Datasets:
    """All datasets."""
    return Datasets(datasets=tuple(map(dataset_document, hive().catalogue.datasets())))


@TABLE.get(Section.DATASETS, "/datasets/{name}", Dataset)
def dataset(name: str) -> Dataset:
    """One dataset."""
    return dataset_document(hive().catalogue.dataset(name))


@TABLE.get(Section.DATASETS, "/datasets/{name}/frames/{sensor}", ("image/jpeg",), TIME_ARGUMENTS)
def dataset_frame(name: str, sensor: str) -> Response:
    """The frame of a camera at a time of the recording, or the next one; `X-Frame-Time` says when it was received."""
    return frame_answer(hive().catalogue.dataset(name), sensor)


@TABLE.get(Section.DATASETS, "/datasets/{name}/sweeps/{sensor}", Sweep, TIME_ARGUMENTS)
def dataset_sweep(name: str, sensor: str) -> Sweep:
    """The sweep of a LiDAR at a time of the recording, or the next one."""
    services = hive()
    dataset = services.catalogue.dataset(name)
    view = services.dataset_views.sweep(dataset, sensor, asked_time_s(dataset))
    return Sweep.of(view, positions_m=view.positions_m.round(4).tolist())


@TABLE.get(Section.DATASETS, "/datasets/{name}/check", DatasetCheck)
def dataset_check(name: str) -> DatasetCheck:
    """The last report of the checks of one dataset."""
    report = hive().dataset_checks.stored(hive().catalogue.dataset(name))
    if report is None:
        raise NotFound(f"dataset {name} has not been checked, or has changed since", f"slamhive dataset check {name}")
    return report


@TABLE.post(Section.DATASETS, "/datasets/{name}/check", DatasetWork, status=202)
def check_dataset(name: str) -> DatasetWork:
    """Start checking one dataset."""
    begin_check(hive(), name)
    return _work(name)


@TABLE.get(Section.DATASETS, "/datasets/{name}/work", DatasetWork)
def dataset_work(name: str) -> DatasetWork:
    """The check or the variant of one dataset that is being made now, or that failed."""
    hive().catalogue.dataset(name)
    return _work(name)


@TABLE.get(Section.DATASETS, "/datasets/{name}/variants", Variants)
def variants(name: str) -> Variants:
    """The variants of one dataset in the cache."""
    services = hive()
    services.catalogue.dataset(name)
    return Variants(variants=tuple(map(CachedVariant.of, services.variants.entries(name))))


@TABLE.post(Section.DATASETS, "/datasets/{name}/variants", DatasetWork, body=VariantRequest, status=202)
def make_variant(name: str, body: VariantRequest) -> DatasetWork:
    """Start making a variant of one dataset."""
    begin_variant(hive(), name, body.steps)
    return _work(name)


@TABLE.post(Section.DATASETS, "/datasets/{name}/variants/{key}/drop", Removal)
def remove_variant(name: str, key: str) -> Removal:
    """Remove a variant that nothing uses; runs that need it make it again."""
    return Removal(removed=drop_variant(hive(), name, key))


@TABLE.get(Section.DATASETS, "/public-datasets", PublicDatasets, PUBLIC_ARGUMENTS)
def public_datasets() -> PublicDatasets:
    """Public sequences that `slamhive dataset fetch` makes datasets of."""
    words = request.args.get("words", "").split()
    return PublicDatasets(sequences=tuple(hive().fetching.search(words)))


def _work(name: str) -> DatasetWork:
    return DatasetWork(check=_shown(dataset_checker().latest(name)), variant=_shown(variant_maker().latest(name)))


def _shown(work: Work | None) -> BackgroundWork | None:
    return None if work is None else BackgroundWork.of(work)
