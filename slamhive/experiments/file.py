"""``experiment.yaml`` to :class:`~slamhive.experiments.experiment.Experiment`; every mistake names file and line."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    Tag,
    ValidationError,
    WithJsonSchema,
)

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.limits import NEVER, Limits, Option, Priority, RepeatDisturbed, StopWhen, options_of
from slamhive.documents.model import PLAIN, SECTION, explained, first_problem_at
from slamhive.documents.submission import (
    MAX_REPEATS,
    OPTIONS,
    Executor,
    RequestedAlignment,
    SameCpu,
    StartingMap,
)
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.gate import Margin
from slamhive.domain.metrics import Direction, Metric, metric
from slamhive.domain.names import NAME_PATTERN, check_name
from slamhive.domain.parameters import Value
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.question import SearchSampler, read_budget
from slamhive.experiments.binding import at
from slamhive.experiments.condition import parse_condition
from slamhive.experiments.experiment import (
    FAILED,
    DecidePlan,
    EvaluationChoice,
    Experiment,
    ExperimentAxis,
    FirstLook,
    Link,
    MetricLimit,
    OptimisePlan,
    ParameterAxis,
    PlaybackAxes,
    SensorChoice,
    StepDeclaration,
    StepOption,
    Where,
)
from slamhive.experiments.values import check_distinct, parse_values
from slamhive.filters.fields import is_number, number, units_of

# The structure of ``experiment.yaml``, from which its JSON Schema is generated.


_SEED, _RATE = OPTIONS["seed"], OPTIONS["playback_rate"]
_NAME = re.compile(NAME_PATTERN)
_LIMIT = re.compile(r"([\w.]+)\s*(<=|>=)\s*(.+)")
MOST_AGAINST = 3
LONGEST_LOOK_S = 3600.0
DEFAULT_KEEP = 0.33
_FAILED_LIMIT = re.compile(r"failed\s*(<=|=)\s*(.+)")

_SCALAR_SCHEMA: dict[str, Any] = {"type": ["number", "string", "boolean"]}
_MATRIX_SCHEMA: dict[str, Any] = {"type": "array", "items": {"type": "number"}, "minItems": 1}
_VALUES_SCHEMA: dict[str, Any] = {
    "description": "One value, a | b | c, first:last:step, lin(first, last, n), log(first, last, n), or a list.",
    "anyOf": [
        _SCALAR_SCHEMA,
        {"type": "array", "items": {"anyOf": [_SCALAR_SCHEMA, _MATRIX_SCHEMA]}, "minItems": 1},
    ],
}
_WORDS_SCHEMA: dict[str, Any] = {
    "description": "One name, 'a | b | c', or a list of names.",
    "anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}, "minItems": 1}],
}


def _values(raw: object) -> tuple[Value, ...]:
    try:
        values = parse_values(raw)
        check_distinct(values)
    except InvalidInput as error:
        raise explained(error) from None
    return values


def _words(raw: object) -> tuple[str, ...]:
    words = [word.strip() for word in raw.split("|")] if isinstance(raw, str) else raw
    if not isinstance(words, list) or not words or not all(isinstance(word, str) and word for word in words):
        raise explained(
            InvalidInput(f"expected names, found {raw!r}; write 'a | b' or a list, names of digits in quotes")
        )
    if len(set(words)) < len(words):
        raise explained(InvalidInput(f"a name is given twice in {raw!r}"))
    return tuple(words)


def _seeds(values: tuple[Value, ...]) -> tuple[int, ...]:
    seeds = tuple(value for value in values if type(value) is int and _SEED.allows(value))
    if len(seeds) < len(values):
        raise explained(InvalidInput(f"seeds are integers from {_SEED.expectation}, found {list(values)}"))
    return seeds


def _rates(values: tuple[Value, ...]) -> tuple[float, ...]:
    rates = tuple(float(value) for value in values if isinstance(value, int | float) and _RATE.allows(value))
    if len(rates) < len(values):
        raise explained(InvalidInput(f"playback rates are numbers from {_RATE.expectation}, found {list(values)}"))
    return rates


def _modes(words: tuple[str, ...]) -> tuple[PlaybackMode, ...]:
    for word in words:
        if word not in set(PlaybackMode):
            raise explained(InvalidInput(f"{word!r} is none of {', '.join(PlaybackMode)}"))
    return tuple(PlaybackMode(word) for word in words)


def _conditions(raw: object) -> tuple[str, ...]:
    texts = [raw] if isinstance(raw, str) else raw
    if not isinstance(texts, list) or not texts or not all(isinstance(text, str) for text in texts):
        raise explained(InvalidInput(f"expected a condition or a list of conditions, found {raw!r}"))
    return tuple(texts)


def _condition_text(texts: tuple[str, ...]) -> tuple[str, ...]:
    for text in texts:
        try:
            parse_condition(text)
        except InvalidInput as error:
            raise explained(error) from None
    return texts


def _experiment_name(name: str) -> str:
    try:
        return check_name("experiment", name)
    except InvalidInput as error:
        raise explained(error) from None


def _axis_name(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise explained(
            InvalidInput(f"{name!r} is not a name; use letters, digits, '_', '.' and '-', the first a letter or digit")
        )
    return name


Values = Annotated[Any, PlainValidator(_values), WithJsonSchema(_VALUES_SCHEMA)]
Words = Annotated[Any, PlainValidator(_words), WithJsonSchema(_WORDS_SCHEMA)]
Seeds = Annotated[Any, PlainValidator(_values), AfterValidator(_seeds), WithJsonSchema(_VALUES_SCHEMA)]
Rates = Annotated[Any, PlainValidator(_values), AfterValidator(_rates), WithJsonSchema(_VALUES_SCHEMA)]
Modes = Annotated[Any, PlainValidator(_words), AfterValidator(_modes), WithJsonSchema(_WORDS_SCHEMA)]
Conditions = Annotated[Any, PlainValidator(_conditions), AfterValidator(_condition_text), WithJsonSchema(_WORDS_SCHEMA)]
AxisName = Annotated[str, AfterValidator(_axis_name)]
LimitValues = Annotated[
    Any, PlainValidator(lambda raw: () if raw is None else _values(raw)), WithJsonSchema(_VALUES_SCHEMA)
]


def _shape(raw: object) -> str:
    return SECTION if isinstance(raw, dict | BaseModel) else PLAIN


ValuesOrSection = Annotated[
    Annotated[Values, Tag(PLAIN)] | Annotated[dict[AxisName, Values], Tag(SECTION)], Discriminator(_shape)
]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, defer_build=True)


class StepModel(_Model):
    """A pre-processing step; every further key is an option of it, and may take several values."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Values] = Field(init=False)
    step: str = Field(description="The kind of step: rate, resolution, noise_gaussian ...")
    sensors: Words = Field(
        description="Kinds (camera, depth, image for both, imu, lidar), roles (left), sensors (cam0) or topics."
    )


