"""A dataset exporter: the samples of each IMU as a CSV file.

`slamhive dataset export NAME --format imu-csv --partial` writes one. Copy this file and change what it writes.
"""

from functools import partial
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import SensorKind
from slamhive.recordings.exporters.base import ExportPlan, ImuSink, export_frames, left_out, message_counts
from slamhive.recordings.staging import Progress

LINE_BYTES = 160


class ImuCsvExporter:
    """`NAME.csv` of each IMU: timestamp in ns, angular rate in rad/s, acceleration in m/s²."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """List what will be written, and what cannot be held, so that nobody loses it unnoticed."""
        imus = dataset.of_kind(SensorKind.IMU)
        if not imus:
            raise InvalidInput(f"dataset {dataset.name} has no IMU", "export to mcap")
        counts = message_counts(dataset)
        needed_bytes = LINE_BYTES * sum(counts[imu.name] for imu in imus)
        return ExportPlan(partial(self.write, dataset), needed_bytes, left_out(dataset, imus))

    def write(self, dataset: Dataset, folder: Path, progress: Progress) -> None:
        """Write into an empty folder, which gets its name when everything is there."""
        sinks = {
            imu.name: ImuSink(folder / f"{imu.name}.csv", "timestamp_ns,wx,wy,wz,ax,ay,az")
            for imu in dataset.of_kind(SensorKind.IMU)
        }
        try:
            export_frames(dataset, sinks, progress)
        finally:
            for sink in sinks.values():
                sink.close()


EXPORTER = ImuCsvExporter()
