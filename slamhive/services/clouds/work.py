"""How much work a cloud file is for: what the preview of its experiment estimates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slamhive.cloud.cloud_file import CloudFile
from slamhive.cloud.plan import Work
from slamhive.files import size_bytes
from slamhive.services.datasets import Catalogue
from slamhive.services.experiments import Experiments, ExperimentSource
from slamhive.sweep.experiment_file import parse_experiment


def work_of(order: CloudFile, path: Path, experiments: Callable[[], Experiments], catalogue: Catalogue) -> Work:
    """The work that the cloud file at ``path`` names; raises as the preview of an experiment."""
    if order.experiment is None:
        return Work(order.hours or 0.0)
    service = experiments()
    source = service.with_datasets(ExperimentSource.read(path.parent / order.experiment))
    found = service.preview(source)
    datasets = tuple(map(str, parse_experiment(source.text, source.name).datasets.values))
    copied = order.prepare is not None and order.prepare.datasets
    return Work(
        hours=(found.time_s - found.build_time_s) * found.slots / 3600,  # packages are built before
        runs=found.runs,
        data_bytes=sum(size_bytes(catalogue.dataset_folder(name)) for name in datasets) if copied else 0,
        datasets=datasets if copied else (),
    )
