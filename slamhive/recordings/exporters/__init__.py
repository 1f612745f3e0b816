"""Dataset exporters: each turns datasets into folders of one format, for other tools.

Exporters of other packages come in through the entry-point group ``slamhive.dataset_exporters``.
"""

from __future__ import annotations

from pathlib import Path

from slamhive.base.errors import Conflict, InvalidInput
from slamhive.base.registry import Registry, instances_of
from slamhive.domain.dataset import Dataset
from slamhive.recordings.exporters.base import Exporter, ExportPlan
from slamhive.recordings.exporters.euroc import EurocExporter
from slamhive.recordings.exporters.kitti import KittiExporter
from slamhive.recordings.exporters.ros import McapExporter, Ros1Exporter, Ros2Exporter
from slamhive.recordings.exporters.tum_rgbd import TumRgbdExporter
from slamhive.recordings.exporters.vslam_lab import VslamLabExporter
from slamhive.recordings.staging import Progress, new_dataset_folder

SHIPPED: dict[str, Exporter] = {
    "ros1": Ros1Exporter(),
    "ros2": Ros2Exporter(),
    "mcap": McapExporter(),
    "euroc": EurocExporter(),
    "tum-rgbd": TumRgbdExporter(),
    "kitti": KittiExporter(),
    "vslam-lab": VslamLabExporter(),
}
"""The exporters that come with SLAM Hive; :data:`EXPORTERS` has those of plug-ins too."""

EXPORTERS: Registry[Exporter] = Registry("dataset exporter", "slamhive.dataset_exporters", instances_of(Exporter))
for _name, _exporter in SHIPPED.items():
    EXPORTERS.register(_name, _exporter)


def plan_export(dataset: Dataset, name: str, *, partial: bool) -> ExportPlan:
    """The plan of the exporter ``name``.

    Raises:
        NotFound: No such exporter.
        InvalidInput: The format does not fit, or cannot hold everything and ``partial`` is False.
    """
    dataset.check_recorded()
    plan = EXPORTERS.get(name).plan(dataset)
    if plan.left_out and not partial:
        raise InvalidInput(
            f"{name} cannot hold all of dataset {dataset.name}: {', '.join(plan.left_out)}",
            "add --partial to leave that out, or export to ros1, ros2 or mcap",
        )
    return plan


def export_dataset(plan: ExportPlan, folder: Path, progress: Progress) -> None:
    """Write what ``plan`` says to ``folder``, complete or not at all.

    Raises:
        InvalidInput: The recording is damaged, or a message does not fit its description.
        Conflict: ``folder`` exists.
        Unavailable: Not enough disk space, or the disk refuses.
    """
    if folder.exists():
        raise Conflict(f"{folder} exists already", "choose another folder with --to, or remove it first")
    with new_dataset_folder(folder, plan.needed_bytes) as aside:
        plan.write(aside, progress)
    progress(1.0, "done")