class PlaybackModel(_Model):
    """The way in which the recording is fed."""

    mode: Modes = Field(default=(PlaybackMode.REALTIME,), description="realtime, sequential, or both.")
    rate: Rates = Field(default=(1.0,), description="Times real time.")


class LimitsModel(_Model):
    """Limits of each run. Several values make an axis."""

    cpus: LimitValues = Field(default=(), description="CPU limit in cores.")
    memory: LimitValues = Field(default=(), description="Memory limit: 500 MB | 1 GB. A number alone is in MB.")
    slow_down: LimitValues = Field(default=(), description="Of each core, a run gets 1 / this of the time: 1 | 4.")
    timeout_s: LimitValues = Field(default=(), description="Wall-clock limit (s).")
    nice: LimitValues = Field(default=(), description="Niceness, 0 to 19; higher lets other processes go first.")
    cpu_cores: LimitValues = Field(default=(), description="The same as cpus.")
    memory_mb: LimitValues = Field(default=(), description="The same as memory.")


class EvaluateModel(_Model):
    """The way in which runs are evaluated."""

    alignment: RequestedAlignment = None
    trajectory: TrajectoryKind | None = Field(
        default=None,
        description="Which trajectory of a run is judged; left out: traj.txt. "
        "live compares systems that correct their past with those that do not.",
    )


SwitchOrEvaluate = Annotated[
    Annotated[bool, Tag(PLAIN)] | Annotated[EvaluateModel, Tag(SECTION)], Discriminator(_shape)
]


class DatasetsWhere(_Model):
    """Datasets that a filter describes, instead of their names."""

    where: str = Field(min_length=1, description="A filter, such as: indoor and sensor = stereo.")


WordsOrWhere = Annotated[Annotated[Words, Tag(PLAIN)] | Annotated[DatasetsWhere, Tag(SECTION)], Discriminator(_shape)]


