"""``experiment.yaml`` to :class:`~slamhive.sweep.experiment.Experiment`; every mistake names file and line."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from slamhive import strict_yaml
from slamhive.errors import InvalidInput
from slamhive.schema.validation import first_problem_at
from slamhive.sweep.condition import parse_condition
from slamhive.sweep.experiment import (
    Axis,
    Evaluation,
    Experiment,
    Link,
    ParameterAxis,
    PlaybackAxes,
    SensorChoice,
    StepDeclaration,
    StepOption,
    Where,
)
from slamhive.sweep.experiment_model import DatasetsWhere, EvaluateModel, ExperimentModel, StepModel


def parse_experiment(text: str, source: str = "experiment.yaml") -> Experiment:
    """Parse an experiment.

    Args:
        text: The YAML.
        source: What to call it in messages, usually the path.

    Raises:
        InvalidInput: naming source, line and what is wrong. Names are not looked up here; see
            :func:`slamhive.sweep.expand.count`.
    """
    content, lines = strict_yaml.parse_with_lines(text, source)
    places = strict_yaml.Places(source, lines)
    try:
        model = ExperimentModel.model_validate(content)
    except ValidationError as error:
        path, problem = first_problem_at(error, ExperimentModel)
        raise InvalidInput(f"{places.of(*path)}: {problem}") from None
    return _experiment(model, places)


def experiment_schema() -> str:
    """The JSON Schema of ``experiment.yaml``, as ``docs/schemas/experiment.schema.json`` holds it."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **ExperimentModel.model_json_schema()}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def _experiment(model: ExperimentModel, places: strict_yaml.Places) -> Experiment:
    evaluate = model.evaluate
    return Experiment(
        name=model.name,
        description=model.description,
        place=places.of("name"),
        algorithms=Axis("algorithm", model.algorithms, places.of("algorithms")),
        datasets=Axis("dataset", _names(model.datasets), places.of("datasets")),
        steps=tuple(_step(name, step, places) for name, step in model.steps.items()),
        parameters=tuple(_parameters(model.parameters, places)),
        links=(*_links("linked", model.linked, places), *_links("tied", model.tied, places)),
        where=tuple(
            Where(parse_condition(text), text, places.of("where", index)) for index, text in enumerate(model.where)
        ),
        seeds=model.seeds,
        repeats=model.repeats,
        repeat_disturbed=model.repeat_disturbed,
        same_cpu=model.same_cpu,
        map=model.map,
        playback=PlaybackAxes(model.playback.mode, model.playback.rate),
        stop_when=model.stop_when,
        limits=model.limits,
        evaluation=Evaluation(alignment=evaluate.alignment)
        if isinstance(evaluate, EvaluateModel)
        else Evaluation(enabled=evaluate),
        executor=model.executor,
        priority=model.priority,
        sensors=tuple(SensorChoice(role, name, places.of("sensors", role)) for role, name in model.sensors.items()),
    )


def _names(datasets: tuple[str, ...] | DatasetsWhere) -> tuple[str, ...]:
    """No names for a filter, which :func:`slamhive.sweep.dataset_choice.name_datasets` replaces by names."""
    return () if isinstance(datasets, DatasetsWhere) else datasets


def _step(name: str, model: StepModel, places: strict_yaml.Places) -> StepDeclaration:
    options: Mapping[str, Any] = model.__pydantic_extra__ or {}
    varied = [option for option, values in options.items() if len(values) > 1]
    alone = varied if len(varied) == 1 else list(options) if len(options) == 1 else []
    return StepDeclaration(
        name=name,
        kind=model.step,
        sensors=model.sensors,
        options=tuple(
            StepOption(
                name=name if option in alone else f"{name}.{option}",
                values=values,
                place=places.of("steps", name, option),
                option=option,
            )
            for option, values in options.items()
        ),
        place=places.of("steps", name),
    )


def _parameters(parameters: Mapping[str, Any], places: strict_yaml.Places) -> Iterator[ParameterAxis]:
    for key, values in parameters.items():
        if not isinstance(values, dict):
            yield ParameterAxis(key, values, places.of("parameters", key), key)
            continue
        for own, own_values in values.items():
            yield ParameterAxis(f"{key}.{own}", own_values, places.of("parameters", key, own), own, algorithm=key)


def _links(section: str, entries: Sequence[Sequence[str]], places: strict_yaml.Places) -> Iterator[Link]:
    for index, names in enumerate(entries):
        place = places.of(section, index)
        if len(names) < 2:
            raise InvalidInput(f"{place}: {section} needs two axes or more, found {list(names)}")
        yield Link(tuple(names), section == "tied", place)
