"""Cost of expanding an experiment of 100,000 configurations: CPU seconds, and the largest memory of the process.

    python benchmarks/expand.py [--configurations 100000] [--json]

Needs nothing but the package: algorithms and datasets are made up. Fails above the bounds.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from slamhive.domain.algorithm import Algorithm, AlgorithmPackage, Input
from slamhive.domain.configuration import VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Parameter, ParameterType, Scalar
from slamhive.domain.sensors import Sensor, SensorKind, SensorSetup
from slamhive.experiments.binding import CatalogueView
from slamhive.experiments.expansion import PlannedRun, expand
from slamhive.experiments.file import parse_experiment

TIME_BOUND_S = 10.0
MEMORY_BOUND_BYTES = 1_000_000_000

EXPERIMENT = """
name: many
algorithms: first | second
datasets: one | two
steps:
  image_rate: {{step: rate, sensors: camera, hz: 20 | 10 | 5 | 4 | 2}}
  image_resolution: {{step: resolution, sensors: camera, scale: 1 | .8 | .6 | .5 | .4}}
parameters:
  p0: 0:9:1
  p1: lin(0, 1, 10)
  p2: 1:{last}:1
where: image_rate >= 2 and p0 < 100
"""
PER_VALUE = 2 * 2 * 5 * 5 * 10 * 10
"""Configurations for each value of p2."""


class AnyStep:
    """Takes every step as it is."""

    def kinds(self) -> Sequence[str]:
        """The two that the experiment uses."""
        return ["rate", "resolution"]

    def options(self, kind: str) -> Sequence[str]:
        """One for each kind."""
        return ["hz"] if kind == "rate" else ["scale"]

    def resolve(self, kind: str, options: Mapping[str, Scalar], sensor: Sensor) -> tuple[VariantStep | None, Sensor]:
        """Each step on each sensor changes something."""
        return VariantStep(kind, (sensor.name,), options), sensor


def catalogue() -> CatalogueView:
    """Two stereo algorithms of ten parameters, two datasets."""
    parameters = tuple(Parameter(f"p{index}", ParameterType.FLOAT, 0.5, "") for index in range(10))
    cameras = tuple(Sensor(f"cam{index}", SensorKind.CAMERA, f"/cam{index}", 20.0) for index in range(2))
    inputs = (Input("left", SensorKind.CAMERA), Input("right", SensorKind.CAMERA))
    algorithms = [
        Algorithm(
            name,
            AlgorithmPackage(name, Path(), "", "", "", "", ""),
            "stereo",
            "",
            SensorSetup.STEREO,
            inputs,
            "left",
            parameters,
        )
        for name in ("first", "second")
    ]
    datasets = [Dataset(name, Path(), "bag", 1.0, cameras, None, "") for name in ("one", "two")]
    return CatalogueView(
        {entry.name: entry for entry in algorithms}, {entry.name: entry for entry in datasets}, AnyStep()
    )


def main() -> int:
    """Expand, keep every run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configurations", type=int, default=100_000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    before_bytes = _peak_bytes()
    start = time.process_time()
    experiment = parse_experiment(EXPERIMENT.format(last=max(1, options.configurations // PER_VALUE)))
    runs: list[PlannedRun] = list(expand(experiment, catalogue()))
    seconds = time.process_time() - start
    figures = {
        "configurations": len({run.content_hash for run in runs}),
        "cpu_s": round(seconds, 2),
        "peak_bytes": _peak_bytes(),
        "peak_before_bytes": before_bytes,
        "bounds": {"cpu_s": TIME_BOUND_S, "peak_bytes": MEMORY_BOUND_BYTES},
    }
    if options.json:
        print(json.dumps(figures, indent=1))
    else:
        print(
            f"{figures['configurations']:,} configurations in {seconds:.2f} s of CPU time (bound {TIME_BOUND_S:g} s),"
        )
        print(f"all kept: {_peak_bytes() / 1e6:.0f} MB at most (bound {MEMORY_BOUND_BYTES / 1e6:.0f} MB)")
    return 0 if seconds <= TIME_BOUND_S and _peak_bytes() <= MEMORY_BOUND_BYTES else 1


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    sys.exit(main())
