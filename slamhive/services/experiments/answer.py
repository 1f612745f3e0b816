"""The answer of an experiment in a sentence: who is best, whether a test separates it from the others, what would.

On one dataset, algorithms are compared, each by its first configuration in the ranking. An experiment with a single
algorithm compares its configurations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from slamhive.documents.experiment import Certainty, DatasetAnswerDocument, ExperimentAnswerDocument
from slamhive.domain.names import mean_and_std, plural
from slamhive.domain.parameters import Value
from slamhive.experiments.experiment import FIRST_LOOK
from slamhive.services.experiments.ranking import RankEntries, RankEntry, SeparationTest
from slamhive.store.records import ExperimentRecord

if TYPE_CHECKING:
    from slamhive.services.experiments.progress import AxisTable

MOST_NAMED = 3
MOST_SUGGESTED = 100
"""More repeats than this are named but not offered: the difference is too small to matter."""
REPEATS_WANTED = 3
"""So many runs of each are asked for where there are fewer than two, which no test can judge."""


def answer(record: ExperimentRecord, table: AxisTable, entries: Mapping[str, RankEntries]) -> ExperimentAnswerDocument:
    """The answer of an experiment; ``entries`` are those of :func:`~ranking.entries_by_dataset`.

    One that chooses its runs gives its own conclusion as soon as it has one.
    """
    axes = table.axes
    by = "algorithm" if len(axes.get("algorithm", ())) > 1 else "configuration"
    names = _names(table, by)
    found = tuple(answer_on(dataset, known, names) for dataset, known in entries.items())
    # The certainty of all datasets together.
    known = {entry.certainty for entry in found}
    order = (Certainty.TOO_FEW, Certainty.NOT_SEPARATED, Certainty.OPEN, Certainty.SEPARATED, Certainty.ALONE)
    return ExperimentAnswerDocument(
        question=question(record.description, axes),
        sentence=record.conclusion or _over_all(found),
        certainty=next((certainty for certainty in order if certainty in known), Certainty.OPEN),
        more_repeats=None if record.question is not None else _suggested(found),
        by=by,
        datasets=found,
        notes=tuple(_notes(entries, names)),
    )


def question(description: str, axes: Mapping[str, Sequence[Value]]) -> str:
    """The sentence of the description that ends in a question mark; otherwise one made from {axis: values}."""
    asked = description.partition("?")
    if asked[1]:
        return asked[0].replace("\n", " ").rpartition(". ")[2].strip() + "?"
    algorithms, datasets = ([str(value) for value in axes.get(name, ())] for name in ("algorithm", "dataset"))
    where = f" on {datasets[0]}" if len(datasets) == 1 else f" on {len(datasets)} datasets" if datasets else ""
    varied = [
        axis for axis, values in axes.items() if len(values) > 1 and axis not in ("algorithm", "dataset", FIRST_LOOK)
    ]
    if len(algorithms) > 1:
        few = len(algorithms) <= MOST_NAMED
        which = f"of {_listed(algorithms)}" if few else f"of {len(algorithms)} algorithms"
        return f"Which {which} is most accurate{where}?"
    name = algorithms[0] if algorithms else "the algorithm"
    if varied:
        return f"Which {_listed(varied[:MOST_NAMED])} suits {name} best{where}?"
    return f"How accurate is {name}{where}?"


def _names(table: AxisTable, by: str) -> dict[int, str]:
    """{cell: its algorithm, or the values that distinguish its configuration}."""
    axes = ["algorithm"] if by == "algorithm" else [*table.axes]
    axes = [
        axis
        for axis in axes
        if axis not in ("dataset", FIRST_LOOK) and (by == "algorithm" or len(table.values[axis]) > 1)
    ]
    texts = {}
    for place, number in enumerate(table.numbers.tolist()):
        values = {axis: table.values[axis][int(table.codes[axis][place])] for axis in axes}
        parts = [
            _plain(value) if axis == "algorithm" else f"{axis} {_plain(value)}"
            for axis, value in values.items()
            if value is not None
        ]
        texts[number] = ", ".join(parts) or _plain(table.values["algorithm"][int(table.codes["algorithm"][place])])
    return texts


def answer_on(dataset: str, entries: RankEntries, names: Mapping[int, str]) -> DatasetAnswerDocument:
    """The answer on one dataset. ``names``: {cell: what it is compared as}; the first cell of a name stands for it."""
    competitors = _competitors(entries, names)
    waiting = list(dict.fromkeys(name for number in entries.waiting if (name := names[number]) not in competitors))
    if entries.other_runs:
        text = "No answer: errors under several protocols, or of live and final trajectories, are not comparable."
        return DatasetAnswerDocument(
            dataset=dataset, certainty=Certainty.OPEN, leaders=(), p_value=None, more_repeats=None, sentence=text
        )
    good = {name: entry for name, entry in competitors.items() if entry.good is not None}
    if not good:
        failed = sum(entry.failed for entry in entries.ended)
        text = f"No run gave a result: {plural(failed, 'run')} failed." if failed else "No run has been evaluated yet."
        return DatasetAnswerDocument(
            dataset=dataset, certainty=Certainty.OPEN, leaders=(), p_value=None, more_repeats=None, sentence=text
        )
    leader, first = next(iter(good.items()))
    if len(competitors) == 1:
        certainty = Certainty.OPEN if waiting else Certainty.ALONE
        other = f"{_listed(waiting)} has no result yet" if waiting else "there is nothing to compare it with"
        return DatasetAnswerDocument(
            dataset=dataset,
            certainty=certainty,
            leaders=(leader,),
            p_value=None,
            more_repeats=None,
            sentence=f"{leader}: ATE {_spread(first)}; {other}.",
        )
    single = [name for name, entry in good.items() if not entry.ranked]
    if not first.ranked or (single and len(good) - len(single) == 1):
        more = REPEATS_WANTED - 1
        text = f"{leader} has the smallest ATE, {_spread(first)}, but no test can judge one run of {_listed(single)}"
        return DatasetAnswerDocument(
            dataset=dataset,
            certainty=Certainty.TOO_FEW,
            leaders=(leader,),
            p_value=None,
            more_repeats=more,
            sentence=f"{text}; add {plural(more, 'repeat')}.",
        )
    return _tested(dataset, competitors, waiting)


def _competitors(entries: RankEntries, names: Mapping[int, str]) -> dict[str, RankEntry]:
    """{name: its first entry}, in the order of the ranking."""
    found: dict[str, RankEntry] = {}
    for entry in entries.ended:
        found.setdefault(names[entry.number], entry)
    return found


def _tested(dataset: str, competitors: Mapping[str, RankEntry], waiting: Sequence[str]) -> DatasetAnswerDocument:
    leader, first = next(iter(competitors.items()))
    rivals = {name: entry for name, entry in competitors.items() if name != leader and not _one_run(entry)}
    tests = {name: SeparationTest.of(first, entry) for name, entry in rivals.items()}
    sharing = {name: test for name, test in tests.items() if not test.separated}
    so_far = f" So far, {_listed(waiting)} has no result." if waiting else ""
    if not sharing:
        second, test = next(iter(tests.items()))
        text = f"{leader} is best: {_test_words(test, first, competitors[second], second)}.{so_far}"
        certainty = Certainty.OPEN if waiting else Certainty.SEPARATED
        return DatasetAnswerDocument(
            dataset=dataset,
            certainty=certainty,
            leaders=(leader,),
            p_value=test.p_value,
            more_repeats=None,
            sentence=text,
        )
    needed = [test.repeats_to_decide for test in sharing.values()]
    more = None if None in needed else max(count for count in needed if count is not None)
    p_value = min(test.p_value for test in sharing.values())
    sign = "=" if len(sharing) == 1 else "≥"
    text = f"{_listed([leader, *sharing])} are not separated, {_p_text(p_value, sign)}; {_would_decide(more)}.{so_far}"
    return DatasetAnswerDocument(
        dataset=dataset,
        certainty=Certainty.NOT_SEPARATED,
        leaders=(leader, *sharing),
        p_value=p_value,
        more_repeats=more,
        sentence=text,
    )


def _test_words(test: SeparationTest, entry: RankEntry, other: RankEntry, name: str = "") -> str:
    of = f" of {name}" if name else ""
    if test.by_failures or entry.good is None or other.good is None:
        failed = f"{entry.failed} of {plural(entry.total, 'run')} failed{',' if of else ' against'}"
        return f"{failed} {other.failed} of {other.total}{of}, {_p_text(test.p_value)}"
    return f"ATE {_spread(entry)} against {_spread(other)}{of}, {_p_text(test.p_value)}"


def pair_sentence(name: str, entry: RankEntry, other_name: str, other: RankEntry) -> str:
    """A sentence on ``entry`` beside ``other``, by the tests of the answer: better, worse, or not separated."""
    ahead, behind = sorted(((name, entry), (other_name, other)), key=lambda pair: pair[1].key)
    if ahead[1].good is None:
        failed = entry.failed + other.failed
        return f"Neither {name} nor {other_name} has a good run: {plural(failed, 'run')} failed."
    single = [known for known, found in (ahead, behind) if _one_run(found)]
    if single:
        more = plural(REPEATS_WANTED - 1, "repeat")
        return f"No test can judge one good run of {_listed(single)}; add {more}."
    test = SeparationTest.of(ahead[1], behind[1])
    if test.separated:
        told = "better" if ahead[0] == name else "worse"
        return f"{name} is {told} than {other_name}: {_test_words(test, entry, other)}."
    return (
        f"{name} and {other_name} are not separated, {_p_text(test.p_value)}; {_would_decide(test.repeats_to_decide)}."
    )


def _would_decide(more: int | None) -> str:
    return "no number of repeats would decide" if more is None else f"{plural(more, 'more repeat')} would decide"


def _one_run(entry: RankEntry) -> bool:
    return entry.good is not None and not entry.ranked


def _over_all(found: Sequence[DatasetAnswerDocument]) -> str:
    """One sentence for all datasets; that of the dataset itself if there is one."""
    if len(found) == 1:
        return found[0].sentence
    known = [entry for entry in found if entry.leaders]
    if not known:
        return "No run has been evaluated yet."
    leads = Counter(entry.leaders[0] for entry in known)
    order = [name for name, _ in leads.most_common()]
    separated = sum(entry.certainty is Certainty.SEPARATED for entry in known)
    many = plural(len(found), "dataset")
    if len(order) == 1:
        text = f"{order[0]} leads on {'all ' if len(known) == len(found) else f'{len(known)} of '}{many}"
    else:
        text = f"{order[0]} leads on {leads[order[0]]} of {many}, " + ", ".join(
            f"{name} on {leads[name]}" for name in order[1:MOST_NAMED]
        )
        if others := sum(leads[name] for name in order[MOST_NAMED:]):
            text += f", others on {others}"
    text += (
        ", separated from the others on each"
        if separated == len(found)
        else f"; a test separates it from the others on {separated or 'none'}"
    )
    more = _suggested(found)
    return text + (f"; {plural(more, 'more repeat')} would decide where it can." if more else ".")


def _suggested(found: Iterable[DatasetAnswerDocument]) -> int | None:
    needed = [entry.more_repeats for entry in found if entry.more_repeats is not None]
    return max((count for count in needed if count <= MOST_SUGGESTED), default=None)


def _notes(entries: Mapping[str, RankEntries], names: Mapping[int, str]) -> Iterable[str]:
    others = sum(known.other_runs for known in entries.values())
    if others:
        yield f"{plural(others, 'good run')} under other protocols cannot be compared and are left out"
    found = [_competitors(known, names) for known in entries.values()]
    singles = [name for competitors in found for name, entry in competitors.items() if _one_run(entry)]
    if singles and any(entry.ranked for competitors in found for entry in competitors.values()):
        yield f"one good run alone is not judged: {_listed(list(dict.fromkeys(singles)))}"
    if any(len(competitors) < len(known.ended) for competitors, known in zip(found, entries.values(), strict=True)):
        yield "each algorithm is represented by its best configuration, so its error is a little too favourable"


def _listed(names: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and 4 others``."""
    shown = list(names) if len(names) <= MOST_NAMED else [*names[: MOST_NAMED - 1], f"{len(names) - 2} others"]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}" if shown else ""


def _spread(entry: RankEntry) -> str:
    """``0.106 ± 0.019 m``."""
    if entry.good is None:
        return "unknown"
    return f"{mean_and_std(entry.good.mean, entry.good.variance**0.5 if entry.ranked else None)} m"


def _p_text(p_value: float, sign: str = "=") -> str:
    return "p < 0.001" if p_value < 0.001 else f"p {sign} {p_value:.2g}"


def _plain(value: Value | None) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
