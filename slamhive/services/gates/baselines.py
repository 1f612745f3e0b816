"""Baselines: files that hold the values of runs, frozen at one time."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from slamhive import __version__
from slamhive.clock import utc_now
from slamhive.domain.names import check_name
from slamhive.domain.numbers import plural
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import RunState
from slamhive.errors import Conflict, InvalidInput, Unavailable, unknown
from slamhive.files import make_shared_folder, remedy_of, write_aside
from slamhive.input_bounds import MOST_RECORD_BYTES, parse_json_object, read_text
from slamhive.schema.gate import Baseline, BaselineBrief, BaselineConfiguration
from slamhive.schema.record import ConfigurationContent
from slamhive.services.datasets import check_writable
from slamhive.services.gates.measuring import measured_runs
from slamhive.services.gates.pairing import pairing_key
from slamhive.services.searches import Searches
from slamhive.settings import Settings
from slamhive.store import RunRecord, Store, Transaction

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
    own = {run.protocol.fingerprint: run.protocol.label for run in runs if run.protocol is not None}
    if asked is None and len(own) > 1:
        found = "; ".join(f"{label} ({key})" for key, label in own.items())
        raise InvalidInput(
            f"the runs of {words} were evaluated under {len(own)} protocols, which are never mixed: {found}",
            "choose one with --protocol",
        )
    fingerprint = asked or next(iter(own), None)
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
