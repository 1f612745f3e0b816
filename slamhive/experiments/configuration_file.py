"""Writes and reads configurations as YAML; also reads the ``config.yaml`` of a published SLAM Hive."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, SlamHiveError, unknown
from slamhive.documents.model import first_problem
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode, VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.domain.matching import match_of
from slamhive.domain.parameters import Scalar, find_parameter, parse_settings
from slamhive.experiments.binding import CatalogueView, resolve_variant, seen_dataset
from slamhive.packages.run_config import build_run_config
from slamhive.runtime import config as run_config
from slamhive.runtime.config import RunConfig

FORMAT = 1
PUBLISHED_KEY = "slam-hive-algorithm"


@dataclass(frozen=True, slots=True)
class ImportedConfigurations:
    """An imported configuration. ``notes`` name, one line each, what was not imported and why.

    ``name`` and ``note`` are what its owner said about it, None where the text says nothing.
    """

    configuration: Configuration
    seed: int = 0
    notes: tuple[str, ...] = ()
    name: str | None = None
    note: str | None = None


class _StepModel(BaseModel):
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, bool | int | float | str] = Field(init=False)
    step: str
    sensors: list[str] = Field(min_length=1)


class _PlaybackModel(BaseModel):
    model_config = ConfigDict(extra="forbid")
    mode: PlaybackMode = PlaybackMode.REALTIME
    rate: float = Field(default=1.0, ge=0.01, le=100)


class _ConfigurationModel(BaseModel):
    model_config = ConfigDict(extra="forbid")
    format: Literal[1] = 1
    name: str | None = None
    note: str | None = None
    algorithm: str
    dataset: str
    parameters: dict[str, bool | int | float | str | list[float]] = Field(default_factory=dict)
    sensors: dict[str, str] = Field(default_factory=dict)
    variant: list[_StepModel] = Field(default_factory=list)
    playback: _PlaybackModel = Field(default_factory=_PlaybackModel)
    map: str | None = None


def configuration_to_yaml(configuration: Configuration, name: str | None = None, note: str = "") -> str:
    """The text that :func:`configuration_from_yaml` reads back to an equal configuration, with its name and note."""
    said = {key: text for key, text in (("name", name), ("note", note)) if text}
    return strict_yaml.dump(
        {
            "format": FORMAT,
            **said,
            "algorithm": configuration.algorithm_label,
            "dataset": configuration.dataset,
            "parameters": {
                key: list(value) if isinstance(value, tuple) else value
                for key, value in configuration.parameters.items()
            },
            **({"sensors": dict(configuration.sensors)} if configuration.sensors else {}),
            "variant": [
                {"step": step.kind, "sensors": list(step.sensors), **step.options} for step in configuration.variant
            ],
            "playback": {"mode": configuration.playback.mode.value, "rate": configuration.playback.rate},
            **({} if configuration.map is None else {"map": configuration.map.run}),
        }
    )


def configuration_from_yaml(
    text: str, view: CatalogueView, source: str = "configuration.yaml"
) -> ImportedConfigurations:
    """Read an exported configuration, or the ``config.yaml`` of a published SLAM Hive.

    Parameters that are not mentioned have their defaults.

    Raises:
        NotFound: an algorithm, dataset, parameter, sensor, topic or step that does not exist.
        InvalidInput: a value that does not fit. All messages name ``source``.
    """
    content = strict_yaml.parse(text, source)
    try:
        if PUBLISHED_KEY in content:
            return _published(run_config.from_yaml(text, source), view)
        return _exported(content, view)
    except ValidationError as error:
        raise InvalidInput(f"{source}: {first_problem(error, _ConfigurationModel)}") from None
    except SlamHiveError as error:
        message = error.message if error.message.startswith(source) else f"{source}: {error.message}"
        raise type(error)(message, error.remedy) from None


def _exported(content: Mapping[str, Any], view: CatalogueView) -> ImportedConfigurations:
    model = _ConfigurationModel.model_validate(content)
    algorithm, dataset = _look_up(view, model.algorithm, model.dataset)
    steps = [VariantStep(step.step, tuple(step.sensors), step.__pydantic_extra__ or {}) for step in model.variant]
    return ImportedConfigurations(
        Configuration(
            algorithm=algorithm.name,
            dataset=dataset.name,
            parameters=parse_settings(algorithm.name, algorithm.parameters, model.parameters),
            playback=Playback(model.playback.mode, model.playback.rate),
            variant=resolve_variant(view.steps, dataset, steps),
            sensors=algorithm.stated_choice(dataset, model.sensors),
            version=algorithm.version,
            map=None if model.map is None else view.find_map(model.map, algorithm),
        ),
        name=model.name,
        note=model.note,
    )


def _look_up(view: CatalogueView, algorithm: str, dataset: str) -> tuple[Algorithm, Dataset]:
    if algorithm not in view.algorithms:
        raise unknown("algorithm", algorithm, list(view.algorithms))
    if dataset not in view.datasets:
        raise unknown("dataset", dataset, list(view.datasets))
    return view.algorithms[algorithm], view.datasets[dataset]


def _published(config: RunConfig, view: CatalogueView) -> ImportedConfigurations:
    algorithm, dataset = _look_up(view, config.algorithm, config.dataset)
    settings: dict[str, object] = {}
    for key, value in {**config.general_parameter, **config.algorithm_parameters, **config.dataset_parameters}.items():
        parameter = find_parameter(algorithm.parameters, key)
        if parameter is not None:
            settings[parameter.key] = value
    if config.playback_mode not in set(PlaybackMode):
        raise InvalidInput(f"playback mode {config.playback_mode!r} is not known", f"use {', '.join(PlaybackMode)}")
    steps = [
        *_steps(dataset, "rate", "every", config.dataset_frequency),
        *_steps(dataset, "resolution", "scale", config.dataset_resolution),
    ]
    configuration = Configuration(
        algorithm=algorithm.name,
        dataset=dataset.name,
        parameters=parse_settings(algorithm.name, algorithm.parameters, settings),
        playback=Playback(PlaybackMode(config.playback_mode), config.playback_rate),
        variant=resolve_variant(view.steps, dataset, steps),
    )
    algorithm.package.check_playback(configuration.playback)
    bound = match_of(
        algorithm,
        seen_dataset(view.steps, dataset, configuration.variant),
        configuration.parameters,
        configuration.sensors,
    ).bound
    same = {entry.key for entry in bound if entry.found is not None and entry.found == entry.value}
    chosen = {key: value for key, value in configuration.parameters.items() if key not in same}
    configuration = replace(configuration, parameters=chosen)
    ours = build_run_config(algorithm, dataset, configuration, config.run_id, config.seed)
    return ImportedConfigurations(configuration, config.seed, tuple(_notes(config, ours, algorithm)))


def _steps(dataset: Dataset, kind: str, option: str, factors: Mapping[str, Scalar]) -> Iterator[VariantStep]:
    """One step for each factor other than 1, on all topics that have it, in the order of the file."""
    sensors = {sensor.topic.lstrip("/"): sensor.name for sensor in dataset.sensors}
    by_factor: dict[Scalar, list[str]] = {}
    for topic, factor in factors.items():
        if factor == 1:
            continue
        if topic.lstrip("/") not in sensors:
            raise unknown(f"topic of dataset {dataset.name}", topic, [sensor.topic for sensor in dataset.sensors])
        by_factor.setdefault(factor, []).append(sensors[topic.lstrip("/")])
    named = {sensors.get(topic.lstrip("/")) for topic in factors}
    for factor, names in by_factor.items():
        shared = (
            tuple(sensor.name for sensor in dataset.sensors if sensor.calibration.get("registered_to") in names)
            if kind == "resolution"
            else ()
        )
        yield VariantStep(kind, (*names, *(name for name in shared if name not in named)), {option: factor})


def _notes(config: RunConfig, ours: RunConfig, algorithm: Algorithm) -> Iterator[str]:
    """Notes on the parts of ``config`` that the run will not use."""
    sections: tuple[tuple[str, Mapping[str, Any], Mapping[str, Any], str], ...] = (
        ("algorithm-parameters", config.algorithm_parameters, {}, f"{algorithm.name} has no such parameter"),
        ("dataset-parameters", config.dataset_parameters, ours.dataset_parameters, "the dataset describes itself"),
        ("general-parameter", config.general_parameter, ours.general_parameter, f"{algorithm.name} does not know it"),
        ("algorithm-remap", config.algorithm_remap, ours.algorithm_remap, "sensors are assigned by role"),
        ("dataset-remap", config.dataset_remap, ours.dataset_remap, "sensors are assigned by role"),
    )
    for section, theirs, known, why in sections:
        for key, value in theirs.items():
            if find_parameter(algorithm.parameters, key) is None and _plain(known.get(key)) != value:
                yield f"{section} {key}={value} is not taken over: {why}"


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value
