"""An experiment as typed values, before it is bound to algorithms and datasets, and the candidates it compares."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any

from slamhive.base.errors import InvalidInput
from slamhive.base.strict_yaml import YamlPlace
from slamhive.documents.limits import OPTION_NAMES, Limits, StopWhen
from slamhive.domain.configuration import CLIP, PlaybackMode
from slamhive.domain.gate import Margin
from slamhive.domain.names import plain, plural
from slamhive.domain.parameters import Value
from slamhive.domain.protocol import Alignment, Protocol, ProtocolRequest, TrajectoryKind
from slamhive.domain.question import ExperimentQuestion, RunBudget, SearchSampler, time_words
from slamhive.experiments.condition import CombinationCondition


@dataclass(frozen=True, slots=True)
class ExperimentAxis:
    """One thing that takes several values (or a single one)."""

    name: str
    values: tuple[Value, ...]
    place: YamlPlace


@dataclass(frozen=True, slots=True)
class ParameterAxis(ExperimentAxis):
    """Values of an algorithm parameter, named by its key or its general name.

    With ``algorithm`` None it holds for every algorithm of the experiment that knows the name.
    """

    key: str
    algorithm: str | None = None


@dataclass(frozen=True, slots=True)
class StepOption(ExperimentAxis):
    """Values of one option of a step.

    The axis bears the name of the step if it is the only option that varies, ``<step>.<option>`` otherwise.
    """

    option: str


@dataclass(frozen=True, slots=True)
class StepDeclaration:
    """A pre-processing step under a name that the user chose; each option is an axis.

    ``sensors`` name sensor kinds (``camera``, ``image`` for cameras and depth cameras ...), roles of the algorithm
    (``left``), sensors or topics of the dataset.
    """

    name: str
    kind: str
    sensors: tuple[str, ...]
    options: tuple[StepOption, ...]
    place: YamlPlace

    @property
    def blame(self) -> YamlPlace:
        """The place to name when its options do not fit a sensor."""
        return self.options[0].place if len(self.options) == 1 else self.place


@dataclass(frozen=True, slots=True)
class Link:
    """Axes that change together, value by value. ``equal``: all have the same values (a tie)."""

    axes: tuple[str, ...]
    equal: bool
    place: YamlPlace


@dataclass(frozen=True, slots=True)
class Where:
    """A condition that a combination must meet, as it was written."""

    condition: CombinationCondition
    text: str
    place: YamlPlace


@dataclass(frozen=True, slots=True)
class SensorChoice:
    """The sensor for a role, in all algorithms that have it."""

    role: str
    sensor: str
    place: YamlPlace


@dataclass(frozen=True, slots=True)
class EvaluationChoice:
    """The evaluation that an experiment asks for.

    Attributes:
        enabled: False leaves them without errors.
        alignment: None for the one that follows from the sensors.
        trajectory: None for ``traj.txt``, whatever kind the algorithm says it is.
    """

    enabled: bool = True
    alignment: Alignment | None = None
    trajectory: TrajectoryKind | None = None

    def as_in(self, common: Protocol | None, planned: Iterable[Protocol]) -> dict[str, str]:
        """The entries of ``evaluate`` that give all runs the protocol ``common`` in place of those planned."""
        if common is None:
            return {}
        entries = {"alignment": self.alignment, "trajectory": self.trajectory}
        for name in entries:
            wanted = getattr(common, name)
            if any(getattr(protocol, name) != wanted for protocol in planned):
                entries[name] = wanted
        return {name: str(value) for name, value in entries.items() if value is not None}

    @property
    def request(self) -> ProtocolRequest | None:
        """The protocol that is asked for; None for the one that follows from the sensors."""
        asked = {"alignment": self.alignment, "trajectory": self.trajectory}
        values = {key: str(value) for key, value in asked.items() if value is not None}
        return ProtocolRequest(values) if values else None


@dataclass(frozen=True, slots=True)
class PlaybackAxes:
    """The way in which the recordings are fed; both may vary."""

    modes: tuple[PlaybackMode, ...] = (PlaybackMode.REALTIME,)
    rates: tuple[float, ...] = (1.0,)


@dataclass(frozen=True, slots=True)
class DecidePlan:
    """The question which candidate is best. A candidate is a combination of everything but the dataset.

    Attributes:
        metric: Its mean over the datasets is compared.
        difference: The largest difference that does not matter: in the metric's unit, or a share of the smaller mean.
        budget: Of all runs.
        error: The largest chance that the answer is false.
        worst: What a failed run counts as, in the metric's unit. None takes a value from the good runs.
    """

    metric: str
    difference: Margin
    budget: RunBudget
    place: YamlPlace
    error: float = 0.05
    worst: float | None = None


FAILED = "failed"
"""The share of failed runs, among objectives and limits."""


@dataclass(frozen=True, slots=True)
class MetricLimit:
    """A value of a metric that a run may have at most, or at least; in the metric's unit."""

    metric: str
    at_most: bool
    value: float

    def broken_by(self, value: float) -> bool:
        """Tell if a run with ``value`` breaks it."""
        return value > self.value if self.at_most else value < self.value


