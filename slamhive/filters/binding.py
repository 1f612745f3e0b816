"""Looks up names and values: a parsed filter becomes a typed one, or an error that points at the place."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from fnmatch import fnmatchcase
from typing import TypeAlias

from slamhive.base.errors import InvalidInput, nearest
from slamhive.domain.packages import VERSION_SIGN, split_version
from slamhive.filters.fields import OF_CONFIGURATIONS, Field, FieldKind, Source, Vocabulary, moments, number, units_of
from slamhive.filters.parser import nothing_compared, parse_filter
from slamhive.filters.syntax import (
    PRESENCE,
    Filter,
    FilterComparison,
    FilterError,
    FilterPlace,
    Junction,
    Sign,
    Tree,
    Word,
    all_of,
    filter_text,
    join,
    leaves,
    mapped,
    reversed_range,
)

# ``algorithm = aloam@2`` in a filter: a name and the number of a version, as two comparisons.


VERSIONED = ("algorithm", "package")
_EXACT = (Sign.EQUAL, Sign.NOT_EQUAL, Sign.IN, Sign.NOT_IN)


def with_versions(tree: Filter, source: str) -> Filter:
    """The filter with each ``NAME@NUMBER`` replaced by a comparison of ``version``.

    Raises FilterError, pointing into ``source``, for a version that is none.
    """
    if isinstance(tree, Junction):
        return Junction(tree.word, tuple(with_versions(part, source) for part in tree.parts))
    if tree.name.text not in VERSIONED or not any(VERSION_SIGN in value.text for value in tree.values):
        return tree
    if tree.sign not in _EXACT:
        remedy = f"use {' '.join(_EXACT)}"
        raise FilterError(f"{tree.sign} does not compare versions", remedy, source, tree.place)
    denied = tree.sign in (Sign.NOT_EQUAL, Sign.NOT_IN)
    return join("and" if denied else "or", [_one(tree, value, source, denied=denied) for value in tree.values])


def _one(leaf: FilterComparison, value: Word, source: str, *, denied: bool) -> Filter:
    """One value: its name and its version, if it has one. Denied, either of them differs."""
    try:
        name, number = split_version(value.text)
    except InvalidInput as error:
        raise FilterError(error.message, error.remedy or "", source, value.place) from None
    sign = Sign.NOT_EQUAL if denied else Sign.EQUAL
    named: Filter = replace(leaf, sign=sign, values=(replace(value, text=name),))
    if number is None:
        return named
    version = FilterComparison(Word("version", leaf.name.place), sign, (Word(str(number), value.place),), leaf.place)
    return join("or" if denied else "and", [named, version])


Value = int | float | str | bool | datetime
ME = "me"
"""As an owner: who asks."""
LONGEST_TEXT = 190
"""The longest text value that the store can search for."""

MOST_STARS = 4
"""The largest number in a pattern: matching time grows with the text length to the power of this number."""

_WHOLE = re.compile(r"[-+]?\d{1,18}", re.ASCII)
_FLAGS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
_ORDERED = (Sign.LESS, Sign.AT_MOST, Sign.MORE, Sign.AT_LEAST, Sign.BETWEEN)
_PATTERNS = (Sign.LIKE, Sign.UNLIKE)
_ALLOWED: dict[FieldKind, tuple[Sign, ...]] = {
    FieldKind.NUMBER: (*_EXACT, *_ORDERED),
    FieldKind.TIME: (Sign.EQUAL, Sign.NOT_EQUAL, *_ORDERED),
    FieldKind.TEXT: (*_EXACT, *_PATTERNS),
    FieldKind.CHOICE: (*_EXACT, *_PATTERNS),
    FieldKind.FLAG: (Sign.EQUAL, Sign.NOT_EQUAL),
}
_EXPECTED = {
    FieldKind.NUMBER: "a number such as 2000 or 1e-3",
    FieldKind.TIME: "a day such as 2026-01-31, or 2026-01-31T12:00 (UTC)",
    FieldKind.FLAG: "true or false",
}


@dataclass(frozen=True, slots=True)
class Condition:
    """A comparison with its field and typed values.

    Moments are written as half-open spans: ``created_at <= 2026-01-31`` has become ``created_at < 2026-02-01``.
    """

    field: Field
    sign: Sign
    values: tuple[Value, ...] = ()


Bound: TypeAlias = Tree[Condition]


@dataclass(frozen=True, slots=True)
class Search:
    """The runs of ``tree`` (None: all), and the protocol of the metrics (None: each run's current one)."""

    tree: Bound | None = None
    protocol: str | None = None
    text: str = ""

    @property
    def metrics(self) -> tuple[Field, ...]:
        """The compared metrics, each once."""
        found = [] if self.tree is None else [leaf.field for leaf in leaves(self.tree)]
        return tuple(dict.fromkeys(entry for entry in found if entry.source is Source.METRIC))


EVERYTHING = Search()


def read_search(text: str, vocabulary: Vocabulary) -> Search:
    """Parse a search; raises FilterError that points at the mistake."""
    return bind(parse_filter(text), text, vocabulary)


def bind(tree: Filter | None, source: str, vocabulary: Vocabulary) -> Search:
    """The typed form of a parsed filter; ``source`` is its text, for messages."""
    if tree is None:
        return EVERYTHING
    binder = _Binder(source, vocabulary)
    rest, protocol = binder.split_protocol(tree)
    bound = None if rest is None else mapped(with_versions(rest, source), binder.condition)
    return Search(bound, protocol, filter_text(tree))


class _Binder:
    def __init__(self, source: str, vocabulary: Vocabulary) -> None:
        self._source = source
        self._vocabulary = vocabulary

    def split_protocol(self, tree: Filter) -> tuple[Filter | None, str | None]:
        """Take ``protocol = X`` out of the outermost ``and``; refuse it anywhere else."""
        outermost = tree.parts if isinstance(tree, Junction) and tree.word == "and" else (tree,)
        chosen = [part for part in outermost if isinstance(part, FilterComparison) and part.name.text == "protocol"]
        rest = tuple(part for part in outermost if part not in chosen)
        nested = [leaf for part in rest for leaf in leaves(part) if leaf.name.text == "protocol"]
        if nested or len(chosen) > 1:
            raise self._refusal(
                "protocol is chosen for the whole filter", "write it once, joined by and", [*nested, *chosen][-1].place
            )
        if not chosen:
            return tree, None
        left = None if not rest else rest[0] if len(rest) == 1 else Junction("and", rest)
        return left, self._protocol(chosen[0])

    def condition(self, leaf: FilterComparison) -> Condition:
        """Bind one comparison to the first meaning of its name that fits."""
        meanings = self._vocabulary.fields(leaf.name.text)
        if not meanings:
            name = leaf.name.text
            raise self._refusal(f"unknown name {name[:80]!r}", self._vocabulary.nearest(name[:80]), leaf.name.place)
        if leaf.sign in PRESENCE:
            return Condition(meanings[0], leaf.sign)
        problems: list[FilterError] = []
        for meaning in meanings:
            try:
                return self._of(meaning, leaf)
            except FilterError as problem:
                problems.append(problem)
        raise problems[0]

    def _of(self, meaning: Field, leaf: FilterComparison) -> Condition:
        if leaf.sign not in _ALLOWED[meaning.kind]:
            signs = " ".join(_ALLOWED[meaning.kind])
            raise self._refusal(
                f"{meaning.name} is a {meaning.kind}, {leaf.sign} does not compare it", f"use {signs}", leaf.place
            )
        if meaning.kind is FieldKind.TIME:
            return self._time(meaning, leaf)
        if leaf.sign in _PATTERNS and leaf.values[0].text.count("*") > MOST_STARS:
            raise self._refusal("this pattern is too costly", f"use at most {MOST_STARS} stars", leaf.values[0].place)
        if meaning.kind is FieldKind.CHOICE and (meaning.choices or meaning.source is Source.ATTRIBUTE):
            return self._choice(meaning, leaf)
        readers: dict[FieldKind, Callable[[Field, Word], Value]] = {
            FieldKind.NUMBER: self._number,
            FieldKind.FLAG: self._flag,
            FieldKind.TEXT: self._text,
            FieldKind.CHOICE: self._text,
        }
        values = [readers[meaning.kind](meaning, word) for word in leaf.values]
        if leaf.sign is Sign.BETWEEN and values != sorted(values):
            raise reversed_range(leaf, self._source)
        return Condition(meaning, leaf.sign, tuple(values))

    def _number(self, meaning: Field, word: Word) -> int | float:
        """Columns of a run hold whole numbers, which must stay exact: seeds have 64 bits."""
        value = number(word.text, meaning.unit)
        if value is None:
            raise self._unfit(meaning, word)
        if meaning.source is Source.RUN and _WHOLE.fullmatch(word.text):
            return int(word.text)
        return value

    def _flag(self, meaning: Field, word: Word) -> bool:
        if word.text.lower() not in _FLAGS:
            raise self._unfit(meaning, word)
        return _FLAGS[word.text.lower()]

    def _text(self, meaning: Field, word: Word) -> str:
        if len(word.text) > LONGEST_TEXT or "\0" in word.text:
            raise self._refusal(
                f"{meaning.name} cannot be compared with this text",
                f"use at most {LONGEST_TEXT} characters",
                word.place,
            )
        if meaning.name == "owner" and word.text == ME:
            if not self._vocabulary.me:
                raise self._refusal("nobody has signed in here", "name the account: owner = NAME", word.place)
            return self._vocabulary.me
        return word.text

    def _choice(self, meaning: Field, leaf: FilterComparison) -> Condition:
        """Resolve patterns to a list of known values."""
        if leaf.sign in _PATTERNS:
            (word,) = leaf.values
            found = tuple(choice for choice in meaning.choices if matches(choice, word.text))
            return _chosen(meaning, Sign.IN if leaf.sign is Sign.LIKE else Sign.NOT_IN, found)
        for word in leaf.values:
            if word.text not in meaning.choices:
                if leaf.is_alone:
                    raise nothing_compared(self._source, leaf)
                remedy = nearest(word.text[:80], list(meaning.choices))
                raise self._refusal(f"{meaning.name} is never {word.text[:80]!r}", remedy, word.place)
        return _chosen(meaning, leaf.sign, tuple(str(word.text) for word in leaf.values))

    def _time(self, meaning: Field, leaf: FilterComparison) -> Condition:
        spans = []
        for word in leaf.values:
            span = moments(word.text)
            if span is None:
                raise self._unfit(meaning, word)
            spans.append(span)
        (begin, end), last = spans[0], spans[-1][1]
        if last <= begin:
            raise reversed_range(leaf, self._source)
        simple = {Sign.LESS: begin, Sign.AT_LEAST: begin, Sign.MORE: end, Sign.AT_MOST: end}
        if leaf.sign in simple:
            sign = Sign.LESS if leaf.sign in {Sign.LESS, Sign.AT_MOST} else Sign.AT_LEAST
            return Condition(meaning, sign, (simple[leaf.sign],))
        return Condition(meaning, Sign.NOT_EQUAL if leaf.sign is Sign.NOT_EQUAL else Sign.EQUAL, (begin, last))

    def _protocol(self, leaf: FilterComparison) -> str:
        if leaf.sign is not Sign.EQUAL:
            raise self._refusal("a protocol is chosen with =", "protocol = FINGERPRINT", leaf.place)
        text = leaf.values[0].text
        known = self._vocabulary.protocols
        by_label = [fingerprint for fingerprint, label in known.items() if text in {fingerprint, label}]
        if not by_label:
            raise self._refusal(
                f"no metric has been computed under protocol {text[:80]!r}",
                nearest(text[:80], list(known)),
                leaf.values[0].place,
            )
        return by_label[0]

    def _unfit(self, meaning: Field, word: Word) -> FilterError:
        units = ", ".join(units_of(meaning.unit))
        unit = f" in {meaning.unit} or with a unit ({units})" if meaning.kind is FieldKind.NUMBER and units else ""
        return self._refusal(
            f"{meaning.name} is a {meaning.kind}, {word.text[:80]!r} is none",
            f"write {_EXPECTED[meaning.kind]}{unit}",
            word.place,
        )

    def _refusal(self, message: str, remedy: str, place: FilterPlace) -> FilterError:
        return FilterError(message, remedy, self._source, place)


def _chosen(meaning: Field, sign: Sign, values: tuple[str, ...]) -> Condition:
    """A comparison with choices. Verdict and trust are compared by kinds, positively, since a run may have none."""
    if meaning.source not in (Source.VERDICT, Source.TRUST):
        return Condition(meaning, sign, values)
    known = dict.fromkeys(kind for kinds in meaning.groups.values() for kind in kinds)
    wanted = {kind for value in values for kind in meaning.groups[value]}
    denied = sign in {Sign.NOT_EQUAL, Sign.NOT_IN}
    return Condition(meaning, Sign.IN, tuple(kind for kind in known if (kind in wanted) is not denied))


def members_of(condition: Condition) -> set[str]:
    """The members of the groups of a field that fulfil a condition; those without a value fulfil none."""
    groups = condition.field.groups
    known = {name for members in groups.values() for name in members}
    if condition.sign is Sign.HAS:
        return known
    wanted = {name for value in condition.values for name in groups.get(str(value), ())}
    return known - wanted if condition.sign in {Sign.NOT_EQUAL, Sign.NOT_IN} else wanted


def matches(text: str, pattern: str) -> bool:
    """Tell if ``text`` matches ``pattern``: ``*`` stands for any text, ``?`` for one character."""
    return fnmatchcase(text, pattern.replace("[", "[[]"))


# Conditions on metrics where runs are grouped: they compare the mean of a configuration, and not single runs.
#
# A condition on single runs would leave only the runs that fulfil it, and the mean of those survivors would flatter
# every configuration that ever had one good run.


def split_means(search: Search) -> tuple[Bound | None, Bound | None]:
    """The conditions on runs, and those on the means of their configurations; None for none.

    Raises InvalidInput if ``or`` or ``not`` joins a metric with a condition on single runs.
    """
    tree = search.tree
    parts = tree.parts if isinstance(tree, Junction) and tree.word == "and" else () if tree is None else (tree,)
    of_means = [part for part in parts if any(leaf.field.source is Source.METRIC for leaf in leaves(part))]
    for leaf in (leaf for part in of_means for leaf in leaves(part)):
        if leaf.field.source is not Source.METRIC and leaf.field.source not in OF_CONFIGURATIONS:
            raise InvalidInput(
                f"grouped runs compare the mean of a metric, which 'or' and 'not' cannot join with {leaf.field.name}",
                f"join {leaf.field.name} with 'and', or do not group",
            )
    return all_of(part for part in parts if part not in of_means), all_of(mapped(part, _mean) for part in of_means)


def means_of(search: Search) -> Search:
    """The same search, with conditions on metrics as conditions on means, for words and messages."""
    return search if search.tree is None else replace(search, tree=mapped(search.tree, _mean))


def _mean(leaf: Condition) -> Condition:
    if leaf.field.source is not Source.METRIC:
        return leaf
    return replace(leaf, field=replace(leaf.field, label=f"mean {leaf.field.label}", source=Source.MEAN))
