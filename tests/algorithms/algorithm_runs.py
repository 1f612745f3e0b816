"""Running a package's mapping script on a dataset without any executor."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from slamhive.catalogue.run_config import build_run_config
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import parse_settings
from slamhive.project import project_root
from slamhive.runtime.config import to_yaml


def run_mapping(
    algorithm: Algorithm, dataset: Dataset, folder: Path, environment: dict[str, str] | None = None, **settings: object
) -> Path:
    """Play ``dataset`` sequentially; returns the result folder, or fails with what the script printed."""
    values = parse_settings(algorithm.name, algorithm.parameters, settings)
    configuration = Configuration(algorithm.name, dataset.name, values, Playback(PlaybackMode.SEQUENTIAL))
    result = folder / "result"
    result.mkdir(parents=True)
    (folder / "config.yaml").write_text(to_yaml(build_run_config(algorithm, dataset, configuration, 1, 1)))
    places = {
        "SLAMHIVE_CONFIG": str(folder / "config.yaml"),
        "SLAMHIVE_DATASET": str(dataset.folder),
        "SLAMHIVE_RESULT": str(result),
        "PYTHONPATH": str(project_root()),
    }
    command = [sys.executable, str(algorithm.package.folder / "slamhive" / "mapping.py")]
    ended = subprocess.run(
        command, env={**os.environ, **places, **(environment or {})}, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout[-2000:] + ended.stderr[-2000:]
    return result
