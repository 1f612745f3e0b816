"""Checks datasets, and keeps the last report beside each dataset."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from slamhive.bags.staging import Progress
from slamhive.catalogue.dataset_file import DATASET_FILE
from slamhive.domain.checks import VERSION
from slamhive.domain.dataset import Dataset
from slamhive.errors import InvalidInput, NotFound
from slamhive.files import write_aside
from slamhive.input_bounds import read_record
from slamhive.schema.checks import DatasetCheck
from slamhive.settings import Mode, Settings

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
        from slamhive.checks.run import check_dataset  # noqa: PLC0415

        files = _files(dataset)
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
        current = (dataset.checksum, _files(dataset), VERSION)
        return report if (report.checksum, report.files, report.version) == current else None


def _path(dataset: Dataset) -> Path:
    return dataset.folder / REPORT_FILE


def _files(dataset: Dataset) -> str:
    """Changes with ``dataset.yaml`` and the ground truth, which the checksum of the recording does not cover."""
    digest = hashlib.sha256()
    try:
        digest.update((dataset.folder / DATASET_FILE).read_bytes())
        if dataset.groundtruth_path is not None:
            status = dataset.groundtruth_path.stat()
            digest.update(f"{status.st_size} {status.st_mtime_ns}".encode())
    except OSError:
        digest.update(b"absent")
    return f"sha256:{digest.hexdigest()}"