class DecideModel(_Model):
    """The question which candidate is best: the experiment chooses its runs, and stops when it knows."""

    metric: str = Field(default="ate.rmse", description="What is compared: its mean over the datasets.")
    difference: float | str = Field(
        description="The largest difference that does not matter: 1 cm, 0.01, or a share of the smaller mean, 5%."
    )
    budget: str = Field(description="Of all runs: 120 runs, 30 min, 2 h.")
    error: float = Field(default=0.05, ge=0.0001, le=0.5, description="The largest chance that the answer is false.")
    worst: float | str | None = Field(
        default=None, description="What a failed run counts as: 1 m. Else twice the worst good value, or 0 for a share."
    )


class OptimiseModel(_Model):
    """The search for the best of many candidates: the experiment chooses its runs, and stops when it is near enough."""

    metric: str = Field(default="ate.rmse", description="What is to be the best: its typical value.")
    against: Words = Field(
        default=(), description="Up to three that are traded against it: cpu.mean | ram.max | failed."
    )
    budget: str = Field(description="Of all runs: 300 runs, 8 h.")
    limits: Words = Field(
        default=(),
        description="What a run must keep, else it counts as failed: cpu.mean <= 2. And failed = 0, failed <= 10%: how "
        "many of a candidate's runs may fail.",
    )
    within: float | str = Field(default=0.05, description="How near to the truly best is near enough: 5%.")
    confidence: float = Field(default=0.95, ge=0.5, le=0.999, description="Of being so near.")
    worst: float | str | None = Field(
        default=None, description="What a failed run counts as: 1 m. Else twice the worst good value, or 0 for a share."
    )
    first_look: float | str | None = Field(
        default=None,
        description="Run each combination on the beginning of the recording first: 15 s. Only the best of these runs "
        "are followed by one on the whole, and only whole ones answer.",
    )
    keep: float | str | None = Field(default=None, description="The share of first looks that are followed: 33%.")
    sampler: SearchSampler = Field(
        default=SearchSampler.MODEL, description="Who chooses the next runs: our model, or Optuna's tpe or nsga2."
    )


class ExperimentModel(_Model):
    """An experiment: what is combined with what. Every combination becomes one configuration."""

    model_config = ConfigDict(title="SLAM Hive experiment")
    format: Literal[1] = 1
    name: Annotated[str, AfterValidator(_experiment_name)] = Field(
        description="Also the beginning of every configuration's name.",
        json_schema_extra={"pattern": rf"^{NAME_PATTERN}$"},
    )
    description: str = ""
    algorithms: Words
    datasets: WordsOrWhere
    steps: dict[AxisName, StepModel] = Field(
        default_factory=dict, description="Pre-processing in the order of application, each under a name of yours."
    )
    parameters: dict[AxisName, ValuesOrSection] = Field(
        default_factory=dict,
        description="By key or general name, for each algorithm that knows it; below an algorithm's name for it alone.",
    )
    sensors: dict[str, str] = Field(
        default_factory=dict,
        description="The sensor for a role where several fit (left: cam2), for each algorithm that has the role.",
    )
    linked: list[list[str]] = Field(default_factory=list, description="Lists of axes whose values move together.")
    tied: list[list[str]] = Field(default_factory=list, description="Lists of axes that always have the same value.")
    where: Conditions = Field(default=(), description="Conditions that every combination must meet.")
    seeds: Seeds = Field(default=(0,), description="Each configuration is run with each seed.")
    repeats: int = Field(default=1, ge=1, le=MAX_REPEATS, description="How often, with each seed.")
    repeat_disturbed: RepeatDisturbed = 0
    same_cpu: SameCpu = True
    playback: PlaybackModel = Field(default_factory=PlaybackModel)
    map: StartingMap = None
    stop_when: StopWhen = NEVER
    limits: LimitsModel = Field(default_factory=LimitsModel)
    evaluate: SwitchOrEvaluate = Field(default=True, description="false leaves the evaluation to you.")
    executor: Executor = None
    priority: Priority = 0
    decide: DecideModel | None = Field(default=None, description="Run only what it takes to find the best candidate.")
    optimise: OptimiseModel | None = Field(default=None, description="Search the combinations instead of running all.")


