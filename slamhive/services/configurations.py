"""Configurations: what a run executes, stored under a number, named, grouped, copied and exchanged as YAML."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, unknown
from slamhive.base.settings import Settings
from slamhive.documents import catalogue as schema
from slamhive.documents.limits import StopWhen
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration, InputMap, PlaybackMode, Variant
from slamhive.domain.dataset import Dataset
from slamhive.domain.matching import Match, match_of
from slamhive.domain.parameters import Parameter, Value, check_stored, find_parameter
from slamhive.domain.roles import Chosen
from slamhive.experiments.binding import CatalogueView
from slamhive.experiments.configuration_file import (
    ImportedConfigurations,
    configuration_from_yaml,
    configuration_to_yaml,
)
from slamhive.recordings.staging import checksum
from slamhive.recordings.variants.steps import RegisteredSteps
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets import Catalogue, VariantService, check_writable
from slamhive.store import (
    ConfigurationFilter,
    ConfigurationPage,
    ConfigurationRecord,
    ParameterCondition,
    RunRecord,
    Store,
    Transaction,
)

# Texts that users type, and records as JSON.

LONGEST_NAME = 64
LONGEST_NOTE = 2000
_CONDITION = re.compile(r"([^<>=]+)(<=|>=|=|<|>)(.*)", re.DOTALL)


def check_label(kind: str, text: str, *, empty: bool = False) -> str:
    """Check the name of a configuration or group: one line of text that is not a number; raises InvalidInput."""
    name = text.strip()
    if empty and not name:
        return ""
    digits = name.isascii() and name.isdigit()
    if not name or len(name) > LONGEST_NAME or digits or not name.isprintable():
        raise InvalidInput(
            f"{kind} name {text[:80]!r} is not allowed",
            f"use one line of 1 to {LONGEST_NAME} characters that is not a number",
        )
    return name


def check_note(text: str) -> str:
    """Strip a note; raises InvalidInput if it is too long or has control characters."""
    note = "\n".join(line.rstrip() for line in text.strip().splitlines())
    if len(note) > LONGEST_NOTE or not note.replace("\n", "").replace("\t", "").isprintable():
        raise InvalidInput(f"note {text[:40]!r}... is not allowed", f"use text of at most {LONGEST_NOTE} characters")
    return note


def parse_conditions(texts: Iterable[str]) -> tuple[ParameterCondition, ...]:
    """Parse conditions such as ``features>=1000``; raises InvalidInput."""
    found = []
    for text in texts:
        match = _CONDITION.fullmatch(text.strip())
        if match is None or not match[1].strip() or not match[3].strip():
            raise InvalidInput(
                f"condition {text[:80]!r} is not NAME=VALUE, NAME<VALUE, NAME<=VALUE, NAME>VALUE or NAME>=VALUE",
                "for example features>=1000",
            )
        found.append(ParameterCondition(match[1].strip(), match[2], match[3].strip()))
    return tuple(found)


def configuration_document(record: ConfigurationRecord) -> schema.ConfigurationDocument:
    """A configuration as JSON shows it: its content, the definitions of its parameters, and what users say about it."""
    content = record.configuration
    parameters = {
        key: schema.ParameterValue.of(record.parameters[key], value=value) for key, value in content.parameters.items()
    }
    said = {
        name: getattr(record, name) for name in ("id", "name", "note", "groups", "created_at", "runs", "experiments")
    }
    return schema.ConfigurationDocument.of(content, parameters=parameters, **said)


# Changes and their results.


@dataclass(frozen=True, slots=True)
class ConfigurationChange:
    """The differences of a copy; None keeps the original. ``parameters`` are added to those of the original."""

    algorithm: str | None = None
    dataset: str | None = None
    parameters: Mapping[str, Value] | None = None
    variant: Variant | None = None
    sensors: Chosen | None = None
    playback_mode: PlaybackMode | None = None
    playback_rate: float | None = None
    map: str | None = None


@dataclass(frozen=True, slots=True)
class Label:
    """Name, note and group of a configuration; None keeps the current text, an empty text removes it."""

    name: str | None = None
    note: str | None = None
    group: str | None = None

    def checked(self) -> Label:
        """The stripped label; raises InvalidInput for a text that is not allowed."""
        return Label(
            name=None if self.name is None else check_label("configuration", self.name, empty=True),
            note=None if self.note is None else check_note(self.note),
            group=check_label("group", self.group) if self.group else None,
        )


NO_LABEL = Label()


@dataclass(frozen=True, slots=True)
class Stored:
    """A stored configuration. ``notes`` explain, one line each, what was not taken over.

    ``created`` is false if an identical configuration existed already. ``seed`` is that of an imported file.
    """

    record: ConfigurationRecord
    created: bool
    notes: tuple[str, ...] = ()
    seed: int = 0

    @property
    def words(self) -> str:
        """``configuration 12 is new``, or ``the same as configuration 12 (half rate)``."""
        return f"{self.record.label} is new" if self.created else f"the same as {self.record.label}"


def unwatchable(rules: StopWhen, algorithms: Iterable[Algorithm]) -> str | None:
    """Say which of the rules cannot be watched for which algorithms; None if all can."""
    silent = sorted({entry.name for entry in algorithms if not entry.package.reports_tracking})
    if rules.lost_tracking_s is None or not silent:
        return None
    does = "does" if len(silent) == 1 else "do"
    return f"lost_tracking_s has no effect on {', '.join(silent)}, which {does} not say which frames are tracked"


# Maps of runs as input of others.

_UID = re.compile(r"[0-9a-f]{32}")
_MOST_DIGITS = 18


@dataclass(frozen=True, slots=True)
class FoundMap:
    """A map that a run has saved: what configurations say of it, its file, and the dataset that it shows."""

    map: InputMap
    path: Path
    dataset: str

    def note(self, dataset: str) -> str | None:
        """In words, that the map shows another dataset than the run uses; None if it is the same."""
        if dataset == self.dataset:
            return None
        return f"the map shows {self.dataset}, the run uses {dataset}: this only helps if both are of the same place"


def find_map(store: Store, runs_folder: Path, reference: str, algorithm: Algorithm) -> FoundMap:
    """The map of the run with this number or uid, for a run of ``algorithm``.

    Raises NotFound if there is no such run, InvalidInput if it has no map that the algorithm can start with.
    """
    file = algorithm.package.map_output
    if not algorithm.map_input or file is None:
        raise InvalidInput(
            f"{algorithm.name} cannot start with a map", "leave the map out, or choose another algorithm"
        )
    run = store.read(lambda t: t.runs.get(_number(t, reference)))
    path = _checked(run, runs_folder, algorithm, file)
    try:
        content = checksum(path)
    except OSError as error:
        raise InvalidInput(f"the map {path} cannot be read: {error.strerror}", "put it back") from None
    return FoundMap(InputMap(run.uid, content), path, run.dataset)


def _number(t: Transaction, reference: str) -> int:
    if _UID.fullmatch(reference):
        known = t.runs.ids_by_uid([reference])
        if reference in known:
            return known[reference]
    elif reference.isascii() and reference.isdigit() and len(reference) <= _MOST_DIGITS:
        return int(reference)
    raise InvalidInput(f"no run has the number or uid {reference[:40]!r}", "slamhive runs lists all")


def _checked(run: RunRecord, runs_folder: Path, algorithm: Algorithm, file: str) -> Path:
    if run.algorithm != algorithm.name:
        raise InvalidInput(
            f"run {run.id} has a map of {run.algorithm}, which {algorithm.name} cannot read",
            f"name a run of {algorithm.name}",
        )
    if not run.state.ended:
        raise InvalidInput(f"run {run.id} is {run.state}: its map is not complete", "wait until it has ended")
    path = RunFolder(runs_folder / str(run.id)).result / file
    if not path.is_file() or path.is_symlink():
        raise InvalidInput(f"run {run.id} has saved no map", f"repeat it with --set save_map=true: it lacks {file}")
    return path


NO_FILTER = ConfigurationFilter()


@dataclass(frozen=True, slots=True)
class Checked:
    """A configuration with its algorithm and dataset, and how they fit, after all checks that need no run."""

    algorithm: Algorithm
    dataset: Dataset
    configuration: Configuration
    match: Match


class Configurations:
    """The configurations of one installation.

    Args:
        settings: The mode decides whether changes are allowed.
        store: The database.
        catalogue: Algorithms and datasets.
        variants: Resolves pre-processing steps.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue, variants: VariantService) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._variants = variants

    def page(
        self, wanted: ConfigurationFilter = NO_FILTER, after: str | None = None, limit: int = 50
    ) -> ConfigurationPage:
        """One page, newest first; raises InvalidInput or NotFound for an invalid filter."""
        return self._store.read(lambda t: t.configuration_book.page(wanted, after, limit))

    def get(self, configuration_id: int) -> ConfigurationRecord:
        """The configuration with this number; raises NotFound."""
        return self._store.read(lambda t: t.configuration_book.get(configuration_id))

    def find(self, reference: str) -> ConfigurationRecord:
        """The configuration with this number or name; raises NotFound."""
        if reference.isascii() and reference.isdigit():
            if len(reference) > 18:
                raise NotFound(f"unknown configuration {reference}", "slamhive configuration list shows all")
            return self.get(int(reference))
        found = self._store.read(lambda t: t.configuration_book.named(reference))
        if found is None:
            raise NotFound(f"unknown configuration {reference!r}", "slamhive configuration list shows all")
        return self.get(found)

    def latest_runs(self, configuration_id: int, limit: int) -> tuple[RunRecord, ...]:
        """Its newest runs with their metrics, newest first."""

        def work(t: Transaction) -> tuple[RunRecord, ...]:
            return t.runs.get_many(t.configuration_book.latest_runs(configuration_id, limit), with_metrics=True)

        return self._store.read(work)

    def groups(self) -> dict[str, int]:
        """All groups with their number of configurations."""
        return self._store.read(lambda t: t.configuration_book.groups())

    def check_group(self, name: str) -> str:
        """``name`` if the group exists; raises NotFound."""
        known = self.groups()
        if name not in known:
            raise unknown("group", name, list(known))
        return name

    def check(self, submission: Submission) -> Checked:
        """Check what ``submission`` would run; its variant gets all default options.

        Raises NotFound or InvalidInput naming the wrong value.
        """
        submission.check()
        algorithm = self._catalogue.algorithm(submission.algorithm)
        dataset = self._catalogue.dataset(submission.dataset)
        used = None if submission.map is None else self.find_map(submission.map, algorithm).map
        configuration = submission.configuration(algorithm, used)
        variant = self._variants.resolve(dataset, configuration.variant)
        self._variants.plan(dataset, variant)
        chosen = algorithm.stated_choice(dataset, configuration.sensors)
        match = match_of(algorithm, self._variants.planned(dataset, variant), configuration.parameters, chosen)
        return Checked(algorithm, dataset, replace(configuration, variant=variant, sensors=chosen), match)

    def check_room(self, checked: Checked) -> None:
        """Raise InvalidInput or Unavailable if the variant cannot be made on this machine for lack of room."""
        self._variants.check(checked.dataset, checked.configuration.variant)

    def find_map(self, reference: str, algorithm: Algorithm) -> FoundMap:
        """The map of a run, for a run of ``algorithm``; raises NotFound or InvalidInput."""
        return find_map(self._store, self._settings.runs_folder, reference, algorithm)

    def map_note(self, submission: Submission) -> str | None:
        """In words, that the map of a submission shows another dataset; None if there is nothing to say."""
        if submission.map is None:
            return None
        found = self.find_map(submission.map, self._catalogue.algorithm(submission.algorithm))
        return found.note(submission.dataset)

    def same_as(self, submission: Submission) -> ConfigurationRecord | None:
        """The stored configuration identical to ``submission``, if any; raises as :meth:`check`."""
        content_hash = self.check(submission).configuration.content_hash

        def work(transaction: Transaction) -> ConfigurationRecord | None:
            found = transaction.configuration_book.with_content(content_hash)
            return None if found is None else transaction.configuration_book.get(found)

        return self._store.read(work)

    def match(self, configuration_id: int) -> Match:
        """Match algorithm and dataset of this configuration as they are now; raises NotFound or InvalidInput."""
        stored = self._store.read(lambda t: t.configurations.get(configuration_id))
        algorithm, dataset = self._catalogue.algorithm(stored.algorithm_label), self._catalogue.dataset(stored.dataset)
        return match_of(algorithm, self._variants.planned(dataset, stored.variant), stored.parameters, stored.sensors)

    def check_runnable(self, configuration_id: int) -> ConfigurationRecord:
        """The configuration, if its stored values are still valid.

        Raises InvalidInput naming the invalid value, if the definition of the algorithm was edited since.
        """
        record = self.get(configuration_id)
        algorithm = self._catalogue.algorithm(record.configuration.algorithm_label)
        check_stored(algorithm.name, algorithm.parameters, record.configuration.parameters)
        return record

    def submission(
        self, configuration_id: int, changes: ConfigurationChange | None = None
    ) -> tuple[Submission, tuple[str, ...]]:
        """The submission of this configuration with ``changes``, and notes on values that were left out.

        For another algorithm, values are matched by key or general name; its other parameters get their defaults.
        """
        record, changes = self.get(configuration_id), changes or ConfigurationChange()
        stored = record.configuration
        algorithm = self._catalogue.algorithm(changes.algorithm or stored.algorithm_label)
        own: dict[str, Value] = {}
        for name, value in (changes.parameters or {}).items():
            parameter = find_parameter(algorithm.parameters, name)
            own[name if parameter is None else parameter.key] = value
        settings: dict[str, Value] = {}
        notes: list[str] = []
        for key, value in stored.parameters.items():
            definition = record.parameters.get(key)
            parameter = find_parameter(algorithm.parameters, key)
            if parameter is None and definition is not None and definition.general is not None:
                parameter = find_parameter(algorithm.parameters, definition.general)
            if parameter is None:
                notes.append(f"{key}={value} is left out: {algorithm.name} has no such parameter")
            else:
                settings[parameter.key] = value
        submission = Submission(
            algorithm=algorithm.label,
            dataset=changes.dataset or stored.dataset,
            parameters={**settings, **own},
            playback_mode=changes.playback_mode or stored.playback.mode,
            playback_rate=stored.playback.rate if changes.playback_rate is None else changes.playback_rate,
            variant=stored.variant if changes.variant is None else changes.variant,
            sensors=stored.sensors if changes.sensors is None else changes.sensors,
            map=changes.map or (None if stored.map is None else stored.map.run),
        )
        moved = changes.algorithm is not None or changes.dataset is not None
        problem = None
        if moved and changes.sensors is None:
            try:
                algorithm.stated_choice(self._catalogue.dataset(submission.dataset), submission.sensors)
            except SlamHiveError as error:
                problem = error.message
        if problem is not None:
            submission = replace(submission, sensors={})
            notes.append(f"the choice of sensors is left out: {problem}")
        return submission, tuple(notes)

    def create(self, submission: Submission, label: Label = NO_LABEL) -> Stored:
        """Store the configuration of ``submission``, or find the identical one."""
        self._check_writable()
        return self._put(self.check(submission), label.checked())

    def copy(self, configuration_id: int, changes: ConfigurationChange, label: Label = NO_LABEL) -> Stored:
        """Store a copy with ``changes``; the original keeps its name, note and groups."""
        self._check_writable()
        submission, notes = self.submission(configuration_id, changes)
        stored = self._put(self.check(submission), label.checked())
        return replace(stored, notes=(*notes, *stored.notes))

    def modify(self, configuration_id: int, changes: ConfigurationChange, label: Label = NO_LABEL) -> Stored:
        """Replace a configuration by one with ``changes``.

        The content under a number never changes: the new configuration gets its own number. If nothing depends on the
        old one, it is deleted, and the new one takes over name, note and groups. If runs or an experiment depend on it,
        it stays, and a note says so. If the content does not change, only ``label`` is applied.
        """
        self._check_writable()
        submission, notes = self.submission(configuration_id, changes)
        checked, label = self.check(submission), label.checked()

        def work(t: Transaction) -> Stored:
            old = t.configuration_book.get(configuration_id)
            if checked.configuration.content_hash == old.configuration.content_hash:
                self._describe(t, old, label)
                return Stored(t.configuration_book.get(old.id), created=False)
            held = ""
            if old.runs:
                held = f"it has {old.runs} run{'s' if old.runs > 1 else ''}"
            elif old.experiments:
                held = f"it is part of experiment {old.experiments[0]}"
            if held:
                stored = self._put_in(t, checked, label)
                return replace(stored, notes=(*notes, f"{old.label} stays as it is: {held}"))
            stored = self._put_in(t, checked, NO_LABEL)
            t.configuration_book.delete(old.id)
            # Fields that are empty in both are taken from the old one.
            new = stored.record
            name = old.name if label.name is None and new.name is None else label.name
            note = old.note if label.note is None and not new.note else label.note
            self._describe(t, new, replace(label, name=name, note=note))
            for group in old.groups:
                t.configuration_book.add_to_group(group, [stored.record.id])
            told = f"{old.label} is gone: nothing depended on it"
            return replace(stored, record=t.configuration_book.get(stored.record.id), notes=(*notes, told))

        return self._store.write(work)

    def import_yaml(self, text: str, source: str, label: Label = NO_LABEL) -> Stored:
        """Store the configuration in a YAML text of this or of the published SLAM Hive.

        Raises NotFound or InvalidInput that names ``source`` and the place.
        """
        self._check_writable()
        imported = self.read_yaml(text, source)
        content = imported.configuration
        submission = Submission(
            content.algorithm_label,
            content.dataset,
            content.parameters,
            playback_mode=content.playback.mode,
            playback_rate=content.playback.rate,
            variant=content.variant,
            sensors=content.sensors,
            map=None if content.map is None else content.map.run,
        )
        own = Label(imported.name if label.name is None else label.name, imported.note, label.group)
        if label.note is not None:
            own = replace(own, note=label.note)
        stored = self._put(self.check(submission), own.checked())
        return replace(stored, notes=(*stored.notes, *imported.notes), seed=imported.seed)

    def read_yaml(self, text: str, source: str) -> ImportedConfigurations:
        """Parse a configuration in YAML, without storing it."""
        view = CatalogueView(
            algorithms=self._catalogue.versioned_algorithms(),
            datasets={entry.name: entry for entry in self._catalogue.datasets()},
            steps=RegisteredSteps(),
            find_map=lambda reference, algorithm: self.find_map(reference, algorithm).map,
        )
        return configuration_from_yaml(text, view, source)

    def export_yaml(self, configuration_id: int) -> str:
        """The configuration as YAML, for :meth:`import_yaml`."""
        record = self.get(configuration_id)
        return configuration_to_yaml(record.configuration, record.name, record.note)

    def describe(self, configuration_id: int, label: Label) -> ConfigurationRecord:
        """Set name, note or group; raises Conflict if the name belongs to another configuration."""
        self._check_writable()
        label = label.checked()

        def work(t: Transaction) -> ConfigurationRecord:
            self._describe(t, t.configuration_book.get(configuration_id), label)
            return t.configuration_book.get(configuration_id)

        return self._store.write(work)

    def group(self, name: str, configuration_ids: Sequence[int], *, remove: bool = False) -> None:
        """Add configurations to a group, or remove them from it; all or none."""
        self._check_writable()
        checked = check_label("group", name)

        def work(t: Transaction) -> None:
            change = t.configuration_book.remove_from_group if remove else t.configuration_book.add_to_group
            change(checked, configuration_ids)

        self._store.write(work)

    def delete(self, configuration_ids: Sequence[int]) -> None:
        """Delete configurations, all or none; raises Conflict if runs or an experiment depend on one."""
        self._check_writable()

        def work(t: Transaction) -> None:
            for configuration_id in dict.fromkeys(configuration_ids):
                t.configuration_book.delete(configuration_id)

        self._store.write(work)

    def _put(self, checked: Checked, label: Label) -> Stored:
        return self._store.write(lambda t: self._put_in(t, checked, label))

    def _put_in(self, t: Transaction, checked: Checked, label: Label) -> Stored:
        configuration_id, created = put_configuration(t, checked, utc_now())
        record, notes = t.configuration_book.get(configuration_id), []
        if not created:
            if record.name and label.name and label.name != record.name:
                notes.append(f"it keeps the name {record.name!r}")
            name = None if record.name else label.name or None
            label = replace(label, name=name, note=None if record.note else label.note or None)
        self._describe(t, record, label)
        return Stored(t.configuration_book.get(configuration_id), created, tuple(notes))

    def _describe(self, t: Transaction, record: ConfigurationRecord, label: Label) -> None:
        name = record.name if label.name is None else label.name or None
        note = record.note if label.note is None else label.note
        if (name, note) != (record.name, record.note):
            t.configuration_book.describe(record.id, name, note)
        if label.group:
            t.configuration_book.add_to_group(label.group, [record.id])

    def _check_writable(self) -> None:
        check_writable(self._settings)


def put_configuration(t: Transaction, checked: Checked, now: datetime) -> tuple[int, bool]:
    """Store a configuration with its algorithm and dataset; its number, and whether it is new."""
    return t.configurations.get_or_create(
        checked.configuration,
        t.catalogue.put_algorithm(checked.algorithm),
        t.catalogue.put_dataset(checked.dataset, now),
        now,
        checked.algorithm.parameters,
    )


# Definitions of parameters that come back from files: archives and the ledger.


def general_names(catalogue: Catalogue) -> dict[tuple[str, str], str | None]:
    """{(algorithm, key of a parameter): its general name} for the algorithms that are here."""
    return {
        (algorithm.name, parameter.key): parameter.general
        for algorithm in catalogue.algorithms()
        for parameter in algorithm.parameters
    }


def with_general_names(
    algorithm: str, definitions: Iterable[Parameter], names: Mapping[tuple[str, str], str | None]
) -> list[Parameter]:
    """Stored definitions of parameters; one that is defined here keeps its general name from here."""
    return [replace(entry, general=names.get((algorithm, entry.key), entry.general)) for entry in definitions]
