"""Results of an experiment: the ranking of its configurations on each dataset, and the report as CSV."""

from __future__ import annotations

import csv
import io
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from slamhive.domain.parameters import Value
from slamhive.domain.verdict import Outcome
from slamhive.experiments.experiment import FIRST_LOOK
from slamhive.services.experiments.progress import METRICS, AxisTable, CellCounts
from slamhive.services.experiments.views import Cell, CellFigures
from slamhive.store import RunRecord, Transaction
from slamhive.store.experiments import CellSample
from slamhive.store.records import CellRecord, ExperimentRecord, ProtocolLabel

RANKED_BY = "ate.rmse"
SIGNIFICANCE = 0.05
MOST_SEARCHED = 400
"""Repeats that are searched for the number that would decide."""
BEST, WORST = 8, 4
"""So many configurations of each dataset are shown, if there are more than both together."""
MOST_DATASETS = 12
MOST_RUNS = 100
"""The latest of a configuration that are shown."""


@dataclass(frozen=True, slots=True)
class RankedCell:
    """A configuration. ``place`` is None with fewer than two good runs.

    ``runs`` are those that succeeded or failed and were not replaced by another run; ``failed`` of them failed. Lost
    and cancelled runs say nothing of their configuration and count nowhere. ``good`` have a value under the protocol of
    the ranking; None if it has none. ``other`` are then good runs under another protocol, or with another kind of
    trajectory.
    """

    place: int | None
    cell: CellRecord
    good: CellSample | None
    failed: int
    total: int
    runs: tuple[RunRecord, ...]
    other: CellSample | None = None


@dataclass(frozen=True, slots=True)
class Ranking:
    """The configurations on one dataset.

    ``protocol`` is that of the most good runs; ``other_runs`` good runs have another one. If there are any, no
    configuration has a place: their errors are not comparable. Between ``best`` and ``worst``, ``between``
    configurations are left out. Of ``waiting``, no run has been evaluated or has failed. ``without`` have been
    evaluated, without a value.
    """

    dataset: str
    protocol: ProtocolLabel | None
    best: tuple[RankedCell, ...]
    worst: tuple[RankedCell, ...]
    between: int
    waiting: int
    other_runs: int
    without: int = 0


@dataclass(frozen=True, slots=True)
class RankEntry:
    """A configuration by number: its good runs under the protocol of the ranking, and failed ones.

    ``other``: good runs under another protocol, where there are none under that of the ranking.
    """

    number: int
    good: CellSample | None
    failed: int
    total: int
    other: CellSample | None = None

    @property
    def ranked(self) -> bool:
        """True if it has the two good runs that a place needs."""
        return self.good is not None and self.good.n > 1

    @property
    def key(self) -> tuple[int, int, float, int]:
        """Configurations with a place come first, then those with one good run, of another protocol, and with none."""
        if self.good is None:
            return int(self.other is None), self.failed, 0.0, self.number
        return -min(self.good.n, 2), self.failed, self.good.mean, self.number


@dataclass(frozen=True, slots=True)
class RankEntries:
    """The configurations on one dataset, as :class:`Ranking`: ``ended`` in order, the numbers of ``waiting`` ones.

    ``without`` are the numbers of those that were evaluated without a value; they are among those that wait.
    """

    protocol: ProtocolLabel | None
    other_runs: int
    ended: list[RankEntry]
    waiting: list[int]
    without: frozenset[int] = frozenset()


def rankings(
    t: Transaction,
    record: ExperimentRecord,
    table: AxisTable,
    entries: Mapping[str, RankEntries],
    *,
    by_algorithm: bool,
) -> tuple[Ranking, ...]:
    """Rank the configurations, the best first, on each of the first datasets on which a run has ended.

    ``entries`` are those of :func:`entries_by_dataset`. With ``by_algorithm``, only the first configuration of each
    algorithm has a place.
    """
    if by_algorithm:
        algorithms = dict(zip(table.numbers.tolist(), table.codes["algorithm"].tolist(), strict=True))
        first: dict[str, RankEntries] = {}
        for name, known in entries.items():
            ended = {algorithms[entry.number]: entry for entry in reversed(known.ended)}
            waiting = {algorithms[number]: number for number in known.waiting if algorithms[number] not in ended}
            ranked = sorted(ended.values(), key=lambda entry: entry.key)
            first[name] = replace(known, ended=ranked, waiting=list(waiting.values()))
        entries = first
    found = (_ranking(t, record.id, name, entries[name]) for name in list(entries)[:MOST_DATASETS])
    return tuple(ranking for ranking in found if ranking is not None)


