"""The runs that a gate checks, beside those of the baseline."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from slamhive.domain.gate import Margin
from slamhive.domain.numbers import plural
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import RunState
from slamhive.errors import InvalidInput
from slamhive.schema.gate import Baseline, BaselineConfiguration, MeasuredRun
from slamhive.schema.record import ConfigurationContent
from slamhive.services.gates.baselines import one_checksum
from slamhive.services.gates.measuring import measured_runs
from slamhive.services.gates.pairing import find_pair
from slamhive.store import RunRecord, Transaction

_MOST_NAMED = 10


@dataclass(frozen=True, slots=True)
class GateCheck:
    """What is compared with what.

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
class Pair:
    """One configuration of the baseline, and the runs to check.

    ``words`` is the name of the configuration; ``measured`` are the values of the runs, in the same order.
    """

    words: str
    held: BaselineConfiguration
    runs: tuple[RunRecord, ...]
    measured: tuple[MeasuredRun, ...]


@dataclass(frozen=True, slots=True)
class Paired:
    """Runs by the place of their configuration in the baseline, and why others were left out."""

    runs: Mapping[int, Sequence[RunRecord]]
    left_out: Counter[str] = field(default_factory=Counter)

    @property
    def notes(self) -> list[str]:
        """A sentence for each reason to leave out runs."""
        return [f"{plural(count, 'run')} left out: {reason}." for reason, count in self.left_out.items()]


def pair_runs(check: GateCheck, runs: Iterable[RunRecord]) -> Paired:
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
        found = "; ".join(f"{reason} ({plural(count, 'run')})" for reason, count in left_out.most_common(_MOST_NAMED))
        raise InvalidInput(
            f"no run can be compared with baseline {check.baseline.name}: {found or 'no run matches the filter'}",
            "slamhive gate show names its configurations",
        )
    return Paired(dict(sorted(groups.items())), left_out)


def lacking(t: Transaction, check: GateCheck, paired: Paired) -> dict[Protocol, list[int]]:
    """{protocol of the baseline: runs that succeeded and were not evaluated under it}."""
    found: dict[Protocol, list[int]] = defaultdict(list)
    for place, runs in paired.runs.items():
        protocol = check.baseline.configurations[place].protocol
        measured = measured_runs(t, runs, protocol.fingerprint)
        if len(measured) < len(runs):
            found[protocol] += [run.id for run in runs if run.id not in measured]
    return dict(found)


def measured_pairs(t: Transaction, check: GateCheck, paired: Paired) -> list[Pair]:
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
            named = ", ".join(map(str, missing[:_MOST_NAMED])) + (", ..." if len(missing) > _MOST_NAMED else "")
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
        pairs.append(Pair(words, held, tuple(runs), tuple(measured[run.id] for run in runs)))
    return pairs
