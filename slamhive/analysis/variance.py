"""Analysis of variance for balanced and unbalanced designs: the share of the variance that each factor explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy  # loads scipy.sparse when it is first used
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Codes = NDArray[np.intp]
Term = tuple[str, ...]
"""One factor, or two factors for their interaction."""

MOST_COLUMNS = 600
"""Levels of all terms in one model. A fit of more takes seconds, so pairs of weak factors are left out then."""

_RELATIVE_ZERO = 1e-10


@dataclass(frozen=True, slots=True)
class Effects:
    """Shares of the variance of one quantity, 0 to 1; None where the data do not determine a share.

    Attributes:
        names: The factors.
        main: Share of each factor, adjusted for all others.
        pairs: Share of each interaction: what two factors explain together beyond their own shares.
        shared: Share that several factors explain but that cannot be assigned to one; 0 for a balanced design.
        aliases: Factors that always vary together; each has the share of both.
        left_out: Number of interactions that are not in the model because there are too few values.
        count: Number of values.
    """

    names: tuple[str, ...]
    main: Mapping[str, float | None]
    pairs: Mapping[tuple[str, str], float | None]
    shared: float
    aliases: tuple[tuple[str, str], ...]
    left_out: int
    count: int


def explain_variance(codes: Mapping[str, Codes], values: Numbers) -> Effects:
    """Omega squared of every factor and of every interaction of two factors.

    One linear model contains all factors and interactions. The sum of squares of a term is what it adds to a model of
    all terms that do not contain it (type II: F. Yates, 1934; O. Langsrud, Statistics and Computing 13, 2003). For a
    balanced design these are the classical sums, which add up. Omega squared (W. L. Hays, 1963) subtracts what as many
    levels would explain by chance, estimated from the residual of the full model.

    Args:
        codes: The level of each value for each factor: (n,) integers from 0, without gaps.
        values: (n,) finite.
    """
    mains: list[Term] = [(name,) for name in codes]
    related = {pair: _nested(codes[pair[0]], codes[pair[1]]) for pair in combinations(codes, 2)}
    possible = [pair for pair, nested in related.items() if not nested]
    pairs = _affordable(_Design(codes, values, mains), possible)
    design = _Design(codes, values, [*mains, *pairs])
    full = design.fit(design.terms)
    noise = _mean_square(full, len(values))
    shares = {term: _share(design, term, noise) for term in design.terms}
    beyond = 0.0 if full.residual == 0 else None  # without a residual, other interactions explain nothing
    return Effects(
        names=tuple(codes),
        main={name: shares[name,] for name in codes},
        pairs={pair: shares.get(pair, beyond) for pair in possible},
        shared=_shared(design, full),
        aliases=tuple(pair for pair in related if _same(codes[pair[0]], codes[pair[1]])),
        left_out=0 if beyond is not None else len(possible) - len(pairs),
        count=len(values),
    )


@dataclass(frozen=True, slots=True)
class _Fit:
    """A least-squares fit: the residual sum of squares, and the rank of the model."""

    residual: float
    rank: int


class _Design:
    """Least-squares fits of one quantity by any of ``terms``; sets up the normal equations once."""

    def __init__(self, codes: Mapping[str, Codes], values: Numbers, terms: Sequence[Term]) -> None:
        self.terms = tuple(terms)
        self.count = len(values)
        centred = values - values.mean() if len(values) else values
        self.total = float(centred @ centred)
        self._joint = {term: _joint([codes[name] for name in term]) for term in terms}
        blocks = [_indicators(np.zeros(len(values), dtype=np.intp)), *map(_indicators, self._joint.values())]
        matrix = scipy.sparse.hstack(blocks, format="csr")
        ends = np.cumsum([block.shape[1] for block in blocks])
        self._columns = dict(zip(terms, map(np.arange, ends[:-1], ends[1:]), strict=True))
        self._gram = (matrix.T @ matrix).toarray()
        self._moments = matrix.T @ centred
        self._fits: dict[frozenset[Term], _Fit] = {}

    def levels(self, term: Term) -> int:
        """Number of levels of a term."""
        return len(self._columns[term])

    def others(self, term: Term) -> list[Term]:
        """The terms that ``term`` is adjusted for: those that do not determine it."""
        inner = self._joint[term]
        return [
            other
            for other in self.terms
            if other != term and not set(other) >= set(term) and not _determines(self._joint[other], inner)
        ]

    def fit(self, terms: Sequence[Term]) -> _Fit:
        """The fit of an intercept and ``terms``, which may be collinear."""
        key = frozenset(terms)
        if key not in self._fits:
            self._fits[key] = self._solve(terms)
        return self._fits[key]

    def _solve(self, terms: Sequence[Term]) -> _Fit:
        if self.total == 0:
            return _Fit(0.0, 1)
        columns = np.concatenate([[0], *(self._columns[term] for term in terms)]).astype(np.intp)
        weights, vectors = np.linalg.eigh(self._gram[np.ix_(columns, columns)])
        kept = weights > _RELATIVE_ZERO * weights[-1]
        along = vectors[:, kept].T @ self._moments[columns]
        residual = self.total - float((along**2 / weights[kept]).sum())
        return _Fit(residual if residual > _RELATIVE_ZERO * self.total else 0.0, int(kept.sum()))


def _share(design: _Design, term: Term, noise: float | None) -> float | None:
    """Omega squared of ``term``; None if other terms determine it, or without a residual to estimate chance."""
    if design.total == 0:
        return 0.0
    explained, freedom = _own(design, term)
    if freedom < 1 or noise is None:
        return None
    return min(1.0, max(0.0, (explained - freedom * noise) / (design.total + noise)))


def _own(design: _Design, term: Term) -> tuple[float, int]:
    """The sum of squares that ``term`` adds to :meth:`_Design.others`, and its degrees of freedom."""
    others = design.others(term)
    without, along = design.fit(others), design.fit([*others, term])
    return without.residual - along.residual, along.rank - without.rank


def _shared(design: _Design, full: _Fit) -> float:
    """What the full model explains beyond the sums of its terms; never below 0."""
    if design.total == 0:
        return 0.0
    own = sum(_own(design, term)[0] for term in design.terms)
    rest = (design.total - full.residual - own) / design.total
    return rest if rest > _RELATIVE_ZERO * len(design.terms) else 0.0


def _mean_square(full: _Fit, count: int) -> float | None:
    """The residual variance; None if the model has as many parameters as there are values."""
    if full.residual == 0:
        return 0.0
    freedom = count - full.rank
    return full.residual / freedom if freedom > 0 else None


def _affordable(design: _Design, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """The interactions to model: those of the strongest factors, as long as degrees of freedom remain."""
    left = {term[0]: design.fit([term]).residual for term in design.terms}
    columns = sum(map(design.levels, design.terms))
    rank = design.fit(design.terms).rank
    chosen = []
    for first, second in sorted(pairs, key=lambda pair: left[pair[0]] + left[pair[1]]):
        levels = design.levels((first,)), design.levels((second,))
        freedom = (levels[0] - 1) * (levels[1] - 1)
        if columns + levels[0] * levels[1] <= MOST_COLUMNS and rank + freedom < design.count:
            chosen.append((first, second))
            columns, rank = columns + levels[0] * levels[1], rank + freedom
    return chosen


def _joint(codes: Sequence[Codes]) -> Codes:
    """The joint levels of several factors, numbered from 0 without gaps."""
    joint = codes[0]
    for other in codes[1:]:
        joint = np.unique(joint * (int(other.max(initial=0)) + 1) + other, return_inverse=True)[1]
    return joint


def _indicators(codes: Codes) -> scipy.sparse.csr_array:
    """One column for each level, 1 where a value has that level."""
    return scipy.sparse.csr_array((np.ones(len(codes)), (np.arange(len(codes)), codes)))


def _nested(first: Codes, second: Codes) -> bool:
    """Whether one of two factors determines the other, so that they have no interaction."""
    return _determines(first, second) or _determines(second, first)


def _same(first: Codes, second: Codes) -> bool:
    return _determines(first, second) and _determines(second, first)


def _determines(outer: Codes, inner: Codes) -> bool:
    """Whether each level of ``outer`` implies one level of ``inner``."""
    said = np.zeros(int(outer.max(initial=-1)) + 1, dtype=inner.dtype)
    said[outer] = inner
    return bool((said[outer] == inner).all())