def entries_by_dataset(t: Transaction, record: ExperimentRecord, table: AxisTable) -> dict[str, RankEntries]:
    """The configurations on each dataset, without their runs and without first looks at clips."""
    codes = table.codes.get("dataset")
    if codes is None:
        return {}
    if FIRST_LOOK in table.codes:
        whole = table.values[FIRST_LOOK].index(None)
        codes = codes.copy()
        codes[table.codes[FIRST_LOOK] != whole] = -1
    samples: dict[int, list[CellSample]] = defaultdict(list)
    for sample in t.experiment_values.samples(record.id, RANKED_BY):
        samples[sample.cell].append(sample)
    counts = t.experiment_counts.by_cell(record.id)
    return {
        str(name): _entries(table.numbers[codes == code].tolist(), samples, counts)
        for code, name in enumerate(table.values["dataset"])
    }


def _entries(numbers: Sequence[int], samples: Mapping[int, Sequence[CellSample]], counts: CellCounts) -> RankEntries:
    weights: Counter[ProtocolLabel] = Counter()
    for number in numbers:
        for sample in samples.get(number, ()):
            weights[sample.protocol] += sample.n
    protocol = weights.most_common(1)[0][0] if weights else None
    entries = []
    evaluated: set[int] = set()
    for number in numbers:
        good = next((sample for sample in samples.get(number, ()) if sample.protocol == protocol), None)
        phases: Counter[Outcome] = Counter()
        for entry in counts.get(number, ()):
            if not entry.retried:
                phases[Outcome.of(entry)] += entry.count
        entries.append(
            RankEntry(
                number,
                good,
                phases[Outcome.FAILED],
                phases.total() - phases[Outcome.LOST] - phases[Outcome.CANCELLED],
                next(iter(samples.get(number, ())), None) if good is None else None,
            )
        )
        if phases[Outcome.GOOD]:
            evaluated.add(number)
    ended = [entry for entry in entries if entry.good is not None or entry.other is not None or entry.failed]
    waiting = [entry.number for entry in entries if entry not in ended]
    others = weights.total() - (weights[protocol] if protocol else 0)
    without = frozenset(evaluated.intersection(waiting))
    return RankEntries(protocol, others, sorted(ended, key=lambda entry: entry.key), waiting, without)


def _ranking(t: Transaction, experiment_id: int, dataset: str, entries: RankEntries) -> Ranking | None:
    if not entries.ended:
        return None
    order, places = (entries.ended, {}) if entries.other_runs else placed(entries.ended)
    few = len(order) <= BEST + WORST
    shown = order if few else [*order[:BEST], *order[-WORST:]]
    numbers = [entry.number for entry in shown]
    cells = t.experiments.cells_numbered(experiment_id, numbers)
    runs = t.experiment_values.judged_runs(experiment_id, numbers, MOST_RUNS)
    records = {
        run.id: run for run in t.runs.get_many([run for found in runs.values() for run in found], with_metrics=True)
    }
    ranked = tuple(
        RankedCell(
            places.get(entry.number),
            cells[entry.number],
            entry.good,
            entry.failed,
            entry.total,
            tuple(records[run] for run in runs.get(entry.number, ())),
            entry.other,
        )
        for entry in shown
    )
    best, worst = (ranked, ()) if few else (ranked[:BEST], ranked[BEST:])
    between = len(order) - len(shown)
    without = len(entries.without.intersection(entries.waiting))
    waiting = len(entries.waiting) - without
    return Ranking(dataset, entries.protocol, best, worst, between, waiting, entries.other_runs, without)


