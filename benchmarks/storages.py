"""Speed of one step on each storage: a ROS 1 bag, a folder of ROS 2 (SQLite) and an MCAP file of equal messages.

The storages are measured in turn, so that other load meets all of them. It prints the median MB/s of the source, and
the median ratio of times to the ROS 1 bag of the same round.

    python -m benchmarks.storages [--megabytes 300] [--rounds 5] [--json]

Recordings lie in a temporary folder and are removed; five times the size given must be free there.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import tempfile
import time
from pathlib import Path

from benchmarks.variants import CAMERAS, every_second, half_size, make_dataset, say
from slamhive.base.files import size_bytes
from slamhive.domain.configuration import VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.exporters import export_dataset, plan_export
from slamhive.recordings.variants.build import build_variant

STORAGES = ("ros1", "ros2", "mcap")
STEPS = {"half rate": every_second(*CAMERAS), "half size": half_size(*CAMERAS)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=300.0, help="size of the recording")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="slamhive-storages-") as scratch:
        folder = Path(scratch)
        say("generating the recordings")
        bag = make_dataset(folder / "bag", "raw", arguments.megabytes)
        datasets = {name: exported(bag, name, folder / name) for name in STORAGES}
        shutil.rmtree(bag.folder)
        rows = [row for name, step in STEPS.items() for row in measure(name, step, datasets, arguments.rounds)]
    if arguments.json:
        print(json.dumps(rows, indent=1))
        return
    print("step       storage    MB/s   time / ROS 1")
    for row in rows:
        print(f"{row['step']:10s} {row['storage']:8s} {row['mb_per_s']:6.0f} {row['ratio']:8.2f}")


def exported(dataset: Dataset, name: str, folder: Path) -> Dataset:
    """``dataset`` with its recording in another storage."""
    export_dataset(plan_export(dataset, name, partial=False), folder, silent)
    return load_dataset(folder)


def measure(name: str, step: VariantStep, datasets: dict[str, Dataset], rounds: int) -> list[dict[str, float | str]]:
    """One row for each storage; the first round warms up."""
    times: dict[str, list[float]] = {storage: [] for storage in datasets}
    for number in range(rounds + 1):
        for storage, dataset in datasets.items():
            taken_s = timed(dataset, step)
            if number:
                times[storage].append(taken_s)
        say(f"{name}: round {number} of {rounds}")
    return [
        {
            "step": name,
            "storage": storage,
            "mb_per_s": size_bytes(datasets[storage].bag_path) / 1e6 / statistics.median(taken),
            "ratio": statistics.median(own / ros1 for own, ros1 in zip(taken, times["ros1"], strict=True)),
        }
        for storage, taken in times.items()
    ]


def timed(dataset: Dataset, step: VariantStep) -> float:
    """Seconds to make the variant, which is removed."""
    target = dataset.folder / "variant"
    target.mkdir()
    began_s = time.perf_counter()
    build_variant(dataset, (step,), target, silent)
    taken_s = time.perf_counter() - began_s
    shutil.rmtree(target)
    return taken_s


def silent(_fraction: float, _text: str) -> None:
    """Show nothing."""


if __name__ == "__main__":
    main()
