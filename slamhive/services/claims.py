"""Claims of papers and READMEs, checked against runs of one's own; the last answers are kept in the data root."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import ValidationError

from slamhive import __version__
from slamhive.base import strict_yaml
from slamhive.base.bounds import MOST_RECORD_BYTES, parse_json_object, read_text
from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, Unavailable, unknown
from slamhive.base.files import make_shared_folder, remedy_of, write_aside
from slamhive.documents.claims import ClaimAnswer, ClaimEntry, ClaimProtocol, ClaimsAnswer, ClaimsFile
from slamhive.documents.gate import MeasuredRun
from slamhive.documents.limits import NEVER
from slamhive.documents.model import first_problem_at, parse
from slamhive.documents.record import ConfigurationContent
from slamhive.documents.submission import Submission
from slamhive.domain.claim import Claim, ClaimedStatistic, ClaimState, claims_words, read_stated
from slamhive.domain.gate import Margin
from slamhive.domain.metrics import Direction, metric
from slamhive.domain.names import check_name, plural
from slamhive.domain.packages import split_version
from slamhive.domain.protocol import Protocol, exactly
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.evaluation.presets import BY_SENSORS
from slamhive.experiments.binding import at
from slamhive.experiments.file import read_difference
from slamhive.filters.fields import units_of
from slamhive.services.datasets import check_writable
from slamhive.services.evaluations import fitting_protocol
from slamhive.services.gates import measured_runs, pairing_key
from slamhive.store import RunRecord, Store

if TYPE_CHECKING:
    from slamhive.base.settings import Settings
    from slamhive.services.configurations import Configurations
    from slamhive.services.datasets import Catalogue
    from slamhive.services.evaluations import Evaluations, ProtocolSearches, ProtocolService
    from slamhive.services.fetching import Collections
    from slamhive.services.runs import RunService
    from slamhive.services.searches import Searches

DEFAULT_REPEATS = 5
LOOSEST = 0.5
"""Runs that leave the mean open by more than this share of the stated number, and by more than the tolerance, confirm
nothing."""
MOST_RUNS = 1000
MOST_AT_ONCE = 20
"""One check makes so many runs of an entry; the next one makes more, if they are still needed."""
_MOST_PROTOCOLS = 3
_SUBMITTED = {"algorithm", "dataset", "parameters", "variant", "sensors", "playback_mode", "playback_rate"}
"""Fields of an entry that say what runs."""
_ENDING = ".json"
_LIST = "slamhive claims list shows them"
_MISSED = VerdictKind.MISSED_INPUT


@dataclass(frozen=True, slots=True)
class CheckedEntry:
    """Claims about one system on one sequence, and how its runs are submitted."""

    submission: Submission
    claims: tuple[Claim, ...]


@dataclass(frozen=True, slots=True)
class ClaimsCheck:
    """A file of claims that has been read.

    ``obtain``: how to get datasets and algorithms that may be lacking, by name.
    """

    name: str
    title: str
    entries: tuple[CheckedEntry, ...]
    obtain: Mapping[str, str]

    def only(self, algorithms: Collection[str], datasets: Collection[str]) -> ClaimsCheck:
        """The claims about these algorithms on these datasets; none named means all. Raises NotFound for a name."""
        for kind, names, known in (
            ("algorithm", algorithms, sorted({entry.submission.algorithm for entry in self.entries})),
            ("dataset", datasets, sorted({entry.submission.dataset for entry in self.entries})),
        ):
            for name in names:
                if name not in known:
                    raise unknown(f"{kind} of claims {self.name}", name, known)
        kept = tuple(
            entry
            for entry in self.entries
            if (not algorithms or entry.submission.algorithm in algorithms)
            and (not datasets or entry.submission.dataset in datasets)
        )
        if not kept:
            raise NotFound(f"claims {self.name} has none about {', '.join(algorithms)} on {', '.join(datasets)}")
        return replace(self, entries=kept)


@dataclass(frozen=True, slots=True)
class ClaimRuns:
    """The runs behind one entry.

    Attributes:
        protocol: Of their errors.
        measured: {number: values} of those that count, the oldest first.
        unevaluated: Runs that have not been evaluated under the protocol.
        open: Runs that have not ended.
        next_seed: For further runs.
        notes: What was left out, and what limits the answer.
    """

    protocol: Protocol
    measured: Mapping[int, MeasuredRun] = field(default_factory=dict)
    unevaluated: Sequence[int] = ()
    open: Sequence[int] = ()
    next_seed: int = 0
    notes: tuple[str, ...] = ()


@dataclass(slots=True)
class ClaimWork:
    """Runs and evaluations to wait for, and why entries could not be started, by their place in the file."""

    runs: list[int] = field(default_factory=list)
    evaluations: list[int] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ClaimTools:
    """The services that find, make and evaluate the runs of a check.

    Attributes:
        searches: Finds runs by a filter.
        catalogue: What can run.
        configurations: Checks what is to run.
        runs: Submits runs.
        evaluations: Evaluates runs under the protocol of a claim.
        protocols: Protocols by name.
        protocol_searches: Finds the protocols under which a number holds.
        collections: Datasets that can be fetched.
    """

    searches: Searches
    catalogue: Catalogue
    configurations: Configurations
    runs: RunService
    evaluations: Evaluations
    protocols: ProtocolService
    protocol_searches: ProtocolSearches
    collections: Collections


class Claims:
    """Files of claims: read, checked against runs, and kept with their answers.

    Args:
        settings: Where answers are kept, and the mode.
        store: The runs.
        tools: What finds, makes and evaluates runs.
    """

    def __init__(self, settings: Settings, store: Store, tools: ClaimTools) -> None:
        self._settings = settings
        self._store = store
        self._tools = tools

    # -- reading ---------------------------------------------------------------------------------------------------

    def read(self, path: Path) -> ClaimsCheck:
        """Read a file of claims; raises InvalidInput or NotFound naming file, line and what is wrong."""
        content, lines = strict_yaml.parse_with_lines(strict_yaml.read_text(path), str(path))
        places = strict_yaml.Places(str(path), lines)
        try:
            file = ClaimsFile.model_validate(content)
        except ValidationError as error:
            place, problem = first_problem_at(error, ClaimsFile)
            raise InvalidInput(f"{places.of(*place)}: {problem}") from None
        algorithms = [algorithm.name for algorithm in self._tools.catalogue.algorithms()]
        datasets = [dataset.name for dataset in self._tools.catalogue.datasets()]
        entries: list[CheckedEntry] = []
        seen: dict[object, int] = {}
        for number, entry in enumerate(file.claims):
            where: tuple[str | int, ...] = ("claims", number)
            try:
                _check_name("algorithm", split_version(entry.algorithm)[0], algorithms, file)
                if entry.dataset not in datasets:  # only then the catalogue of sequences is read
                    _check_name("dataset", entry.dataset, [*datasets, *self._fetchable], file)
                self._tools.protocols.find(entry.protocol or file.protocol or BY_SENSORS)
                submission = parse(Submission, entry.model_dump(mode="json", include=_SUBMITTED))
                submission.check()
                claims = []
                for key, text in entry.states.items():
                    where = ("claims", number, "states", key)
                    claim = _claim(file, entry, key, text)
                    twin = (repr(replace(submission, seed=0)), claim.version, key, claim.statistic, claim.protocol)
                    if twin in seen:
                        raise InvalidInput(
                            f"{key} of {claim.words} is claimed twice, as in entry {seen[twin] + 1}", "leave one out"
                        )
                    seen[twin] = number
                    claims.append(claim)
                entries.append(CheckedEntry(submission, tuple(claims)))
            except SlamHiveError as error:
                raise at(places.of(*where), error) from None
        return ClaimsCheck(file.name, file.title, tuple(entries), file.obtain)

    @property
    def _fetchable(self) -> dict[str, str]:
        """{dataset: the sequence to fetch for it}."""
        return {
            sequence.dataset_name: sequence.full_name
            for collection in self._tools.collections.all
            for sequence in collection.sequences
        }

    # -- the runs of an entry --------------------------------------------------------------------------------------

    def _look(self, check: ClaimsCheck, entry: CheckedEntry) -> ClaimRuns | str:
        """The runs of an entry, or why it cannot be run."""
        submission, claim = entry.submission, entry.claims[0]
        installed = {dataset.name for dataset in self._tools.catalogue.datasets()}
        if submission.dataset not in installed:
            how = check.obtain.get(submission.dataset)
            how = how or f"slamhive dataset fetch {self._fetchable.get(submission.dataset, submission.dataset)}"
            return f"needs dataset {submission.dataset}; get it with: {how}"
        try:
            algorithm = self._tools.catalogue.algorithm(submission.algorithm)
            dataset = self._tools.catalogue.dataset(submission.dataset)
            wanted = self._tools.configurations.check(submission).configuration
            protocol = fitting_protocol(algorithm, dataset, self._settings, self._tools.protocols.find(claim.protocol))
        except NotFound as error:
            how = check.obtain.get(split_version(submission.algorithm)[0])
            return str(error) if how is None else f"{error.message}; get it with: {how}"
        except SlamHiveError as error:
            return str(error)
        name = split_version(submission.algorithm)[0]
        matching = self._tools.searches.find(f'algorithm = "{name}" and dataset = "{submission.dataset}"')
        same = replace(wanted, version=None).content_hash
        runs = [
            run
            for run in self._store.read(lambda t: t.runs.get_many(matching))
            if pairing_key(ConfigurationContent.of(run)) == same
            and run.state is not RunState.CANCELLED
            and not (run.reason is not None and (run.reason.before_start or run.reason is FailureReason.LOST))
        ]
        bounded = [run for run in runs if run.stop_when != NEVER or (run.cpu_cores, run.memory_mb) != (None, None)]
        runs = [run for run in runs if run not in bounded]
        still_open = [run.id for run in runs if not run.state.ended and run.asked_version == wanted.version]
        ended = sorted((run for run in runs if run.state.ended and _fits(run, entry)), key=lambda run: run.id)
        if claim.version is not None and not ended and algorithm.package.version != claim.version:
            return f"needs version {claim.version} of {name}; version {algorithm.package.version} is installed"
        counted = [run for run in ended if _sameness(run) == _sameness(ended[-1])][-MOST_RUNS:]
        notes = []
        if bounded:
            notes.append(f"{plural(len(bounded), 'run')} left out: their CPU, memory or end was limited.")
        if len(counted) < len(ended):
            left_out = plural(len(ended) - len(counted), "older run")
            notes.append(f"{left_out} of another version, or on another content of the dataset, left out.")
        measured = self._store.read(lambda t: measured_runs(t, counted, protocol.fingerprint))
        starved = {number for number, run in measured.items() if run.failed is _MISSED and run.disturbed}
        if starved:
            notes.append(f"{plural(len(starved), 'run')} left out: input was missed on a disturbed machine.")
        seeds = [run.seed + 1 for run in (*runs, *bounded)]
        return ClaimRuns(
            protocol,
            {run.id: measured[run.id] for run in counted if run.id in measured and run.id not in starved},
            [run.id for run in counted if run.id not in measured],
            still_open,
            max(seeds, default=0),
            tuple(notes),
        )

    def start(self, check: ClaimsCheck, executor: str | None = None) -> ClaimWork:
        """Queue the runs and evaluations that the check lacks. An entry that cannot be started stops no other."""
        check_writable(self._settings)
        work = ClaimWork()
        for place, entry in enumerate(check.entries):
            found = self._look(check, entry)
            if isinstance(found, str):
                continue
            work.runs += found.open
            lacking = max(judge_claim(claim, found).lacking for claim in entry.claims)
            lacking = min(lacking - len(found.unevaluated) - len(found.open), MOST_AT_ONCE)
            asked = exactly(found.protocol, found.protocol.fingerprint)
            try:
                if found.unevaluated:
                    work.evaluations += self._tools.evaluations.queue(found.unevaluated, asked)
                if lacking > 0:
                    submission = replace(entry.submission, repeat=lacking, seed=found.next_seed, executor=executor)
                    work.runs += [run.id for run in self._tools.runs.submit(submission, found.protocol)]
            except SlamHiveError as error:
                work.refused[place] = str(error)
        return work

    # -- answering -------------------------------------------------------------------------------------------------

    def answer(
        self,
        check: ClaimsCheck,
        refused: Mapping[int, str] | None = None,
        progress: Callable[[int, str], None] = lambda _done, _about: None,
    ) -> ClaimsAnswer:
        """State for each claim how far it holds on the runs that exist.

        Args:
            check: The claims.
            refused: Why entries could not be started, by their place; see :meth:`start`.
            progress: Called before each entry with the number of those that are done, and with what it is about.
        """
        answers = []
        for place, entry in enumerate(check.entries):
            progress(place, entry.claims[0].words)
            found = self._look(check, entry)
            hindrance = found if isinstance(found, str) else (refused or {}).get(place)
            for claim in entry.claims:
                if isinstance(found, str) or (hindrance is not None and not found.measured):
                    answers.append(_answer(claim, ClaimState.CANNOT_RUN, str(hindrance)))
                else:
                    judged = judge_claim(claim, found)
                    answers.append(self._with_protocols(claim, judged, found))
        return ClaimsAnswer(
            name=check.name,
            title=check.title,
            words=claims_words(answer.state for answer in answers),
            checked_at=utc_now(),
            software=__version__,
            claims=tuple(answers),
        )

    def _with_protocols(self, claim: Claim, answer: ClaimAnswer, found: ClaimRuns) -> ClaimAnswer:
        """Add the protocols under which a claim that differs would hold.

        One run stands for all: the one whose value is nearest to ours. Under such a protocol it gives the stated number
        as closely as the runs here would have to.
        """
        if answer.state is not ClaimState.DIFFERS or answer.value is None or claim.family is None:
            return answer
        own, stated = answer.value, claim.stated
        values = {
            number: stated.factor * run.metrics[claim.metric]
            for number, run in found.measured.items()
            if run.failed is None and claim.metric in run.metrics
        }
        typical = min(values, key=lambda number: abs(values[number] - own))
        within = ((answer.high or own) - (answer.low or own)) / 2
        try:
            searched = self._tools.protocol_searches.search(
                typical, f"{stated.printed.value:.12g}", claim.family, stated.unit, within
            )
        except SlamHiveError as error:
            return answer.model_copy(update={"notes": (*answer.notes, f"No protocol was searched: {error}")})
        count = len(searched.matches)
        if not count:
            note = f"No protocol gives it, of {searched.tried:,} tried on run {typical}."
            return answer.model_copy(update={"notes": (*answer.notes, note)})
        protocols = tuple(
            ClaimProtocol(words=match.words, preset=match.preset, key=match.key, value=match.value)
            for match in searched.matches[:_MOST_PROTOCOLS]
        )
        note = f"{plural(count, 'protocol')} of {searched.tried:,} would make it hold on run {typical}."
        return answer.model_copy(update={"protocols": protocols, "notes": (*answer.notes, note)})

    # -- answers that are kept -------------------------------------------------------------------------------------

    def keep(self, answer: ClaimsAnswer) -> None:
        """Keep an answer for the pages, in place of the one before; raises Unavailable if the disk refuses."""
        check_writable(self._settings)
        path = self._path(answer.name)
        try:
            make_shared_folder(path.parent)
        except OSError as error:
            raise Unavailable(f"{path.parent} cannot be made: {error.strerror}", remedy_of(error)) from None
        write_aside(path, json.dumps(answer.content, indent=1, allow_nan=False) + "\n")

    def names(self) -> list[str]:
        """The files of claims whose answers are kept, sorted."""
        return sorted(path.stem for path in self._settings.claims_folder.glob(f"[!.]*{_ENDING}"))

    def get(self, name: str) -> ClaimsAnswer:
        """The last answer, without claims whose runs the viewer may not see; raises NotFound."""
        path = self._path(name)
        if not path.is_file():
            raise unknown("claims", name, self.names(), _LIST)
        content = parse_json_object(read_text(path, MOST_RECORD_BYTES), str(path))
        try:
            found = ClaimsAnswer.read(content)
        except InvalidInput as error:
            raise InvalidInput(f"{path} holds no claims: {error.message}", f"slamhive claims remove {name}") from None
        behind = {run for claim in found.claims for run in claim.runs}
        seen = set(self._store.read(lambda t: t.archive.ended_among(sorted(behind)))) if behind else set()
        shown = tuple(claim for claim in found.claims if seen.issuperset(claim.runs))
        hidden = len(found.claims) - len(shown)
        words = claims_words(claim.state for claim in shown)
        return found.model_copy(update={"claims": shown, "hidden": hidden, "words": words})

    def all(self) -> list[ClaimsAnswer]:
        """The last answer about every file."""
        return [self.get(name) for name in self.names()]

    def remove(self, name: str) -> None:
        """Forget an answer; its runs stay. Raises NotFound."""
        check_writable(self._settings)
        try:
            self._path(name).unlink()
        except FileNotFoundError:
            raise unknown("claims", name, self.names(), _LIST) from None
        except OSError as error:
            raise Unavailable(f"claims {name} cannot be removed: {error.strerror}", remedy_of(error)) from None

    def _path(self, name: str) -> Path:
        return self._settings.claims_folder / f"{check_name('claims', name)}{_ENDING}"


def _check_name(kind: str, name: str, known: list[str], file: ClaimsFile) -> None:
    """Raise NotFound for a name that neither this installation nor the file knows how to get."""
    if name not in known and name not in file.obtain:
        raise unknown(kind, name, known, "`obtain` may say how to get one that is not here")


def _claim(file: ClaimsFile, entry: ClaimEntry, key: str, text: str) -> Claim:
    """One claim of an entry, with what the file says for all; raises InvalidInput or NotFound."""
    measured = metric(key)
    if measured.direction is Direction.NEUTRAL:
        raise InvalidInput(f"no direction of {key} is better, so no run can confirm it", "state another metric")
    source = entry.source or file.source
    if source is None:
        raise InvalidInput(f"the source of {key} is missing", "say where it is published: source: PAPER, Table 1")
    asked = entry.within or file.within
    within = asked.get(key) if isinstance(asked, dict) else asked
    stated = read_stated(text, measured, units_of(measured.unit))
    statistic = entry.of or file.of or ClaimedStatistic.MEAN
    runs = entry.runs or file.runs
    if stated.std is not None and (statistic is not ClaimedStatistic.MEAN or (runs or 0) < 2):
        raise InvalidInput(
            f"{stated.text} has a deviation, so it is a mean over two runs or more", "say over how many: runs: 5"
        )
    settings = [f"{name} = {value}" for name, value in entry.parameters.items()]
    settings += [f"{role} = {sensor}" for role, sensor in entry.sensors.items()]
    settings += [plural(len(entry.variant), "pre-processing step")] if entry.variant else []
    if {"playback_mode", "playback_rate"} & entry.model_fields_set:
        settings.append(f"played {entry.playback_mode} at {entry.playback_rate:g} x")
    return Claim(
        algorithm=entry.algorithm,
        version=entry.version,
        dataset=entry.dataset,
        settings=", ".join(settings),
        metric=key,
        stated=stated,
        statistic=statistic,
        runs=runs,
        tolerance=Margin(0.0) if within is None else read_difference(within, measured),
        repeats=entry.repeats or file.repeats or DEFAULT_REPEATS,
        protocol=entry.protocol or file.protocol or BY_SENSORS,
        source=source,
    )


def _fits(run: RunRecord, entry: CheckedEntry) -> bool:
    """Tell if a run used the version that the claims name."""
    number, version = split_version(entry.submission.algorithm)[1], entry.claims[0].version
    if run.version is None:
        return number is None and version is None
    return number in (None, run.version.number) and version in (None, run.version.version)


def _sameness(run: RunRecord) -> tuple[str | None, str | None]:
    """Version and data that runs must share to be repeats of each other, besides their configuration."""
    return None if run.version is None else run.version.identity, run.dataset_checksum


def judge_claim(claim: Claim, found: ClaimRuns) -> ClaimAnswer:
    """Judge a claim by the values of runs.

    It holds if the stated number lies in the 95 % interval of our mean, widened by half of its last digit and by the
    tolerance. The interval is Student's, or Welch's if the deviation behind the number is stated. For a median it is
    that of order statistics, and the range of fewer than six runs.
    """
    counted = found.measured
    good = [run for run in counted.values() if run.failed is None]
    values = np.array([claim.stated.factor * run.metrics[claim.metric] for run in good if claim.metric in run.metrics])
    unit, stated = claim.stated.unit, claim.stated.printed.value
    notes = [*found.notes]
    machines = sorted({run.cpu_model for run in good if run.cpu_model is not None})
    if machines and not metric(claim.metric).needs_protocol:
        notes.append(f"It depends on the machine; here {', '.join(machines)}.")
    disturbed = sum(run.disturbed is True for run in good)
    if disturbed:
        notes.append(f"{plural(disturbed, 'run')} ran on a disturbed machine.")
    facts: dict[str, object] = {
        "runs": tuple(counted),
        "failed": tuple(number for number, run in counted.items() if run.failed is not None),
        "notes": tuple(notes),
    }
    lacking = claim.repeats - len(counted)
    if lacking > 0:
        waiting = f", {len(found.unevaluated)} not evaluated under the protocol" if found.unevaluated else ""
        words = f"{len(counted)} of {plural(claim.repeats, 'run')}{waiting}: {lacking} more needed"
        return _answer(claim, ClaimState.UNDECIDED, words, lacking=lacking, **facts)
    if not good:
        kinds = Counter(run.failed.label for run in counted.values() if run.failed is not None)
        why = ", ".join(kind for kind, _ in kinds.most_common())
        return _answer(claim, ClaimState.DIFFERS, f"all {plural(len(counted), 'run')} failed: {why}", **facts)
    if not len(values):
        return _answer(claim, ClaimState.CANNOT_RUN, f"no run here reports {claim.metric}", **facts)
    center = float(np.median(values) if claim.statistic is ClaimedStatistic.MEDIAN else values.mean())
    facts |= {"value": center, "ratio": center / stated if stated else None}
    if len(values) < 2:
        words = f"one good run of {len(counted)}: one more needed"
        return _answer(claim, ClaimState.UNDECIDED, words, lacking=1, **facts)
    low, high = _interval(claim, values, len(values))
    facts |= {"std": float(values.std(ddof=1)), "low": low - claim.margin, "high": high + claim.margin}
    ours = f"{center:.4g} {unit}".strip()
    agreeing = f"{low - claim.margin:.4g} to {high + claim.margin:.4g} {unit}".strip()
    if not low - claim.margin <= stated <= high + claim.margin:
        times = f", {center / stated:.3g} times the stated number" if stated else ""
        words = f"{ours} over {plural(len(values), 'good run')}{times}; runs here agree with {agreeing}"
        return _answer(claim, ClaimState.DIFFERS, words, **facts)
    narrow = max(claim.margin, LOOSEST * stated)
    if (high - low) / 2 > narrow:
        # About how many runs make the interval as narrow as that, at most MOST_RUNS.
        count = len(values) + 1
        while count < MOST_RUNS:
            lower, upper = _interval(claim, values, count)
            if (upper - lower) / 2 <= narrow:
                break
            count += max(1, count // 10)
        more = count - len(values)
        words = f"{ours}, but runs here agree with {agreeing}: about {plural(more, 'more run')} needed"
        return _answer(claim, ClaimState.UNDECIDED, words, lacking=more, **facts)
    words = f"{ours} over {plural(len(values), 'good run')}; runs here agree with {agreeing}"
    return _answer(claim, ClaimState.HOLDS, words, **facts)


def _interval(claim: Claim, values: np.ndarray, count: int) -> tuple[float, float]:
    """The 95 % interval for the stated number, if there were ``count`` runs that vary as ``values`` do."""
    from slamhive.analysis.regression import median_rank  # noqa: PLC0415 - loads scipy
    from slamhive.analysis.statistics import compare_samples  # noqa: PLC0415 - as above

    if claim.statistic is ClaimedStatistic.MEDIAN:
        share = max(median_rank(count) - 1, 0) / max(count - 1, 1)
        return float(np.quantile(values, share)), float(np.quantile(values, 1 - share))
    std = claim.stated.std or 0.0
    theirs = max(claim.runs or 2, 2), claim.stated.printed.value, std**2
    interval = compare_samples((count, float(values.mean()), float(values.var(ddof=1))), theirs).interval
    half = (interval.high - interval.low) / 2
    return float(values.mean()) - half, float(values.mean()) + half


def _answer(claim: Claim, state: ClaimState, words: str, **facts: object) -> ClaimAnswer:
    return ClaimAnswer.model_validate(
        {
            "about": claim.words,
            "algorithm": claim.algorithm,
            "dataset": claim.dataset,
            "metric": claim.metric,
            "label": metric(claim.metric).label,
            "stated": claim.stated.text,
            "unit": claim.stated.unit,
            "statistic": claim.statistic,
            "source": claim.source,
            "protocol": claim.protocol,
            "state": state,
            "words": words,
            **facts,
        }
    )


# The badge: a picture of two words for a README, drawn without any library.

_COLOURS = {True: "#2e7d32", False: "#b3261e", None: "#5f6368"}
_LETTER_PX, _PAD_PX = 6.6, 10


def badge_svg(states: Iterable[ClaimState]) -> str:
    """The badge ``claims: 9 of 12 hold``: green if all hold, red if one differs, grey otherwise."""
    found = list(states)
    words = claims_words(found)
    kind = False if ClaimState.DIFFERS in found else (True if found and set(found) == {ClaimState.HOLDS} else None)
    left, right = (round(len(text) * _LETTER_PX + 2 * _PAD_PX) for text in ("claims", words))
    label = escape(f"claims: {words}")
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + right}" height="20" role="img" aria-label="{label}">'
        f"<title>{label}</title>"
        f'<rect width="{left}" height="20" fill="#3c4043"/>'
        f'<rect x="{left}" width="{right}" height="20" fill="{_COLOURS[kind]}"/>'
        '<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11" text-anchor="middle">'
        f'<text x="{left / 2:g}" y="14">claims</text>'
        f'<text x="{left + right / 2:g}" y="14">{escape(words)}</text></g></svg>\n'
    )
