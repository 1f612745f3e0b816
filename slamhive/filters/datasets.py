"""Filters over datasets: the language of run filters, with the names that a dataset has."""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from slamhive.base.errors import nearest
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import SensorSetup, setups_of
from slamhive.filters.binding import Condition, bind, matches, members_of
from slamhive.filters.fields import ATTRIBUTES, Field, FieldKind, Source, Vocabulary, attribute_field
from slamhive.filters.parser import parse_filter
from slamhive.filters.syntax import Junction, Sign, Tree

EXAMPLE = "write for instance indoor and sensor = stereo"

_FACTS: dict[str, tuple[Field, Callable[[Dataset], Any]]] = {
    entry.name: (entry, value)
    for entry, value in (
        (Field("dataset", "Dataset", FieldKind.TEXT, Source.CONFIGURATION), lambda dataset: dataset.name),
        (
            Field("duration", "Duration", FieldKind.NUMBER, Source.CONFIGURATION, "s"),
            lambda dataset: dataset.duration_s,
        ),
        (
            Field("groundtruth", "Ground truth", FieldKind.FLAG, Source.CONFIGURATION),
            lambda dataset: dataset.groundtruth is not None,
        ),
        (Field("recording", "Recording", FieldKind.FLAG, Source.CONFIGURATION), lambda dataset: bool(dataset.bag)),
    )
}
_COMPARE: dict[Sign, Callable[[Any, Sequence[Any]], bool]] = {
    Sign.EQUAL: lambda found, values: found == values[0],
    Sign.NOT_EQUAL: lambda found, values: found != values[0],
    Sign.LESS: lambda found, values: operator.lt(found, values[0]),
    Sign.AT_MOST: lambda found, values: operator.le(found, values[0]),
    Sign.MORE: lambda found, values: operator.gt(found, values[0]),
    Sign.AT_LEAST: lambda found, values: operator.ge(found, values[0]),
    Sign.BETWEEN: lambda found, values: values[0] <= found <= values[1],
    Sign.IN: lambda found, values: found in values,
    Sign.NOT_IN: lambda found, values: found not in values,
    Sign.LIKE: lambda found, values: matches(found, values[0]),
    Sign.UNLIKE: lambda found, values: not matches(found, values[0]),
    Sign.HAS: lambda _found, _values: True,
}


def attributes_of(datasets: Iterable[Dataset]) -> dict[str, tuple[str, ...]]:
    """{attribute: the names of the datasets that have it}."""
    found: dict[str, tuple[str, ...]] = {}
    for dataset in datasets:
        for word in dict.fromkeys(dataset.attributes):
            found[word] = (*found.get(word, ()), dataset.name)
    return found


def matching_datasets(text: str, datasets: Sequence[Dataset]) -> tuple[Dataset, ...]:
    """The datasets that the filter ``text`` describes, in their order; raises FilterError that points at the mistake.

    Names are ``dataset``, ``duration`` (s), ``groundtruth``, ``recording``, ``sensor`` (the set-ups that a dataset can
    serve), ``attribute`` and the properties of attributes. A word alone is an attribute.
    """
    setups: dict[str, tuple[str, ...]] = {setup.value: () for setup in SensorSetup}
    for dataset in datasets:
        for setup in setups_of(Counter(sensor.kind for sensor in dataset.sensors)):
            setups[setup.value] = (*setups[setup.value], dataset.name)
    vocabulary = _DatasetNames(setups, attributes_of(datasets))
    tree = bind(parse_filter(text, example=EXAMPLE), text, vocabulary).tree
    return tuple(dataset for dataset in datasets if tree is None or _fits(tree, dataset))


class _DatasetNames(Vocabulary):
    """The names of a filter over datasets."""

    def __init__(self, sensors: Mapping[str, tuple[str, ...]], attributes: Mapping[str, tuple[str, ...]]) -> None:
        super().__init__(sensors=sensors, attributes=attributes)

    def fields(self, name: str) -> tuple[Field, ...]:
        if name in _FACTS:
            return (_FACTS[name][0],)
        if name in ATTRIBUTES:
            return (attribute_field(ATTRIBUTES[name], self.attributes),)
        return super().fields(name) if name == "sensor" else ()

    def names(self) -> Sequence[str]:
        return ["sensor", *_FACTS, *ATTRIBUTES]

    def nearest(self, name: str) -> str:
        return nearest(name, list(self.names()))


def _fits(tree: Tree[Condition], dataset: Dataset) -> bool:
    if isinstance(tree, Junction):
        parts = (_fits(part, dataset) for part in tree.parts)
        return not next(parts) if tree.word == "not" else any(parts) if tree.word == "or" else all(parts)
    if tree.sign is Sign.MISSING:
        return not _fits(Condition(tree.field, Sign.HAS), dataset)
    if tree.field.name in _FACTS:
        return _COMPARE[tree.sign](_FACTS[tree.field.name][1](dataset), tree.values)
    return dataset.name in members_of(tree)
