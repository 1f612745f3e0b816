"""Makes the variant of a dataset on the node whose run needs it, from the recording in the cache of the node.

A process of its own makes it, so that its libraries take no memory while the run goes on, and can be ended at any time.
Its input is an order, its output a line for each step forwards, and at last what it has made::

    python -m slamhive.executors.slurm.variants RECORDING FOLDER < ORDER
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from slamhive.catalogue.dataset_file import DATASET_FILE, load_dataset
from slamhive.domain.dataset import Dataset
from slamhive.domain.variant import Variant
from slamhive.errors import SlamHiveError
from slamhive.executors.node_store.on_node.cache import MADE, Item
from slamhive.executors.node_store.on_node.run import WrongNode
from slamhive.executors.spec import VariantOrder
from slamhive.schema.model import adapter, dump

_SOURCE = ".source"
_FRACTION, _PROBLEM = "fraction", "problem"
_REPORTED = 0.02
"""The process reports progress in steps of this fraction."""

MadeProgress = Callable[[float], None]
"""Gets the fraction of the variant that is there."""


def item_of(order: VariantOrder) -> Item:
    """The variant as an item of the cache: equal orders have the same name."""
    name = sha256(f"variant {order.key}".encode()).hexdigest()
    return Item(name, order.room_bytes, MADE, 0, f"the variant {order.key[:12]} of {order.dataset}")


def make_apart(order: VariantOrder, recording: Path, folder: Path, progress: MadeProgress) -> None:
    """Make the variant in ``folder``, which is empty, by another process.

    Args:
        order: What to make.
        recording: That of the dataset, on this node.
        folder: For the variant.
        progress: Called now and then. If it raises, or a signal ends the wait, the process is ended.

    Raises:
        WrongNode: The node cannot make it, or would make other bytes.
    """
    program = [sys.executable, "-m", __spec__.name if __name__ == "__main__" else __name__, str(recording), str(folder)]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(json.dumps(dump(VariantOrder, order)))
            process.stdin.close()
            problem = ""
            for line in process.stdout:
                said = json.loads(line)
                problem = said.get(_PROBLEM, "")
                if _FRACTION in said:
                    progress(said[_FRACTION])
        except BaseException:
            process.kill()
            raise
    if problem or process.returncode:
        why = problem or f"the process that makes it ended with code {process.returncode}"
        raise WrongNode(f"the variant {order.key[:12]} of {order.dataset} cannot be made on its node: {why}")


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
        raise _OtherBytes("OpenCV, NumPy or SLAM Hive have other versions here than on the worker", "install the same")
    # The ground truth stays with the controller.
    made = build_variant(replace(dataset, groundtruth=None), variant, folder, lambda done, _words: progress(done))
    made = replace(made, groundtruth=dataset.groundtruth)
    seal(folder, made)
    shutil.rmtree(folder / _SOURCE)
    flush(folder)
    return made


class _OtherBytes(SlamHiveError):
    """This machine would make something else than was asked for."""


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
            say({_FRACTION: fraction})

    try:
        make(adapter(VariantOrder).validate_json(text), recording, folder, progress)
    except (SlamHiveError, OSError) as error:
        say({_PROBLEM: str(error)})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1]), Path(sys.argv[2]), sys.stdin.read()))
