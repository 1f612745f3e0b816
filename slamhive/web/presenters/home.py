"""The first page: what needs somebody, the latest answers, and the cover of an archive."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

from flask import url_for as address

from slamhive.base.clock import utc_now
from slamhive.documents.experiment import Certainty, ExperimentAnswerDocument
from slamhive.documents.plain import ConfigurationStanding, ExperimentStatusDocument
from slamhive.domain.bibliography import Reference
from slamhive.domain.run import FailureReason
from slamhive.domain.verdict import Outcome
from slamhive.filters.syntax import experiment_filter
from slamhive.services.hive import Hive
from slamhive.web.formatting import plural, thousands
from slamhive.web.presenters import rankings
from slamhive.web.presenters.experiments import failures_in_words

LATEST = 6
"""So many experiments are answered on the first page, the newest."""
LOOKED_AT = 12
"""Experiments that are looked at for what needs somebody."""
DOTS = 3
"""Rows of the strip on a card."""
_MOST_DISTURBED = 500
_RECENT = timedelta(days=7)
ABOUT = "about.md"
"""The file in the data root that describes an archive to its visitors."""


@dataclass(frozen=True, slots=True)
class Attention:
    """Something that needs somebody, with the one button that helps.

    Attributes:
        mark: The outcome or the trust whose colour and shape it has.
        words: A sentence.
        button: The words of the button.
        endpoint: The page, or what the button posts to if ``posts``.
        arguments: Of its address.
        fields: Of the web form.
    """

    mark: str
    words: str
    button: str
    endpoint: str
    arguments: Mapping[str, str] = field(default_factory=dict)
    fields: Sequence[tuple[str, str]] = ()
    posts: bool = True


@dataclass(frozen=True, slots=True)
class AnswerCard:
    """An experiment with its answer, and the strip of its first ranking; None while no run has ended."""

    status: ExperimentStatusDocument
    answer: ExperimentAnswerDocument
    ranking: rankings.RankingView | None

    @property
    def mark(self) -> str:
        """The class of its badge."""
        return {Certainty.SEPARATED: "outcome-good", Certainty.OPEN: "outcome-queued"}.get(
            self.answer.certainty, "trust-limited" if self.answer.certainty.undecided else ""
        )


@dataclass(frozen=True, slots=True)
class Cover:
    """The cover of an archive: its description in Markdown, how much it holds, and the works to cite."""

    about: str
    runs: int
    algorithms: int
    datasets: int
    references: tuple[Reference, ...]


def headline(active: int, queued: int) -> str:
    """The title of the page: ``2 runs in progress, 13 queued``."""
    parts = ([f"{plural(active, 'run')} in progress"] if active else []) + (
        [f"{thousands(queued)} queued" if active else f"{plural(queued, 'run')} queued"] if queued else []
    )
    return ", ".join(parts) or "Nothing is running"


def answer_cards(services: Hive, experiments: Sequence[ExperimentStatusDocument]) -> list[AnswerCard]:
    """The newest experiments with runs that have ended, each with its answer."""
    found = [entry for entry in experiments if entry.cells <= rankings.LARGEST and entry.ended][:LATEST]
    return [_card(services, entry) for entry in found]


def _card(services: Hive, status: ExperimentStatusDocument) -> AnswerCard:
    axes = {axis: len(values) for axis, values in services.experiments.axes(status.name).items()}
    by_algorithm = axes.get("algorithm", 0) > 1
    # A card has no room for axes with one value, nor for the best values of an algorithm.
    telling = ["algorithm"] if by_algorithm else [axis for axis in rankings.naming_axes(axes) if axes[axis] > 1]
    answer, found = services.experiments.answer_and_rankings(status.name, by_algorithm=by_algorithm)
    return AnswerCard(status, answer, next(iter(rankings.views(found, telling)), None))


def needs(
    services: Hive, experiments: Sequence[ExperimentStatusDocument], cards: Sequence[AnswerCard]
) -> list[Attention]:
    """List what needs somebody, the worst first."""
    looked_at = [entry for entry in experiments if entry.state is not ConfigurationStanding.CANCELLED][:LOOKED_AT]
    found = [need for entry in looked_at for need in _failed(entry)]

    # Failed runs of the last days that no experiment counts and nobody has repeated.
    since = (utc_now() - _RECENT).date().isoformat()
    text = f"state = failed and missing experiment and ended_at >= {since}"
    alone = services.searches.find(f"{text} and not reason = {FailureReason.LOST}")
    repeated = services.runs.repeated(alone)
    failed = [number for number in alone if number not in repeated]
    if failed:
        found.append(
            Attention(
                "outcome-failed",
                f"{plural(len(failed), 'run')} failed in the last week",
                "See why",
                "runs.index",
                {"where": text},
                posts=False,
            )
        )

    found += [need for entry in looked_at if entry.disturbed for need in _disturbed(services, entry)]
    if unevaluated := services.searches.unevaluated():
        are = "is" if unevaluated == 1 else "are"
        found.append(
            Attention(
                "outcome-unjudged",
                f"{plural(unevaluated, 'run')} {are} not evaluated",
                f"Evaluate {thousands(unevaluated)}",
                "selected_runs.evaluate",
                fields=(("all", "1"),),
            )
        )
    for card in cards:
        mixed = (
            services.current_protocols.mixed_in(card.status.name) if card.answer.certainty is Certainty.OPEN else None
        )
        if mixed is not None and mixed.common is not None:
            found.append(
                Attention(
                    "trust-limited",
                    f"{card.status.name} has no answer: {mixed.words.removesuffix('.')}",
                    f"Evaluate all under {mixed.common_name}",
                    "selected_runs.evaluate_together",
                    fields=(
                        ("where", experiment_filter(card.status.name)),
                        ("protocol", mixed.common.fingerprint),
                        ("back", address("experiments.show", name=card.status.name)),
                    ),
                )
            )
        more = card.answer.more_repeats
        if card.answer.certainty.undecided and more and card.status.state is ConfigurationStanding.FINISHED:
            found.append(
                Attention(
                    "trust-limited",
                    f"{card.status.name} is not decided: {card.answer.certainty.value}",
                    f"Add {plural(more, 'repeat')}",
                    "experiments.act",
                    {"name": card.status.name, "action": "add-repeats"},
                    (("count", str(more)),),
                )
            )
    return found


def _failed(status: ExperimentStatusDocument) -> Iterator[Attention]:
    counts, why = status.counts, failures_in_words(status.failures)
    failed, lost = counts[Outcome.FAILED], counts[Outcome.LOST]
    if status.ended_badly:
        told = [f"{plural(failed, 'run')} of {status.name} failed: {why}"] if failed else []
        told += [f"{lost} lost" if failed else f"{plural(lost, 'run')} of {status.name} lost"] if lost else []
        yield Attention(
            "outcome-failed",
            "; ".join(told),
            "Try again" if status.ended_badly == failed + lost else f"Try {status.ended_badly} again",
            "experiments.act",
            {"name": status.name, "action": "retry-failed"},
        )
    elif failed:
        yield Attention(
            "outcome-failed",
            f"{plural(failed, 'run')} of {status.name} failed: {why}",
            "See why",
            "runs.index",
            {"where": f"{experiment_filter(status.name)} and not verdict = good"},
            posts=False,
        )


def _disturbed(services: Hive, status: ExperimentStatusDocument) -> Iterator[Attention]:
    found = services.searches.find(f"{experiment_filter(status.name)} and disturbed = true and state = succeeded")
    repeated = services.runs.repeated(found)
    wanted = [number for number in found if number not in repeated][-_MOST_DISTURBED:]
    if wanted:
        yield Attention(
            "trust-limited",
            f"{plural(len(wanted), 'run')} of {status.name} measured while the machine was busy with something else",
            f"Run {thousands(len(wanted))} again",
            "selected_runs.retry",
            fields=tuple(("run", str(number)) for number in wanted),
        )


def cover(services: Hive, total: int) -> Cover:
    """The cover of an archive."""
    algorithms, datasets = services.searches.names()
    return Cover(
        about=_about(services.settings.data / ABOUT),
        runs=total,
        algorithms=len(algorithms),
        datasets=len(datasets),
        references=services.citations.of_names(algorithms, datasets),
    )


def _about(path: Path) -> str:
    """The description; empty without one, or if it is no text."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
