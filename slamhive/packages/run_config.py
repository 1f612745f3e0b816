"""From an algorithm, a dataset and a configuration to the content of ``config.yaml``. Pure."""

from __future__ import annotations

import math
from typing import Any

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration, Variant
from slamhive.domain.dataset import Dataset
from slamhive.domain.matching import match_of
from slamhive.domain.sensors import Sensor
from slamhive.runtime.config import RunConfig


def build_run_config(
    algorithm: Algorithm,
    dataset: Dataset,
    configuration: Configuration,
    run_id: int | None,
    seed: int,
    source: Dataset | None = None,
) -> RunConfig:
    """The unified configuration of one run.

    Args:
        algorithm: What runs.
        dataset: What it sees: a variant's rates, sizes and intrinsics are the variant's own.
        configuration: Parameters and playback.
        run_id: The run, None outside of one.
        seed: Its seed.
        source: The dataset that ``dataset`` was made of, None if it is no variant.

    The algorithm knows sensors by role. The properties of the sensor in role ``left`` are ``left_<calibration key>``,
    ``left_rate_hz`` and ``left_T_body_sensor`` (16 floats, row-major). The algorithm listens to ``/left``, or to what
    ``topics`` in ``algorithm.yaml`` says, which ``dataset-remap`` maps to the recorded topic.

    Raises InvalidInput if the dataset lacks a sensor, or a property of one, that the algorithm needs.
    """
    match = match_of(algorithm, dataset, configuration.parameters, configuration.sensors)
    sensors = match.sensors
    dataset_parameters: dict[str, Any] = {}
    for role, sensor in sensors.items():
        calibration = {f"{role}_{key}": value for key, value in sensor.calibration.items()}
        dataset_parameters.update(
            {
                **calibration,
                f"{role}_rate_hz": sensor.rate_hz,
                f"{role}_T_body_sensor": sensor.T_body_sensor,
            }
        )
    values = match.values(configuration.parameters)
    # Launch arguments that published scripts pass on: those that name topics, and no others.
    topics = {entry.role: entry for entry in algorithm.topics}
    remap: dict[str, str] = {}
    for entry in match.remaps:
        topic = topics.get(entry.role)
        if topic is None:
            remap[entry.role] = entry.seen
        elif topic.argument is not None:
            remap[topic.argument] = entry.seen
    return RunConfig(
        algorithm=algorithm.name,
        dataset=dataset.name,
        algorithm_parameters=values,
        dataset_parameters=dataset_parameters,
        algorithm_remap=remap,
        dataset_remap={entry.seen: entry.recorded for entry in match.remaps},
        dataset_frequency={sensor.topic: _every(sensor, source) for sensor in sensors.values()},
        dataset_resolution={
            sensor.topic: _image_scale(sensor, configuration.variant)
            for sensor in sensors.values()
            if "width" in sensor.calibration
        },
        algorithm_attribute=algorithm.setup.value,
        dataset_attribute=", ".join(dataset.attributes) or None,
        general_parameter={
            "save_map": 0,
            **{
                parameter.general: values[parameter.key]
                for parameter in algorithm.parameters
                if parameter.general is not None and parameter.key in values
            },
        },
        run_id=run_id,
        seed=seed,
        playback_mode=configuration.playback.mode.value,
        playback_rate=configuration.playback.rate,
    )


def _every(sensor: Sensor, source: Dataset | None) -> int:
    """Every N-th message of the source is left; the nearest whole number where a rate in Hz was asked for."""
    return 1 if source is None else max(1, round(source.sensor(sensor.name).rate_hz / sensor.rate_hz))


def _image_scale(sensor: Sensor, variant: Variant) -> float:
    """The product of the factors that the sensor's images were scaled by."""
    steps = (step for step in variant if step.kind == "resolution" and sensor.name in step.sensors)
    return math.prod(float(step.options["scale"]) for step in steps)
