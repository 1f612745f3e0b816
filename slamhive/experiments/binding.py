"""Binds an experiment to one algorithm and one dataset: the axes that apply, with typed values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from math import floor, prod

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, unknown
from slamhive.base.strict_yaml import YamlPlace
from slamhive.documents.limits import Limits
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import (
    CLIP,
    Configuration,
    InputMap,
    Playback,
    PlaybackMode,
    StepRules,
    Variant,
    VariantStep,
    content_hash,
    parameter_content,
)
from slamhive.domain.dataset import Dataset
from slamhive.domain.matching import check_known
from slamhive.domain.parameters import Parameter, Scalar, Value, default_values, find_parameter
from slamhive.domain.roles import BY_RULE, Chosen
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.experiments.condition import compared_names, read_names
from slamhive.experiments.experiment import FIRST_LOOK, Experiment, ExperimentAxis, StepDeclaration
from slamhive.experiments.values import check_distinct, plain, typed

# Steps on sensors, in the canonical order and spelling that identifies a variant.


def resolve_variant(rules: StepRules, dataset: Dataset, steps: Iterable[VariantStep]) -> Variant:
    """``steps`` on ``dataset`` with canonical options, those left out that change nothing.

    Raises NotFound or InvalidInput for a sensor, step or option that does not exist or makes no sense.
    """
    sensors = {sensor.name: sensor for sensor in dataset.sensors}
    variant: list[VariantStep] = []
    for step in steps:
        names = [dataset.sensor(name).name for name in step.sensors]
        variant.extend(resolve_step(rules, step.kind, step.options, names, sensors))
    return tuple(variant)


def seen_dataset(rules: StepRules, dataset: Dataset, variant: Variant) -> Dataset:
    """``dataset`` with its sensors as ``variant`` leaves them; raises as :func:`resolve_variant`."""
    sensors = {sensor.name: sensor for sensor in dataset.sensors}
    for step in variant:
        names = [dataset.sensor(name).name for name in step.sensors]
        resolve_step(rules, step.kind, step.options, names, sensors)
    return replace(dataset, sensors=tuple(sensors.values()))


def resolve_step(
    rules: StepRules,
    kind: str,
    options: Mapping[str, Scalar],
    names: Sequence[str],
    sensors: dict[str, Sensor],
) -> list[VariantStep]:
    """One step on the sensors called ``names``; sensors that it treats alike share a step.

    ``sensors`` holds every sensor as the steps before have left it, and is brought up to date.
    """
    merged: dict[VariantStep, list[str]] = {}
    for name in names:
        resolved, sensors[name] = rules.resolve(kind, options, sensors[name])
        if resolved is not None:
            merged.setdefault(VariantStep(resolved.kind, (), resolved.options), []).append(name)
    return [VariantStep(step.kind, tuple(treated), step.options) for step, treated in merged.items()]


# The known algorithms, datasets and kinds of steps, against which an experiment is checked.


def _no_maps(reference: str, algorithm: Algorithm) -> InputMap:
    raise InvalidInput(f"there is no run {reference} with a map for {algorithm.name}")


def _no_recording(dataset: Dataset) -> float:
    raise NotFound(f"the recording of {dataset.name} is not here")


@dataclass(frozen=True, slots=True)
class CatalogueView:
    """Algorithms and datasets by name, and the rules of pre-processing steps.

    ``find_map`` finds the map of the run with a number or uid for an algorithm; raises NotFound or InvalidInput.
    ``begin_s`` reads when the recording of a dataset begins (s since 1970); raises NotFound or InvalidInput.
    """

    algorithms: Mapping[str, Algorithm]
    datasets: Mapping[str, Dataset]
    steps: StepRules
    find_map: Callable[[str, Algorithm], InputMap] = _no_maps
    begin_s: Callable[[Dataset], float] = _no_recording


IMAGE = "image"
_KINDS: dict[str, tuple[SensorKind, ...]] = {
    **{kind.value: (kind,) for kind in SensorKind},
    IMAGE: (SensorKind.CAMERA, SensorKind.DEPTH),
}

PLAYBACK_MODE = "playback_mode"
PLAYBACK_RATE = "playback_rate"
WHOLE = "whole"

Row = dict[str, Value]
"""The value of each axis that applies, by axis name."""


def at(place: YamlPlace, error: SlamHiveError) -> SlamHiveError:
    """The same error, naming the place."""
    return type(error)(f"{place}: {error.message}", error.remedy)


@dataclass(frozen=True, slots=True)
class BoundStep:
    """A step on sensors of a dataset; ``options``: {option: name of its axis}."""

    declaration: StepDeclaration
    sensors: tuple[Sensor, ...]
    options: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class AxisGroup:
    """Axes that change together (often a single one), by name. Values are typed on access."""

    axes: Mapping[str, BoundAxis]

    def __len__(self) -> int:
        return len(next(iter(self.axes.values())).raw)

    def rows(self) -> tuple[tuple[Value, ...], ...]:
        """Tuples with one value for each axis; raises InvalidInput for a value that does not fit."""
        return tuple(zip(*(axis.values() for axis in self.axes.values()), strict=True))


@dataclass(frozen=True, slots=True)
class BoundAxis:
    """The values of an axis as written; ``parameter`` gives them their type, if the axis is a parameter."""

    raw: tuple[Value, ...]
    place: YamlPlace
    parameter: Parameter | None = None

    def values(self) -> tuple[Value, ...]:
        """The typed values; raises InvalidInput that names the place."""
        if self.parameter is None:
            return tuple(plain(value) for value in self.raw)
        try:
            values = tuple(typed(self.parameter, value) for value in self.raw)
            check_distinct(values)
        except InvalidInput as error:
            raise at(self.place, error) from None
        return values


class Filter:
    """The conditions of an experiment.

    Args:
        experiment: Its ``where``.
        known: Every name that means something for some algorithm of the experiment; other words are text.

    Attributes:
        reads: The words that may be names in the conditions.
    """

    def __init__(self, experiment: Experiment, known: frozenset[str]) -> None:
        self._where = experiment.where
        self._known = known
        for where in experiment.where:
            for name in sorted(compared_names(where.condition) - known):
                raise at(where.place, unknown("name in the condition", name, sorted(known)))
        self.reads = frozenset().union(*(read_names(where.condition) for where in experiment.where))

    def excludes(self, context: Mapping[str, Value]) -> bool:
        """Tell if a condition is decided against ``context``."""
        for where in self._where:
            try:
                if where.condition.decide(context, self._known) is False:
                    return True
            except InvalidInput as error:
                raise at(where.place, error) from None
        return False

    def __bool__(self) -> bool:
        return bool(self._where)


@dataclass(slots=True)
class ParameterPair:
    """One algorithm on one dataset, with the axes that apply.

    ``parameters``: {axis name: parameter key}. ``fixed`` are the values of names that do not vary, ``aliases`` the
    further names of axes: {name: axis name}; conditions may use them all. ``variants`` remembers what was resolved.
    ``limits`` are those of all runs, but for those that ``limit_axes`` vary. ``clip_s`` are the times between which
    first looks see the recording.
    """

    algorithm: Algorithm
    dataset: Dataset
    groups: tuple[AxisGroup, ...]
    parameters: Mapping[str, str]
    steps: tuple[BoundStep, ...]
    fixed: Mapping[str, Value]
    aliases: Mapping[str, str]
    rules: StepRules
    variants: dict[tuple[Value, ...], Variant]
    sensors: Chosen
    limits: Limits
    limit_axes: tuple[str, ...] = ()
    map: InputMap | None = None
    clip_s: tuple[float, float] | None = None

    @property
    def size(self) -> int:
        """Number of rows before conditions."""
        size = 1
        for group in self.groups:
            size *= len(group)
        return size

    def rows(self, conditions: Filter, *, alike: bool = True) -> Iterator[Row]:
        """All combinations that meet the conditions; the first axis of the file varies slowest.

        Their variants are checked on the way; raises InvalidInput. Filter and steps do not read every axis, and
        are asked once for each combination of those that they read. Without ``alike``, only the first combination of
        those that differ in other axes is yielded.
        """
        names = [name for group in self.groups for name in group.axes]
        deciding = self.deciding(conditions)
        kept: dict[object, bool] = {}
        groups = [list(enumerate(group.rows())) for group in self.groups]
        if not alike:
            groups = [part if place in deciding else part[:1] for place, part in enumerate(groups)]
        for parts in product(*groups):
            row = dict(zip(names, chain.from_iterable([values for _, values in parts]), strict=True))
            read = tuple([parts[place] for place in deciding])
            if read not in kept:
                if len(deciding) == len(self.groups):
                    kept.clear()  # none comes again
                kept[read] = not (conditions and conditions.excludes(self.context(row)))
                if kept[read]:
                    self.variant(row)
            if kept[read]:
                yield row

    def count(self, conditions: Filter) -> int:
        """Number of combinations that meet the conditions; raises as :meth:`rows`."""
        deciding = self.deciding(conditions)
        others = prod(len(group) for place, group in enumerate(self.groups) if place not in deciding)
        return sum(1 for _ in self.rows(conditions, alike=False)) * others

    def deciding(self, conditions: Filter) -> tuple[int, ...]:
        """Places of the groups with an axis that conditions or steps read."""
        read = {self.aliases.get(name, name) for name in conditions.reads} | set(self.step_axes)
        return tuple(place for place, group in enumerate(self.groups) if not read.isdisjoint(group.axes))

    @property
    def step_axes(self) -> tuple[str, ...]:
        """The axes that the variant follows from: options of steps, and first looks."""
        axes = [name for step in self.steps for name in step.options.values()]
        return (*axes, *([] if self.clip_s is None else [FIRST_LOOK]))

    def context(self, row: Row) -> dict[str, Value]:
        """The value of each name that a condition may use."""
        return {**self.fixed, **row, **{alias: row[name] for alias, name in self.aliases.items()}}

    def limits_of(self, row: Row) -> Limits:
        """The limits of the runs of a combination."""
        return self.limits.varied({name: row[name] for name in self.limit_axes})

    def variant(self, row: Row) -> Variant:
        """The steps that change something; raises InvalidInput for a value the sensor cannot have."""
        settings = tuple([row[name] for name in self.step_axes])
        if settings not in self.variants:
            sensors = {sensor.name: sensor for sensor in self.dataset.sensors}
            variant: list[VariantStep] = []
            for step in self.steps:
                options: dict[str, Scalar] = {}
                for option, name in step.options.items():
                    value = row[name]
                    assert not isinstance(value, tuple)
                    options[option] = value
                names = [sensor.name for sensor in step.sensors]
                try:
                    variant += resolve_step(self.rules, step.declaration.kind, options, names, sensors)
                except SlamHiveError as error:
                    raise type(error)(
                        f"{step.declaration.blame}: step {step.declaration.name} on dataset {self.dataset.name}: "
                        f"{error.message}",
                        error.remedy,
                    ) from None
            if self.clip_s is not None and row[FIRST_LOOK] != WHOLE:
                options = {"begin_s": self.clip_s[0], "end_s": self.clip_s[1]}
                variant += resolve_step(self.rules, CLIP, options, list(sensors), sensors)
            self.variants[settings] = tuple(variant)
        return self.variants[settings]


class PairConfigurations:
    """Configurations of one pair with their content hashes; what many of them share is prepared once.

    Args:
        pair: The algorithm and the dataset.
    """

    def __init__(self, pair: ParameterPair) -> None:
        self._pair = pair
        self._defaults = default_values(pair.algorithm.parameters)
        axes = {name: axis for group in pair.groups for name, axis in group.axes.items()}
        varied = {key: name for name, key in pair.parameters.items()}
        self._contents: list[tuple[str, Mapping[Value, str], str]] = [
            (name, {value: parameter_content(key, value) for value in axes[name].values()}, "")
            if (name := varied.get(key, ""))
            else ("", {}, parameter_content(key, self._defaults[key]))
            for key in sorted({*self._defaults, *varied})
        ]
        self._names = (PLAYBACK_MODE, PLAYBACK_RATE, *pair.step_axes)
        self._alike: dict[tuple[Value, ...], tuple[Configuration, tuple[str, str]]] = {}

    def of(self, row: Row) -> tuple[Configuration, str]:
        """The configuration of a combination and its content hash; raises InvalidInput for an impossible playback."""
        key = tuple([row[name] for name in self._names])
        if key not in self._alike:
            self._alike[key] = self._first(row)
        first, around = self._alike[key]
        parameters = dict(self._defaults)
        for name, parameter in self._pair.parameters.items():
            parameters[parameter] = row[name]
        configuration = Configuration(
            algorithm=first.algorithm,
            dataset=first.dataset,
            parameters=parameters,
            playback=first.playback,
            variant=first.variant,
            sensors=first.sensors,
            version=first.version,
            map=first.map,
        )
        contents = [varied[row[name]] if name else default for name, varied, default in self._contents]
        return configuration, content_hash(around, ",".join(contents))

    def _first(self, row: Row) -> tuple[Configuration, tuple[str, str]]:
        """A configuration without parameters that is played in the way of ``row``, and its content around them."""
        pair = self._pair
        playback = Playback(PlaybackMode(str(row[PLAYBACK_MODE])), float(row[PLAYBACK_RATE]))  # type: ignore[arg-type]
        pair.algorithm.package.check_playback(playback)
        first = Configuration(
            algorithm=pair.algorithm.name,
            dataset=pair.dataset.name,
            parameters={},
            playback=playback,
            variant=pair.variant(row),
            sensors=pair.sensors,
            version=pair.algorithm.version,
            map=pair.map,
        )
        return first, first.content_around_parameters


Resolved = dict[tuple[object, ...], dict[tuple[Value, ...], Variant]]
"""Variants by option values, for each dataset and choice of sensors: algorithms share them."""


def bind(
    experiment: Experiment, view: CatalogueView, algorithm: Algorithm, dataset: Dataset, shared: Resolved
) -> ParameterPair:
    """The axes of ``experiment`` that apply to ``algorithm`` on ``dataset``; raises errors that name the place."""
    parameters: list[tuple[ExperimentAxis, Parameter]] = []
    taken: dict[str, ExperimentAxis] = {}
    for axis in experiment.parameters:
        if axis.algorithm not in (None, algorithm.name, algorithm.label):
            continue
        parameter = find_parameter(algorithm.parameters, axis.key)
        if parameter is None:
            continue
        if parameter.key in taken:
            raise InvalidInput(
                f"{axis.place}: {taken[parameter.key].name} and {axis.name} both set {parameter.key} of "
                f"{algorithm.name}",
                "keep one of them",
            )
        taken[parameter.key] = axis
        parameters.append((axis, parameter))
    chosen = _chosen(experiment, algorithm, dataset)
    try:
        assigned = algorithm.assign(dataset, chosen)
        check_known(algorithm, dataset, assigned, [parameter.key for _, parameter in parameters])
    except InvalidInput as error:
        raise at(experiment.datasets.place, error) from None
    steps = tuple(
        BoundStep(step, sensors, {axis.option: axis.name for axis in step.options})
        for step in experiment.steps
        if (sensors := _sensors(experiment, view, step, (algorithm, dataset, assigned)))
    )
    axes: dict[str, BoundAxis] = {}
    for step in steps:
        axes.update({axis.name: BoundAxis(axis.values, axis.place) for axis in step.declaration.options})
    for varied, parameter in parameters:
        axes[varied.name] = BoundAxis(varied.values, varied.place, parameter)
    axes.update({axis.name: BoundAxis(axis.values, axis.place) for axis in experiment.limit_axes})
    clip_s = _clip_s(experiment, view, dataset)
    if clip_s is not None and experiment.optimise is not None and experiment.optimise.first_look is not None:
        axes[FIRST_LOOK] = BoundAxis((WHOLE, experiment.optimise.first_look.words), experiment.optimise.place)
    modes = tuple(mode.value for mode in experiment.playback.modes)
    axes[PLAYBACK_MODE] = BoundAxis(modes, experiment.place)
    axes[PLAYBACK_RATE] = BoundAxis(experiment.playback.rates, experiment.place)
    # The other names that conditions may use: keys of parameters, and STEP.OPTION.
    aliases: dict[str, str] = {}
    for varied, parameter in parameters:
        aliases[parameter.key] = varied.name
        if parameter.general is not None:
            aliases[parameter.general] = varied.name
    for step in steps:
        aliases.update({f"{step.declaration.name}.{option}": name for option, name in step.options.items()})
    # A linked set takes the place of its first axis.
    groups: list[AxisGroup] = []
    done: set[str] = set()
    for name in axes:
        if name in done:
            continue
        link = next((link for link in experiment.links if name in link.axes), None)
        names = (name,) if link is None else tuple(entry for entry in link.axes if entry in axes)
        done.update(names)
        groups.append(AxisGroup({entry: axes[entry] for entry in names}))
    return ParameterPair(
        algorithm=algorithm,
        dataset=dataset,
        groups=tuple(groups),
        parameters={axis.name: parameter.key for axis, parameter in parameters},
        steps=steps,
        fixed=_fixed(algorithm, dataset),
        aliases={alias: name for alias, name in aliases.items() if alias != name},
        rules=view.steps,
        variants=shared.setdefault(_treatment(dataset, steps), {}),
        sensors=chosen,
        limits=experiment.limits,
        limit_axes=tuple(axis.name for axis in experiment.limit_axes),
        map=_map(experiment, view, algorithm),
        clip_s=clip_s,
    )


def _clip_s(experiment: Experiment, view: CatalogueView, dataset: Dataset) -> tuple[float, float] | None:
    """The times (s since 1970) between which first looks see the recording; None without first looks."""
    plan = experiment.optimise
    if plan is None or plan.first_look is None:
        return None
    if 2 * plan.first_look.seconds > dataset.duration_s:
        raise InvalidInput(
            f"{plan.place}: the {plan.first_look.words} are no first look at {dataset.name}, which takes "
            f"{dataset.duration_s:.4g} s",
            "take half of it at most, or leave out first_look",
        )
    try:
        begin_s = floor(view.begin_s(dataset) * 100) / 100
    except SlamHiveError as error:
        raise at(plan.place, error) from None
    return begin_s, begin_s + plan.first_look.seconds


def _map(experiment: Experiment, view: CatalogueView, algorithm: Algorithm) -> InputMap | None:
    if experiment.map is None:
        return None
    try:
        return view.find_map(experiment.map, algorithm)
    except SlamHiveError as error:
        raise at(experiment.place, error) from None


def _chosen(experiment: Experiment, algorithm: Algorithm, dataset: Dataset) -> Chosen:
    """The choice of sensors that applies to ``algorithm``; raises errors that name the place."""
    roles = {entry.role for entry in algorithm.inputs}
    choices = [choice for choice in experiment.sensors if choice.role in roles]
    if not choices:
        return BY_RULE
    try:
        return algorithm.stated_choice(dataset, {choice.role: choice.sensor for choice in choices})
    except SlamHiveError as error:
        raise at(choices[0].place, error) from None


def _treatment(dataset: Dataset, steps: Sequence[BoundStep]) -> tuple[object, ...]:
    treated = ((step.declaration.name, tuple(sensor.name for sensor in step.sensors)) for step in steps)
    return (dataset.name, *treated)


def _fixed(algorithm: Algorithm, dataset: Dataset) -> dict[str, Value]:
    fixed: dict[str, Value] = {"algorithm": algorithm.label, "dataset": dataset.name}
    defaults = default_values(algorithm.parameters)
    for parameter in algorithm.parameters:
        if parameter.key not in defaults:
            continue
        fixed[parameter.key] = defaults[parameter.key]
        if parameter.general is not None:
            fixed[parameter.general] = defaults[parameter.key]
    return fixed


def _sensors(
    experiment: Experiment,
    view: CatalogueView,
    step: StepDeclaration,
    pair: tuple[Algorithm, Dataset, Mapping[str, Sensor]],
) -> tuple[Sensor, ...]:
    """The sensors that a step treats on this dataset, each once and in the dataset's order."""
    algorithm, dataset, assigned = pair
    heard = {entry.kind for entry in algorithm.inputs}
    chosen: set[str] = set()
    for word in step.sensors:
        named = [sensor.name for sensor in dataset.sensors if word in (sensor.name, sensor.topic)]
        if word in _KINDS:
            kinds = heard.intersection(_KINDS[word])
            chosen.update(sensor.name for sensor in dataset.sensors if sensor.kind in kinds)
        elif word in assigned:
            chosen.add(assigned[word].name)
        elif named:
            chosen.update(named)
        elif word not in _roles(experiment, view):
            known = [*_KINDS, *_roles(experiment, view), *(sensor.name for sensor in dataset.sensors)]
            known += [sensor.topic for sensor in dataset.sensors]
            raise at(step.place, unknown(f"sensor or topic of dataset {dataset.name}", word, known))
    return tuple(sensor for sensor in dataset.sensors if sensor.name in chosen)


def _roles(experiment: Experiment, view: CatalogueView) -> set[str]:
    names = [str(name) for name in experiment.algorithms.values]
    return {entry.role for name in names for entry in view.algorithms[name].inputs}