FIRST_LOOK = "first_look"
"""The axis whose values mark the cells that run on a clip: ``first 15 s``. Cells without it run on the whole."""


@dataclass(frozen=True, slots=True)
class FirstLook:
    """A run on the beginning of the recording, which only ranks: the best are run on the whole of it.

    Attributes:
        seconds: Length of the clip.
        keep: Share of the first looks that may run on the whole.
    """

    seconds: float
    keep: float

    @property
    def words(self) -> str:
        """``first 15 s``, the value of the axis."""
        return f"first {self.seconds:g} s"


@dataclass(frozen=True, slots=True)
class OptimisePlan:
    """The search for the best of many candidates. A candidate is a combination of everything but the dataset.

    Attributes:
        metric: Its typical value is to be the best.
        budget: Of all runs.
        limits: A run that breaks one counts as failed.
        against: What else is to be the best: metrics, and :data:`FAILED`. The best trade-offs are searched.
        failing: The largest share of failed runs that a candidate may have; None allows any.
        sampler: Whoever chooses the next runs.
        within: The search ends when the best one is so near to the truly best, as a share.
        confidence: Of that.
        worst: The value that a failed run counts as, in the metric's unit. None takes one from the good runs.
        first_look: The clips that candidates are looked at first; None runs the whole recording at once.
    """

    metric: str
    budget: RunBudget
    place: YamlPlace
    limits: tuple[MetricLimit, ...] = ()
    within: float = 0.05
    confidence: float = 0.95
    worst: float | None = None
    against: tuple[str, ...] = ()
    failing: float | None = None
    sampler: SearchSampler = SearchSampler.MODEL
    first_look: FirstLook | None = None

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics that are to be the best."""
        return (self.metric, *(key for key in self.against if key != FAILED))


@dataclass(frozen=True, slots=True)
class Experiment:
    """The content of an experiment file.

    ``repeat_disturbed``: how often a run is repeated at most because it was measured on a disturbed machine.
    ``same_cpu``: all runs are measured on one CPU model.
    The combinations are algorithms x datasets x steps x parameters x playback, each of them run with every seed,
    ``repeats`` times. ``algorithms`` and ``datasets`` are axes of names. ``map`` is the number or uid of the run whose
    map all runs start with. ``limits`` holds for all runs, except for those that ``limit_axes`` vary under the names of
    its fields. With ``decide`` or ``optimise`` it chooses itself which combinations run, and how often.
    """

    name: str
    algorithms: ExperimentAxis
    datasets: ExperimentAxis
    place: YamlPlace
    description: str = ""
    parameters: tuple[ParameterAxis, ...] = ()
    steps: tuple[StepDeclaration, ...] = ()
    links: tuple[Link, ...] = ()
    where: tuple[Where, ...] = ()
    seeds: tuple[int, ...] = (0,)
    repeats: int = 1
    playback: PlaybackAxes = field(default_factory=PlaybackAxes)
    stop_when: StopWhen = field(default_factory=StopWhen)
    limits: Limits = field(default_factory=Limits)
    limit_axes: tuple[ExperimentAxis, ...] = ()
    evaluation: EvaluationChoice = field(default_factory=EvaluationChoice)
    executor: str | None = None
    priority: int = 0
    repeat_disturbed: int = 0
    same_cpu: bool = True
    sensors: tuple[SensorChoice, ...] = ()
    map: str | None = None
    decide: DecidePlan | None = None
    optimise: OptimisePlan | None = None

    @property
    def question(self) -> ExperimentQuestion | None:
        """The kind of its question, if it chooses its runs itself."""
        if self.decide is not None:
            return ExperimentQuestion.DECIDE
        return None if self.optimise is None else ExperimentQuestion.OPTIMISE

    @property
    def plan(self) -> DecidePlan | OptimisePlan | None:
        """The plan for its question."""
        return self.decide or self.optimise

    @property
    def question_metrics(self) -> tuple[str, ...]:
        """The metrics that its question is about."""
        if self.optimise is not None:
            limits = (limit.metric for limit in self.optimise.limits)
            return tuple(dict.fromkeys((*self.optimise.metrics, *limits)))
        return () if self.decide is None else (self.decide.metric,)

    @property
    def options(self) -> dict[str, Any]:
        """The options of its runs by name."""
        stated = {name: value for name in OPTION_NAMES if (value := getattr(self, name, None)) is not None}
        return {**asdict(self.limits), **stated, "evaluate": self.evaluation.enabled}

    @property
    def every_limit(self) -> Iterator[Limits]:
        """The limits of its runs, each axis varied by itself."""
        yield from (self.limits.varied({axis.name: value}) for axis in self.limit_axes for value in axis.values)
        if not self.limit_axes:
            yield self.limits

    @property
    def content_hash(self) -> str:
        """SHA-256 over what is stated: places and comments in the file do not count, the order of axes does."""
        return _hash(_content(self))

    def has_hash(self, content_hash: str) -> bool:
        """Tell if ``content_hash`` was taken of the same content, now or when files were read as YAML 1.1."""
        return content_hash in {self.content_hash, _hash(_content(self, yaml_1_1=True))}


_FIRST_LIMITS = ("cpu_cores", "memory_mb", "timeout_s")
_LATER: tuple[tuple[str, object], ...] = (
    ("repeat_disturbed", 0),
    ("same_cpu", True),
    ("sensors", ()),
    ("map", None),
    ("limit_axes", ()),
    ("trajectory", None),
    ("decide", None),
    ("optimise", None),
    ("against", ()),
    ("failing", None),
    ("sampler", SearchSampler.MODEL),
    ("first_look", None),
    *((option.name, option.default) for option in fields(Limits) if option.name not in _FIRST_LIMITS),
)
"""Fields that came later, at their defaults: experiments that were stored before keep their hash."""


_TRUTH_IN_YAML_1_1 = {"yes": True, "on": True, "no": False, "off": False}


def _hash(content: object) -> str:
    return hashlib.sha256(json.dumps(content, allow_nan=False).encode()).hexdigest()


def _content(value: object, *, yaml_1_1: bool = False) -> object:
    """``value`` as JSON without the places; numbers keep their type, since 1 and 1.0 are two values.

    With ``yaml_1_1`` the values of axes are those that an experiment stored by an earlier version had.
    """
    if isinstance(value, Where):
        return value.text
    if yaml_1_1 and isinstance(value, ExperimentAxis):
        values = tuple(_TRUTH_IN_YAML_1_1.get(str(entry).lower(), entry) for entry in value.values)
        return _content(replace(value, values=values))
    if is_dataclass(value):
        parts = ((entry.name, getattr(value, entry.name)) for entry in fields(value))
        parts = ((name, part) for name, part in parts if (name, part) not in _LATER)
        return {name: _content(part, yaml_1_1=yaml_1_1) for name, part in parts if not isinstance(part, YamlPlace)}
    if isinstance(value, tuple):
        return [_content(part, yaml_1_1=yaml_1_1) for part in value]
    return value if value is None else [type(value).__name__, str(value)]


# The candidates of an experiment that chooses its runs: what is compared, on every dataset alike.


DATASET = "dataset"
ALGORITHM = "algorithm"
LEAST_SEARCH_RUNS = 24
"""A search makes so many runs at random places before it can say anything of the others."""


@dataclass(frozen=True, slots=True)
class ExperimentCandidate:
    """A combination of everything but the dataset; ``cells``: {dataset: number of its cell}.

    ``looks`` are the cells of its first looks.
    """

    values: Mapping[str, Value]
    cells: Mapping[str, int]
    label: str
    looks: Mapping[str, int] = field(default_factory=dict)


def candidates_of(cells: Iterable[tuple[int, Mapping[str, Value]]]) -> tuple[ExperimentCandidate, ...]:
    """The candidates among cells, given as numbers and the values of their axes, in the order of their first cells."""
    found: dict[tuple[tuple[str, Value], ...], dict[str, int]] = {}
    looks: dict[tuple[tuple[str, Value], ...], dict[str, int]] = {}
    for number, values in cells:
        key = tuple((axis, value) for axis, value in values.items() if axis not in (DATASET, FIRST_LOOK))
        (looks if FIRST_LOOK in values else found).setdefault(key, {})[str(values[DATASET])] = number
    seen: dict[str, set[Value]] = {}
    for key in found:
        for axis, value in key:
            seen.setdefault(axis, set()).add(value)
    told = [axis for axis, values in seen.items() if len(values) > 1] or [ALGORITHM]
    return tuple(
        ExperimentCandidate(dict(key), places, _label(dict(key), told), looks.get(key, {}))
        for key, places in found.items()
    )


def check_candidates(
    experiment: Experiment, candidates: Iterable[ExperimentCandidate], recordings_s: Mapping[str, float]
) -> None:
    """Raise InvalidInput, naming the place, unless the plan of ``experiment`` can be followed with these candidates.

    ``recordings_s``: how long the recordings take, by dataset.
    """
    plan = experiment.plan
    if plan is None:
        return
    found = list(candidates)
    datasets = {dataset: None for candidate in found for dataset in candidate.cells}
    for candidate in found:
        lacking = [dataset for dataset in datasets if dataset not in candidate.cells]
        if lacking:
            raise InvalidInput(
                f"{plan.place}: {candidate.label} does not run on {', '.join(lacking)}, where others do",
                "loosen where, so that all candidates run on all datasets",
            )
    if len(found) < 2:
        raise InvalidInput(
            f"{plan.place}: there is nothing to choose: {found[0].label} is the only candidate",
            "give two algorithms, or two values of a parameter or step",
        )
    least, each = 2 * len(found) * len(datasets), "2 runs of each"
    if experiment.optimise is not None:
        least, each = min(LEAST_SEARCH_RUNS, len(found)), "the first runs"
    too_small = (
        f"{plan.place}: the budget of {plan.budget.words} is too small for one look: {each} of {len(found)} candidates "
        f"on {plural(len(datasets), 'dataset')}"
    )
    remedy = "raise it, or compare fewer"
    if plan.budget.runs is not None and plan.budget.runs < least:
        raise InvalidInput(f"{too_small} are {least}", remedy)
    # Where recordings are played in real time and as a whole, a run that does not fail takes as long.
    played = experiment.playback.modes == (PlaybackMode.REALTIME,) and experiment.stop_when == StopWhen()
    clipped = any(step.kind == CLIP for step in experiment.steps)
    if plan.budget.time_s is None or clipped or not played:
        return
    fastest = max(experiment.playback.rates)
    of_one_s = [recordings_s[dataset] / fastest for dataset in datasets]
    least_s = 2 * len(found) * sum(of_one_s)
    if experiment.optimise is not None:
        first_look = experiment.optimise.first_look
        if first_look is None:
            least_s = least * min(of_one_s)
        else:  # at least two of the first looks are followed by runs on the whole
            least_s = min(least, 2 / first_look.keep) * min(first_look.seconds / fastest, *of_one_s)
    if plan.budget.time_s < least_s:
        raise InvalidInput(f"{too_small} take {time_words(least_s)} or more", remedy)


def _label(values: Mapping[str, Value], told: Iterable[str]) -> str:
    parts = []
    for axis in told:
        if axis in values:
            value = values[axis]
            text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
            text = plain(value) if isinstance(value, float) else text
            parts.append(text if axis == ALGORITHM else f"{axis} {text}")
    return ", ".join(parts)
