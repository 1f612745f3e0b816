"""Makes the variant of a dataset on a node that has SLAM Hive, for :mod:`slamhive.executors.node_store.on_node.making`.

It reads an order from its input::

    python -m slamhive.executors.node_store.variants RECORDING FOLDER < ORDER
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from slamhive.catalogue.dataset_file import DATASET_FILE, load_dataset
from slamhive.domain.dataset import Dataset
from slamhive.domain.variant import Variant
from slamhive.errors import SlamHiveError
from slamhive.executors.node_store.on_node.making import BAG, CHECKSUM, FRACTION, MADE_FILE, PROBLEM, MadeProgress
from slamhive.executors.spec import VariantOrder
from slamhive.schema.model import adapter

_SOURCE = ".source"
_REPORTED = 0.02
"""Progress is reported in steps of this fraction."""


class OtherBytes(SlamHiveError):
    """This machine would make something else than was asked for."""


def make(order: VariantOrder, recording: Path, folder: Path, progress: MadeProgress) -> Dataset:
    """Make the variant in ``folder``, with the bytes that other machines would make. Raises SlamHiveError, OSError."""
    from slamhive.bags.staging import seal  # noqa: PLC0415 - they load OpenCV
    from slamhive.bags.variants.build import build_variant  # noqa: PLC0415
    from slamhive.bags.variants.manifest import flush  # noqa: PLC0415
    from slamhive.bags.variants.plan import plan_variant  # noqa: PLC0415

    dataset = _beside(order, recording, folder / _SOURCE)
    variant: Variant = adapter(Variant).validate_python(order.steps)
    plan = plan_variant(dataset, variant)
    if plan is None or plan.key != order.key:
        raise OtherBytes("OpenCV, NumPy or SLAM Hive have other versions here than on the worker", "install the same")
    # The ground truth stays with the controller.
    made = build_variant(replace(dataset, groundtruth=None), variant, folder, lambda done, _words: progress(done))
    made = replace(made, groundtruth=dataset.groundtruth)
    seal(folder, made)
    (folder / MADE_FILE).write_text(json.dumps({CHECKSUM: made.checksum, BAG: made.bag}), encoding="utf-8")
    shutil.rmtree(folder / _SOURCE)
    flush(folder)
    return made


def _beside(order: VariantOrder, recording: Path, folder: Path) -> Dataset:
    """The dataset as a folder that links to its recording."""
    folder.mkdir()
    (folder / DATASET_FILE).write_text(order.description, encoding="utf-8")
    dataset = load_dataset(folder)
    dataset.bag_path.parent.mkdir(parents=True, exist_ok=True)
    dataset.bag_path.symlink_to(recording)
    return dataset


def _main(recording: Path, folder: Path, text: str) -> int:
    reported = 0.0

    def say(content: dict[str, Any]) -> None:
        print(json.dumps(content), flush=True)  # noqa: T201 - the one who waits reads it

    def progress(fraction: float) -> None:
        nonlocal reported
        if fraction - reported >= _REPORTED:
            reported = fraction
            say({FRACTION: fraction})

    try:
        make(adapter(VariantOrder).validate_json(text), recording, folder, progress)
    except (SlamHiveError, OSError) as error:
        say({PROBLEM: str(error)})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1]), Path(sys.argv[2]), sys.stdin.read()))
