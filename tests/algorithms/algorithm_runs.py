"""The mapping script of a package without any executor: run on a dataset, or loaded as a module."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

from slamhive.base.project import project_root
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import parse_settings
from slamhive.packages.run_config import build_run_config
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


def load_module(package: str, name: str) -> ModuleType:
    """The module ``name`` beside the mapping script of a package of the project."""
    path = project_root() / "algorithms" / package / "slamhive" / f"{name}.py"
    found = importlib.util.spec_from_file_location(name, path)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module