def parse_experiment(text: str, source: str = "experiment.yaml") -> Experiment:
    """Parse an experiment.

    Args:
        text: The YAML.
        source: What to call it in messages, usually the path.

    Raises:
        InvalidInput: naming source, line and what is wrong. Names are not looked up here; see
            :func:`slamhive.experiments.expansion.count`.
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
    limits = {axis.name: axis for axis in _limit_axes(model.limits, places)}
    return Experiment(
        name=model.name,
        description=model.description,
        place=places.of("name"),
        algorithms=ExperimentAxis("algorithm", model.algorithms, places.of("algorithms")),
        datasets=ExperimentAxis("dataset", _names(model.datasets), places.of("datasets")),
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
        limits=Limits().varied({name: axis.values[0] for name, axis in limits.items() if len(axis.values) == 1}),
        limit_axes=tuple(axis for axis in limits.values() if len(axis.values) > 1),
        evaluation=EvaluationChoice(alignment=evaluate.alignment, trajectory=evaluate.trajectory)
        if isinstance(evaluate, EvaluateModel)
        else EvaluationChoice(enabled=evaluate),
        executor=model.executor,
        priority=model.priority,
        sensors=tuple(SensorChoice(role, name, places.of("sensors", role)) for role, name in model.sensors.items()),
        decide=None if model.decide is None else _decide(model.decide, model, places),
        optimise=None if model.optimise is None else _optimise(model.optimise, model, places),
    )


def _limit_axes(model: LimitsModel, places: strict_yaml.Places) -> Iterator[ExperimentAxis]:
    """The limits that are stated, named after the fields of :class:`Limits`."""
    for option in options_of(Limits):
        keys = [key for key in (option.name, LIMIT_WORDS.get(option.name, "")) if getattr(model, key, ())]
        if len(keys) > 1:
            raise InvalidInput(f"{places.of('limits', keys[1])}: {' and '.join(keys)} are the same", "keep one of them")
        for key in keys:
            place = places.of("limits", key)
            try:
                values = tuple(_limit_value(option, value) for value in getattr(model, key))
                check_distinct(values)
            except InvalidInput as error:
                raise at(place, error) from None
            yield ExperimentAxis(option.name, values, place)


LIMIT_WORDS = {"cpu_cores": "cpus", "memory_mb": "memory"}
"""Other keys of limits: those of the command line."""


def _limit_value(option: Option, written: Value) -> float | int:
    """``500 MB`` in the unit and with the type of the option."""
    is_number = isinstance(written, int | float) and not isinstance(written, bool)
    value = float(written) if is_number else number(str(written), option.unit)  # type: ignore[arg-type]
    if value is None or (option.kind is int and not value.is_integer()):
        what = "whole number" if option.kind is int else "number"
        raise InvalidInput(f"{option.label} {str(written)[:40]!r} is no {what}", f"use {option.expectation}")
    checked: float | int = option.kind(value)
    option.check(checked)
    return checked


def _decide(decide: DecideModel, model: ExperimentModel, places: strict_yaml.Places) -> DecidePlan:
    _check_alone(model, places)
    key = "metric"
    try:
        compared = compared_metric(decide.metric)
        key = "budget"
        budget = read_budget(decide.budget)
        key = "difference"
        difference = read_difference(decide.difference, compared)
        key = "worst"
        worst = None if decide.worst is None else _amount(decide.worst, compared)
    except SlamHiveError as error:
        raise at(places.of("decide", key), error) from None
    return DecidePlan(compared.key, difference, budget, places.of("decide"), decide.error, worst)


def _optimise(optimise: OptimiseModel, model: ExperimentModel, places: strict_yaml.Places) -> OptimisePlan:
    _check_alone(model, places)
    key = "metric"
    try:
        compared = compared_metric(optimise.metric)
        key = "budget"
        budget = read_budget(optimise.budget)
        key = "limits"
        failing, limits = _limits(optimise.limits)
        key = "against"
        against = tuple(FAILED if name == FAILED else compared_metric(name).key for name in optimise.against)
        if len(against) > MOST_AGAINST:
            found = f"{len(against)} objectives are too many beside {compared.key}"
            raise InvalidInput(found, f"name {MOST_AGAINST} at most")
        for number_before, name in enumerate(against):
            if name in (compared.key, *against[:number_before]):
                raise InvalidInput(f"{name} is there twice", "name each objective once")
        key = "within"
        within = number(str(optimise.within), "")
        if within is None or not 0 < within <= 1:
            raise InvalidInput(f"{optimise.within!r} is no share", "write 5%, or 0.05")
        key = "worst"
        worst = None if optimise.worst is None else _amount(optimise.worst, compared)
        key = "first_look"
        first_look = None
        if optimise.first_look is not None:
            seconds = number(str(optimise.first_look), "s")
            if seconds is None or not 1 <= seconds <= LONGEST_LOOK_S:
                raise InvalidInput(
                    f"{optimise.first_look!r} is no first look", "write 15 s, or another length from 1 s on"
                )
            if against:
                raise InvalidInput(
                    f"a first look ranks by {compared.key} alone", "leave out against, or leave out first_look"
                )
            key = "keep"
            keep = number(str(DEFAULT_KEEP if optimise.keep is None else optimise.keep), "")
            if keep is None or not 0.05 <= keep <= 0.9:
                raise InvalidInput(f"{optimise.keep!r} is no share of first looks to keep", "write 33%, 5% to 90%")
            first_look = FirstLook(seconds, keep)
        elif optimise.keep is not None:
            key = "keep"
            raise InvalidInput("keep needs first looks", "add first_look: 15 s, or leave out keep")
    except SlamHiveError as error:
        raise at(places.of("optimise", key), error) from None
    return OptimisePlan(
        compared.key,
        budget,
        places.of("optimise"),
        limits,
        within,
        optimise.confidence,
        worst,
        against,
        failing,
        optimise.sampler,
        first_look,
    )


def _limits(texts: Sequence[str]) -> tuple[float | None, tuple[MetricLimit, ...]]:
    """The share of runs that may fail, and the limits of runs."""
    failing: float | None = None
    limits: list[MetricLimit] = []
    for text in texts:
        found = _FAILED_LIMIT.fullmatch(text.strip())
        if found is None:
            limits.append(_limit(text))
            continue
        failing = number(found[2], "")
        if failing is None or not 0 <= failing < 1 or (found[1] == "=" and failing):
            raise InvalidInput(f"{text!r} is no limit", "write failed = 0, or failed <= 10%")
    return failing, tuple(limits)


def _check_alone(model: ExperimentModel, places: strict_yaml.Places) -> None:
    if model.decide is not None and model.optimise is not None:
        raise InvalidInput(f"{places.of('optimise')}: an experiment has one question", "keep decide, or optimise")
    if model.repeats != 1:
        raise InvalidInput(
            f"{places.of('repeats')}: the experiment decides how often each combination runs", "leave out repeats"
        )


def compared_metric(key: str) -> Metric:
    """A metric that one value of is better than another; raises NotFound or InvalidInput."""
    compared = metric(key)
    if compared.direction is Direction.NEUTRAL:
        raise InvalidInput(f"no direction of {compared.key} is better", "use another metric")
    return compared


def _limit(text: str) -> MetricLimit:
    """``ram.max <= 1 GB``, ``tracked_fraction >= 90%``."""
    found = _LIMIT.fullmatch(text.strip())
    if found is None:
        raise InvalidInput(f"{text!r} is no limit", "write METRIC <= VALUE, or METRIC >= VALUE")
    limited = metric(found[1])
    return MetricLimit(limited.key, found[2] == "<=", _amount(found[3], limited))


def read_difference(written: float | str, compared: Metric) -> Margin:
    """A difference such as ``1 cm``, a number in the metric's unit, or a share: ``5%``. Raises InvalidInput."""
    share = str(written).strip()
    if share.endswith("%"):
        text = share[:-1].strip()
        value = float(text) / 100 if is_number(text) else None
    else:
        value = _amount(written, compared)
    if value is None or value <= 0:
        raise InvalidInput(f"{written!r} is no difference", f"write {_example(compared)}, or a share such as 5%")
    return Margin(value, relative=share.endswith("%"))


def _amount(written: float | str, compared: Metric) -> float:
    """``1 cm`` in the unit of the metric."""
    value = number(str(written), compared.unit)
    if value is None:
        raise InvalidInput(f"{written!r} is no value of {compared.key}", f"write {_example(compared)}")
    return value


def _example(compared: Metric) -> str:
    units = units_of(compared.unit)
    return "a number such as 0.1" if not units else f"a number and one of {', '.join(units)}"


def _names(datasets: tuple[str, ...] | DatasetsWhere) -> tuple[str, ...]:
    """No names for a filter, which :func:`slamhive.experiments.expansion.name_datasets` replaces by names."""
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
