"""Baselines: files that hold the values of runs, frozen at one time, and the runs to compare with them."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamhive import __version__
from slamhive.base.bounds import MOST_RECORD_BYTES, parse_json_object, read_text
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, Unavailable, unknown
from slamhive.base.files import make_shared_folder, remedy_of, write_aside
from slamhive.base.settings import Settings
from slamhive.documents.gate import LARGEST_VALUE, Baseline, BaselineBrief, BaselineConfiguration, MeasuredRun
from slamhive.documents.record import ConfigurationContent
from slamhive.domain.gate import Margin
from slamhive.domain.metrics import METRICS, Direction
from slamhive.domain.names import check_name, plural
from slamhive.domain.parameters import Value
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import RunState
from slamhive.domain.side_by_side import mixed_protocols
from slamhive.domain.verdict import FROM_REPEATS, VerdictKind
from slamhive.services.datasets import check_writable
from slamhive.services.searches import Searches
from slamhive.store import RunRecord, Store, Transaction
from slamhive.store.metrics import VERDICT, kind_of
from slamhive.store.records import protocol_uses, verdict_kind


def measured_runs(t: Transaction, runs: Sequence[RunRecord], fingerprint: str) -> dict[int, MeasuredRun]:
    """{run: its values} of runs that have ended; one that was not evaluated under the protocol is left out.

    A failed run needs no evaluation: it has failed under every protocol.
    """
    known = fingerprint in t.searches.protocols()
    protocol_id = t.run_table.protocol_id(fingerprint) if known else None
    run_ids = [run.id for run in runs]
    values = t.metrics.for_runs(run_ids, protocol_id=protocol_id, verdicts=True) if known else {}
    found: dict[int, MeasuredRun] = {}
    for run in runs:
        own = values.get(run.id, {})
        failed = _failed(run, own)
        if failed is not None or VERDICT in own:
            found[run.id] = _measured(run, own, failed)
    return found


def _failed(run: RunRecord, values: Mapping[str, float]) -> VerdictKind | None:
    """Why a run counts as failed; None for one that is good or was not evaluated."""
    kind = verdict_kind(run.state, run.reason, kind_of(values.get(VERDICT)))
    return kind if kind is not None and kind.failed else None


def _measured(run: RunRecord, values: Mapping[str, float], failed: VerdictKind | None) -> MeasuredRun:
    return MeasuredRun.of(
        run,
        version=run.version_label,
        cpu_model=None if run.host is None else run.host.cpu_model,
        disturbed=None if run.disturbance is None else run.disturbance.disturbed,
        failed=failed,
        # Those that can become worse. What repeats say of each other follows from the others.
        metrics={
            key: value
            for key, value in values.items()
            if (metric := METRICS.entries.get(key)) is not None
            and metric.direction is not Direction.NEUTRAL
            and key not in FROM_REPEATS
            and abs(value) <= LARGEST_VALUE
        },
    )


# Matching runs with configurations of a baseline. The version of the package may differ.

_ALIKE = ("algorithm", "dataset", "playback", "variant", "sensors")
_MOST_NAMED = 3


def pairing_key(content: ConfigurationContent) -> str:
    """Common part of configurations that differ in their version alone."""
    return replace(content.configuration, version=None).content_hash


def find_pair(
    held: Sequence[BaselineConfiguration], found: ConfigurationContent, ignored: Collection[str] = ()
) -> int | str:
    """The place in ``held`` of the configuration that ``found`` is compared with, or why there is none.

    A parameter that only one of them has was added to the package or removed from it, and does not count. Neither do
    the parameters ``ignored``.
    """
    used_map = None if found.map is None else found.map.content
    alike = [
        place
        for place, entry in enumerate(held)
        if (None if entry.map is None else entry.map.content) == used_map
        and all(getattr(entry, name) == getattr(found, name) for name in _ALIKE)
    ]
    fitting = [place for place in alike if not _differences(held[place], found, ignored)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        return f"fits {len(fitting)} configurations of the baseline"
    if not alike:
        return "no such configuration is in the baseline"
    fewest = min((_differences(held[place], found, ignored) for place in alike), key=len)
    more = f" and {len(fewest) - _MOST_NAMED} more" if len(fewest) > _MOST_NAMED else ""
    return f"differs from the baseline in {', '.join(fewest[:_MOST_NAMED])}{more}"


def _differences(held: ConfigurationContent, found: ConfigurationContent, ignored: Collection[str]) -> list[str]:
    """The parameters in which they differ, with both values."""
    common = [key for key in found.parameters if key in held.parameters and key not in ignored]
    return [
        f"{key} ({_text(held.parameters[key])}, here {_text(found.parameters[key])})"
        for key in common
        if held.parameters[key] != found.parameters[key]
    ]


def _text(value: Value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


ENDING = ".json"
_LIST = "slamhive gate list shows them"


@dataclass(frozen=True, slots=True)
class Frozen:
    """A new baseline, and how many runs that matched it does not hold."""

    baseline: Baseline
    left_out: int


class Baselines:
    """The baselines of one installation, one file each.

    Args:
        settings: Where their folder is, and the mode.
        store: The runs.
        searches: Finds runs by a filter.
    """

    def __init__(self, settings: Settings, store: Store, searches: Searches) -> None:
        self._settings = settings
        self._store = store
        self._searches = searches

    def briefs(self) -> list[BaselineBrief]:
        """All baselines, sorted by name; raises InvalidInput for a damaged file."""
        return [brief(self.get(name)) for name in self._names()]

    def get(self, reference: str) -> Baseline:
        """The baseline with this name, or the one in the file ``reference``, whose name ends with .json.

        Raises NotFound, or InvalidInput if the file holds no baseline.
        """
        if reference.endswith(ENDING):
            return _read(Path(reference))
        if not self._path(reference).is_file():
            raise unknown("baseline", reference, self._names(), f"{_LIST}; a file is named with its ending {ENDING}")
        return _read(self._path(reference))

    def freeze(self, name: str, where: str, protocol: str | None = None, *, replace: bool = False) -> Frozen:
        """Write the baseline ``name`` of the runs that match the filter ``where``.

        Args:
            name: Of the baseline.
            where: Runs that have not ended, were cancelled or were not evaluated are left out.
            protocol: Fingerprint of the protocol of the errors; None for that of each run's lists.
            replace: Whether it may take the place of another of the same name.

        Raises:
            InvalidInput: no run is left, or the runs of one configuration are not comparable.
            Conflict: the name is taken.
        """
        check_writable(self._settings)
        path = self._path(name)
        if path.exists() and not replace:
            raise Conflict(f"baseline {name} exists already", "choose another name, or give --replace")
        run_ids = self._searches.find(where)
        configurations = self._store.read(lambda t: tuple(_configurations(t, run_ids, protocol)))
        if not configurations:
            raise InvalidInput(
                f"none of the {plural(len(run_ids), 'run')} that match has ended and been evaluated",
                "slamhive runs --where shows them",
            )
        baseline = Baseline(
            name=name, made_at=utc_now(), software=__version__, where=where, configurations=configurations
        )
        try:
            make_shared_folder(path.parent)
        except OSError as error:
            raise Unavailable(f"{path.parent} cannot be made: {error.strerror}", remedy_of(error)) from None
        write_aside(path, baseline_text(baseline))
        return Frozen(baseline, len(run_ids) - baseline.runs)

    def export(self, name: str, path: Path) -> None:
        """Write a baseline to a file for another installation or a repository; raises InvalidInput or NotFound."""
        if not path.name.endswith(ENDING):
            raise InvalidInput(f"{path} does not end with {ENDING}", f"name the file {path.name}{ENDING}")
        write_aside(path, baseline_text(self.get(name)))

    def remove(self, name: str) -> None:
        """Delete a baseline; raises NotFound."""
        check_writable(self._settings)
        try:
            self._path(name).unlink()
        except FileNotFoundError:
            raise unknown("baseline", name, self._names(), _LIST) from None
        except OSError as error:
            raise Unavailable(f"baseline {name} cannot be removed: {error.strerror}", remedy_of(error)) from None

    def _names(self) -> list[str]:
        return sorted(path.stem for path in self._settings.baselines_folder.glob(f"[!.]*{ENDING}"))

    def _path(self, name: str) -> Path:
        if name.endswith(ENDING):
            raise InvalidInput(f"baseline name {name!r} ends as a file does", f"leave out {ENDING}")
        return self._settings.baselines_folder / f"{check_name('baseline', name)}{ENDING}"


def baseline_text(baseline: Baseline) -> str:
    """The content of its file; short lines, so that version control shows what changed."""
    return json.dumps(baseline.content, indent=1, sort_keys=True, allow_nan=False) + "\n"


def brief(baseline: Baseline) -> BaselineBrief:
    """A baseline as lists show it."""
    return BaselineBrief(
        name=baseline.name,
        made_at=baseline.made_at,
        algorithms=tuple(sorted({entry.algorithm for entry in baseline.configurations})),
        datasets=tuple(sorted({entry.dataset for entry in baseline.configurations})),
        configurations=len(baseline.configurations),
        runs=baseline.runs,
        failed=baseline.failed,
    )


def one_checksum(runs: Sequence[RunRecord], words: str) -> str | None:
    """The checksum of the dataset that runs used, None if unknown; raises InvalidInput for several."""
    found = sorted({run.dataset_checksum for run in runs if run.dataset_checksum is not None})
    if len(found) > 1:
        raise InvalidInput(
            f"the runs of {words} used {len(found)} contents of the dataset: {', '.join(text[:19] for text in found)}",
            "leave out the runs on the old one",
        )
    return found[0] if found else None


def _read(path: Path) -> Baseline:
    content = parse_json_object(read_text(path, MOST_RECORD_BYTES), str(path))
    try:
        return Baseline.read(content)
    except InvalidInput as error:
        raise InvalidInput(f"{path} holds no baseline: {error.message}", "slamhive gate export writes one") from None


def _configurations(t: Transaction, run_ids: Sequence[int], asked: str | None) -> Iterator[BaselineConfiguration]:
    protocols = {protocol.fingerprint: protocol for protocol, _ in t.evaluations.protocols()}
    if asked is not None and asked not in protocols:
        raise unknown("protocol", asked, list(protocols), "slamhive protocol list shows them")
    groups: dict[str, list[RunRecord]] = defaultdict(list)
    for run in t.runs.get_many(run_ids):
        if run.state in (RunState.SUCCEEDED, RunState.FAILED):
            groups[pairing_key(ConfigurationContent.of(run))].append(run)
    for runs in groups.values():
        found = frozen_configuration(t, runs, protocols, asked)
        if found is not None:
            yield found


def frozen_configuration(
    t: Transaction, runs: Sequence[RunRecord], protocols: Mapping[str, Protocol], asked: str | None = None
) -> BaselineConfiguration | None:
    """The configuration of ``runs`` with their values; None if none was evaluated.

    Args:
        t: Where the values are.
        runs: Ended runs of one configuration.
        protocols: All protocols by fingerprint.
        asked: Fingerprint of the protocol of the errors; None for that of the runs' lists.

    Raises InvalidInput if the runs are not comparable, or all failed.
    """
    words = f"{runs[0].algorithm} on {runs[0].dataset}"
    uses = protocol_uses(runs)
    mixed = mixed_protocols(uses, protocols)
    if asked is None and mixed is not None:
        raise InvalidInput(f"{words}: {mixed.counts}: not comparable", f"choose one with --protocol, or {mixed.remedy}")
    fingerprint = asked or next((use.fingerprint for use in uses), None)
    measured = {} if fingerprint is None else measured_runs(t, runs, fingerprint)
    if all(run.state is RunState.FAILED or (run.id in measured and measured[run.id].failed) for run in runs):
        raise InvalidInput(f"all runs of {words} failed", "a baseline needs a good one; leave these out by the filter")
    kept = [run for run in runs if run.id in measured]
    if fingerprint is None or not kept:
        return None
    return BaselineConfiguration.of(
        kept[0],
        version=None,
        dataset_checksum=one_checksum(kept, words),
        protocol=protocols[fingerprint],
        runs=tuple(measured[run.id] for run in kept),
    )


# Pairing runs to check with those of the baseline.

_MOST_LISTED = 10


@dataclass(frozen=True, slots=True)
class GateCheck:
    """Pairs of configurations to compare.

    Attributes:
        baseline: The runs to compare with.
        margins: By how much each metric may become worse.
        ignored: Parameters that may differ.
        partial: Whether a check can pass although configurations of the baseline have no runs.
        both_ways: Whether better values than those of the baseline count as worse ones do.
    """

    baseline: Baseline
    margins: Mapping[str, Margin]
    ignored: frozenset[str] = frozenset()
    partial: bool = False
    both_ways: bool = False


@dataclass(frozen=True, slots=True)
class RunPair:
    """One configuration of the baseline, and the runs to check.

    ``words`` is the name of the configuration; ``measured`` are the values of the runs, in the same order.
    """

    words: str
    held: BaselineConfiguration
    runs: tuple[RunRecord, ...]
    measured: tuple[MeasuredRun, ...]


@dataclass(frozen=True, slots=True)
class PairedRuns:
    """Runs by the place of their configuration in the baseline, and why others were left out."""

    runs: Mapping[int, Sequence[RunRecord]]
    left_out: Counter[str] = field(default_factory=Counter)

    @property
    def notes(self) -> list[str]:
        """A sentence for each reason to leave out runs."""
        return [f"{plural(count, 'run')} left out: {reason}." for reason, count in self.left_out.items()]


def pair_runs(check: GateCheck, runs: Iterable[RunRecord]) -> PairedRuns:
    """Find the configuration of the baseline for each run; raises InvalidInput if no run has one."""
    own = {run.uid for entry in check.baseline.configurations for run in entry.runs}
    groups: dict[int, list[RunRecord]] = defaultdict(list)
    left_out: Counter[str] = Counter()
    for run in runs:
        if run.uid in own:
            left_out["the baseline holds them"] += 1
        elif run.state not in (RunState.SUCCEEDED, RunState.FAILED):
            left_out["cancelled" if run.state is RunState.CANCELLED else "not ended"] += 1
        else:
            place = find_pair(check.baseline.configurations, ConfigurationContent.of(run), check.ignored)
            if isinstance(place, str):
                left_out[f"{run.algorithm} on {run.dataset} {place}"] += 1
            else:
                groups[place].append(run)
    if not groups:
        found = "; ".join(f"{reason} ({plural(count, 'run')})" for reason, count in left_out.most_common(_MOST_LISTED))
        raise InvalidInput(
            f"no run can be compared with baseline {check.baseline.name}: {found or 'no run matches the filter'}",
            "slamhive gate show names its configurations",
        )
    return PairedRuns(dict(sorted(groups.items())), left_out)


def lacking(t: Transaction, check: GateCheck, paired: PairedRuns) -> dict[Protocol, list[int]]:
    """{protocol of the baseline: runs that succeeded and were not evaluated under it}."""
    found: dict[Protocol, list[int]] = defaultdict(list)
    for place, runs in paired.runs.items():
        protocol = check.baseline.configurations[place].protocol
        measured = measured_runs(t, runs, protocol.fingerprint)
        if len(measured) < len(runs):
            found[protocol] += [run.id for run in runs if run.id not in measured]
    return dict(found)


def measured_pairs(t: Transaction, check: GateCheck, paired: PairedRuns) -> list[RunPair]:
    """The pairs with the values of their runs.

    Raises InvalidInput for runs of another protocol or another content of the dataset: they are not comparable.
    """
    pairs = []
    names = check.baseline.names
    for place, runs in paired.runs.items():
        held, words = check.baseline.configurations[place], names[place]
        measured = measured_runs(t, runs, held.protocol.fingerprint)
        missing = [run.id for run in runs if run.id not in measured]
        if missing:
            named = ", ".join(map(str, missing[:_MOST_LISTED])) + (", ..." if len(missing) > _MOST_LISTED else "")
            raise InvalidInput(
                f"run {named} of {words} was not evaluated under the protocol of the baseline, "
                f"{held.protocol.label} ({held.protocol.fingerprint})",
                "give --evaluate to do that now",
            )
        checksum = one_checksum(runs, words)
        if None not in (checksum, held.dataset_checksum) and checksum != held.dataset_checksum:
            raise InvalidInput(
                f"dataset {held.dataset} differs from that of the baseline: its checksum is {checksum}, "
                f"that of the baseline {held.dataset_checksum}",
                "freeze a new baseline on this dataset",
            )
        pairs.append(RunPair(words, held, tuple(runs), tuple(measured[run.id] for run in runs)))
    return pairs
