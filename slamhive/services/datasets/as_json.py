"""Algorithms and datasets as JSON, for command line and web API."""

from __future__ import annotations

from typing import Any

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Parameter
from slamhive.services.json_values import plain


def algorithm_to_json(algorithm: Algorithm) -> dict[str, Any]:
    """An algorithm: its package, the sensor for each role, and its parameters by key."""
    package = algorithm.package
    return {
        "name": algorithm.name,
        "title": algorithm.title,
        "mode": algorithm.mode,
        "setup": algorithm.setup.value,
        "inputs": {entry.role: entry.kind.value for entry in algorithm.inputs},
        "package": {
            "name": package.name,
            "title": package.title,
            "version": package.version,
            "upstream": package.upstream,
            "licence": package.licence,
            "citation": package.citation,
            "image": package.image,
        },
        "parameters": {parameter.key: _parameter_to_json(parameter) for parameter in algorithm.parameters},
    }


def dataset_to_json(dataset: Dataset) -> dict[str, Any]:
    """A dataset: its sensors and ground truth. Paths are relative to its folder, whose location is private.

    ``T_body_sensor`` has 16 numbers, row-major; ``exists`` says whether the file of the ground truth exists.
    """
    truth = dataset.groundtruth
    return {
        "name": dataset.name,
        "title": dataset.title,
        "description": dataset.description,
        "licence": dataset.licence,
        "source": dataset.source,
        "attributes": list(dataset.attributes),
        "duration_s": dataset.duration_s,
        "bag": dataset.bag or None,
        "checksum": dataset.checksum,
        "sensors": [
            {
                "name": sensor.name,
                "kind": sensor.kind.value,
                "topic": sensor.topic,
                "rate_hz": sensor.rate_hz,
                "T_body_sensor": list(sensor.T_body_sensor),
                "calibration": {key: plain(value) for key, value in sensor.calibration.items()},
            }
            for sensor in dataset.sensors
        ],
        "groundtruth": None
        if truth is None
        else {
            "file": truth.file,
            "exists": dataset.groundtruth_path is not None and dataset.groundtruth_path.is_file(),
            "gravity_aligned": truth.gravity_aligned,
            "positions_only": truth.positions_only,
        },
        "relations": dataset.relations,
    }


def _parameter_to_json(parameter: Parameter) -> dict[str, Any]:
    return {
        "type": parameter.type.value,
        "default": plain(parameter.default),
        "unit": parameter.unit,
        "minimum": parameter.minimum,
        "maximum": parameter.maximum,
        "choices": list(parameter.choices),
        "general": parameter.general,
        "help": parameter.help,
    }
