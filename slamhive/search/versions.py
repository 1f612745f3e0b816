"""``algorithm = aloam@2`` in a filter: a name and the number of a version, as two comparisons."""

from __future__ import annotations

from dataclasses import replace

from slamhive.domain.versions import VERSION_SIGN, split_version
from slamhive.errors import InvalidInput
from slamhive.search.grammar import Junction, join
from slamhive.search.reader import FilterError
from slamhive.search.syntax import Comparison, Filter, Sign, Word

VERSIONED = ("algorithm", "package")
_ALLOWED = (Sign.EQUAL, Sign.NOT_EQUAL, Sign.IN, Sign.NOT_IN)


def with_versions(tree: Filter, source: str) -> Filter:
    """The filter with each ``NAME@NUMBER`` replaced by a comparison of ``version``.

    Raises FilterError, pointing into ``source``, for a version that is none.
    """
    if isinstance(tree, Junction):
        return Junction(tree.word, tuple(with_versions(part, source) for part in tree.parts))
    if tree.name.text not in VERSIONED or not any(VERSION_SIGN in value.text for value in tree.values):
        return tree
    if tree.sign not in _ALLOWED:
        remedy = f"use {' '.join(_ALLOWED)}"
        raise FilterError(f"{tree.sign} does not compare versions", remedy, source, tree.place)
    denied = tree.sign in (Sign.NOT_EQUAL, Sign.NOT_IN)
    return join("and" if denied else "or", [_one(tree, value, source, denied=denied) for value in tree.values])


def _one(leaf: Comparison, value: Word, source: str, *, denied: bool) -> Filter:
    """One value: its name and its version, if it has one. Denied, either of them differs."""
    try:
        name, number = split_version(value.text)
    except InvalidInput as error:
        raise FilterError(error.message, error.remedy or "", source, value.place) from None
    sign = Sign.NOT_EQUAL if denied else Sign.EQUAL
    named: Filter = replace(leaf, sign=sign, values=(replace(value, text=name),))
    if number is None:
        return named
    version = Comparison(Word("version", leaf.name.place), sign, (Word(str(number), value.place),), leaf.place)
    return join("or" if denied else "and", [named, version])