@dataclass(frozen=True, slots=True)
class SeparationTest:
    """A configuration against one behind it in the order: by failures if their shares differ, otherwise by the means.

    Places and the sentence of the answer follow from it alike.

    Attributes:
        separated: The other is worse by more than chance.
        by_failures: The p value is that of the shares of failed runs.
        p_value: Of Fisher's test of the shares, or of Welch's test of the means.
        repeats_to_decide: Further runs of each that would separate them as they are now; None if none would.
    """

    separated: bool
    by_failures: bool
    p_value: float
    repeats_to_decide: int | None

    @classmethod
    def of(cls, first: RankEntry, other: RankEntry) -> SeparationTest:
        """Test ``first`` against ``other``; two entries with good runs need two of them each."""
        from slamhive.analysis.statistics import compare_samples, shares_p_value  # noqa: PLC0415 - loads scipy

        failures = (first.failed, first.total), (other.failed, other.total)
        p_failures = shares_p_value(*failures)
        if p_failures < SIGNIFICANCE or first.good is None or other.good is None:
            more = None if p_failures < SIGNIFICANCE else _repeats_for_shares(*failures)
            return cls(p_failures < SIGNIFICANCE, True, p_failures, more)
        means = compare_samples(
            (first.good.n, first.good.mean, first.good.variance), (other.good.n, other.good.mean, other.good.variance)
        )
        ahead = means.difference < 0
        if means.decided and ahead:
            return cls(True, False, means.p_value, None)
        by_failures = means.decided or not ahead
        # The other is not worse where it succeeds: only its failures can decide.
        counts = [] if by_failures and first.failed != other.failed else [means.repeats_to_decide]
        least = min(first.good.n, other.good.n)
        needed = [max(1, count - least) for count in counts if count is not None]
        if first.failed != other.failed and (found := _repeats_for_shares(*failures)) is not None:
            needed.append(found)
        p_value = p_failures if not counts else means.p_value
        return cls(False, not counts, p_value, min(needed, default=None))


def _repeats_for_shares(first: tuple[int, int], second: tuple[int, int]) -> int | None:
    """Further runs of each with which Fisher's test would tell the present shares apart; None if too many."""
    from slamhive.analysis.statistics import shares_p_value  # noqa: PLC0415 - loads scipy

    if first[0] * second[1] == second[0] * first[1]:
        return None
    for more in range(1, MOST_SEARCHED):
        counts = [(round(hits * (total + more) / total), total + more) for hits, total in (first, second)]
        if shares_p_value(counts[0], counts[1]) < SIGNIFICANCE:
            return more
    return None


def placed(order: Sequence[RankEntry]) -> tuple[list[RankEntry], dict[int, int | None]]:
    """The entries by place, and {number: place}; equal places by the order, None without two good runs.

    An entry shares the first place if no test separates it from the first, as the answer says. Behind it, each
    is compared with the first of the place before it, as in challenges.
    """
    ranked = [entry for entry in order if entry.ranked]
    shared: list[list[RankEntry]] = []
    for entry in ranked:
        heads = dict.fromkeys((0, len(shared) - 1)) if shared else ()
        home = next((at for at in heads if not SeparationTest.of(shared[at][0], entry).separated), None)
        if home is None:
            shared.append([entry])
        else:
            shared[home].append(entry)
    places: dict[int, int | None] = {entry.number: None for entry in order}
    sorted_entries: list[RankEntry] = []
    for members in shared:
        places.update(dict.fromkeys((entry.number for entry in members), len(sorted_entries) + 1))
        sorted_entries += members
    return [*sorted_entries, *(entry for entry in order if not entry.ranked)], places


NO_FIGURES = CellFigures(None, 0, 0, {})
_HEAD = ("cell", "name")
_COUNTS = ("runs", "good", "failed", "failures", "protocol", "evaluated", "disturbed")


def csv_text(cells: Iterable[Cell], axes: Sequence[str]) -> str:
    """The whole report as CSV: exact values in stored units, missing values empty."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    figures = [column for key in METRICS for column in (f"{key}.mean", f"{key}.std", f"{key}.n", f"{key}.median")]
    writer.writerow([*_HEAD, *axes, *_COUNTS, *figures])
    for cell in cells:
        for row in csv_rows(cell, axes):
            writer.writerow(row)
    return stream.getvalue()


def csv_rows(cell: Cell, axes: Sequence[str]) -> Iterator[list[Any]]:
    """One row for each protocol under which runs of the cell were evaluated."""
    for figures in cell.figures or (NO_FIGURES,):
        row: list[Any] = [cell.number, cell.name, *(_text(cell.values.get(axis)) for axis in axes)]
        row += [len(cell.runs), cell.counts[Outcome.GOOD], sum(cell.failures.values()), failures_text(cell)]
        row += [figures.protocol, figures.runs, figures.disturbed]
        for key in METRICS:
            found = figures.metrics.get(key)
            row += [None, None, 0, None] if found is None else [found.mean, found.std, found.n, found.median]
        yield row


def failures_text(cell: Cell) -> str | None:
    """``timeout 2, lost 1``, None without failures."""
    return ", ".join(f"{reason.value} {count}" for reason, count in cell.failures.items()) or None


def varying(axes: dict[str, tuple[Value, ...]]) -> list[str]:
    """The axes with more than one value."""
    return [axis for axis, values in axes.items() if len(values) > 1]


def _text(value: Value | None) -> Any:
    return " ".join(map(str, value)) if isinstance(value, tuple) else value
