"""The catalogue: algorithm packages in the project folder, datasets in the data root.

What reads their files is imported when the first is read: many commands have a catalogue and read none.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound, SlamHiveError, Unavailable, unknown
from slamhive.base.settings import Mode, Settings
from slamhive.domain.algorithm import EXTERNAL_PACKAGE, IMPORTED, Algorithm, external_algorithm
from slamhive.domain.names import check_name
from slamhive.domain.packages import split_version, version_label
from slamhive.domain.sensors import IDENTITY4, Matrix4, SensorSetup
from slamhive.packages.published.knowledge import Numbers
from slamhive.store import AbsentStore, RunRecord, Store, Transaction

if TYPE_CHECKING:
    from slamhive.documents import catalogue as schema
    from slamhive.domain.algorithm import AlgorithmPackage
    from slamhive.domain.dataset import Dataset
    from slamhive.recordings.importing import ImportOptions, ImportPlan
    from slamhive.recordings.room import RoomOptions

# Times of modification show if any file of a kind has changed. Pages look at the catalogue several times. Listing a
# folder and asking for the status of each file takes a tenth of the time that ``Path.glob`` takes.

Stamp = tuple[int, int, int]
"""Time of the last change in ns, size in bytes and inode of a file: they differ once it has changed."""


def stamp_of(path: Path | str) -> Stamp | None:
    """Return a value that changes with the file; None if there is none, or if it cannot be reached."""
    try:
        status = os.stat(path)  # noqa: PTH116 - a Path for each would take longer than the call
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def folders_in(root: Path) -> list[str]:
    """The names of what lies in ``root``, in order, but nothing hidden; none if there is no such folder."""
    try:
        names = os.listdir(root)  # noqa: PTH208 - as above
    except OSError:
        return []
    return sorted(name for name in names if not name.startswith("."))


def stamped(root: Path, file: str) -> list[tuple[str, Stamp]]:
    """The folders in ``root`` that hold ``file``, in order of their names, with what changes with it."""
    found = ((name, stamp_of(f"{root}/{name}/{file}")) for name in folders_in(root))
    return [(name, stamp) for name, stamp in found if stamp is not None]


# ruff: noqa: PLC0415


Loaded = TypeVar("Loaded")
Progress = Callable[[float, str], None]
"""Called with the fraction done (0..1) and the current activity."""


@dataclass(frozen=True, slots=True)
class BrokenEntry:
    """A folder of an algorithm or dataset that cannot be read, and why."""

    name: str
    folder: Path
    problem: str
    is_algorithm: bool


@dataclass(frozen=True, slots=True)
class PlannedImport:
    """Plan of an import: the name of the dataset, the format that was found or named, and the work.

    ``experimental`` says what speaks for the importer if no published recording was tried; it is empty otherwise.
    """

    name: str
    format: str
    plan: ImportPlan
    experimental: str = ""

    @property
    def content(self) -> dict[str, Any]:
        """The plan as plain JSON."""
        from slamhive.documents import catalogue as schema

        plan, truth = self.plan, self.plan.truth
        return {
            "name": self.name,
            "format": self.format,
            "experimental": self.experimental,
            "duration_s": plan.duration_s,
            "needed_bytes": plan.needed_bytes,
            "sensors": [
                {**schema.SensorDocument.of(sensor).content, "messages": plan.counts[sensor.name]}
                for sensor in plan.sensors
            ],
            "groundtruth": None if truth is None else {**asdict(truth.definition), "poses": len(truth.times_s)},
            "relations": plan.relations is not None,
            "notes": list(plan.notes),
        }


class Catalogue:
    """The algorithms and datasets of one installation, read from their folders on each call.

    Folders are the truth: to add an algorithm, add a folder; no restart, no database edit. A file is parsed again
    only if it has changed.
    """

    def __init__(self, settings: Settings, project_root: Path) -> None:
        self._settings = settings
        self.project_root = project_root
        self._parsed: dict[Path, tuple[Stamp, Any]] = {}
        self._scanned: dict[str, tuple[object, Sequence[Any]]] = {}
        """What the last complete look at algorithms and datasets found, and the states of the files then."""

    def algorithms(self) -> tuple[Algorithm, ...]:
        """All runnable algorithms, sorted by name. A broken package hides only itself, see :meth:`broken`."""
        found, _ = self._scan_algorithms()
        return tuple(sorted(found, key=lambda algorithm: algorithm.name))

    def algorithm(self, name: str) -> Algorithm:
        """The algorithm called ``name``; raises NotFound, or InvalidInput if its package is broken.

        ``NAME@2`` is the algorithm as it was in version 2 of its package.
        """
        from slamhive.packages.algorithm_file import ALGORITHM_FOLDERS, kept_algorithm

        name, number = split_version(name)
        if number is not None:
            return kept_algorithm(self._settings.versions_folder, name, number)
        found, broken = self._scan_algorithms()
        by_name = {algorithm.name: algorithm for algorithm in found}
        if name in by_name:
            return by_name[name]
        modes = sorted(algorithm.name for algorithm in found if algorithm.package.name == name)
        if modes:
            raise NotFound(f"{name!r} is a package of {len(modes)} algorithms", f"choose one of {', '.join(modes)}")
        for entry in broken:
            if name == entry.name or name.startswith(f"{entry.name}-"):
                raise InvalidInput(f"algorithm {name!r} cannot be used: {entry.problem}")
        ALGORITHM_FOLDERS.refuse_broken(name)
        raise unknown("algorithm", name, list(by_name), "slamhive algorithm list shows all")

    def versioned_algorithms(self) -> dict[str, Algorithm]:
        """All algorithms by the name that users ask for: as they are now, and as they were in kept versions."""
        from slamhive.packages.algorithm_file import kept_algorithms

        kept = kept_algorithms(self._settings.versions_folder)
        return {algorithm.label: algorithm for algorithm in (*self.algorithms(), *kept)}

    def packages(self) -> tuple[AlgorithmPackage, ...]:
        """All algorithm packages, each once, sorted by name."""
        packages = {algorithm.package.name: algorithm.package for algorithm in self.algorithms()}
        return tuple(packages[name] for name in sorted(packages))

    def package(self, name: str) -> AlgorithmPackage:
        """The package called ``name``, or the package of the algorithm called ``name``."""
        for package in self.packages():
            if package.name == name:
                return package
        return self.algorithm(name).package

    def datasets(self) -> tuple[Dataset, ...]:
        """All datasets, sorted by name. A broken folder hides only itself, see :meth:`broken`."""
        found, _ = self._scan_datasets()
        return tuple(sorted(found, key=lambda dataset: dataset.name))

    def dataset(self, name: str) -> Dataset:
        """The dataset called ``name``; raises NotFound, or InvalidInput if its folder is broken."""
        found, broken = self._scan_datasets()
        by_name = {dataset.name: dataset for dataset in found}
        if name in by_name:
            return by_name[name]
        for entry in broken:
            if entry.name == name:
                raise InvalidInput(f"dataset {name!r} cannot be used: {entry.problem}")
        raise unknown("dataset", name, list(by_name), "slamhive dataset list shows all")

    def dataset_folder(self, name: str) -> Path:
        """The folder of the dataset called ``name``, whether or not it exists."""
        return self._settings.datasets_folder / name

    def dataset_in_folder(self, name: str) -> Dataset:
        """The dataset in the folder called ``name``; reads no other folder; raises InvalidInput."""
        from slamhive.packages.dataset_file import DATASET_FILE, load_dataset

        return self._load(self.dataset_folder(name) / DATASET_FILE, load_dataset)

    def broken(self) -> tuple[BrokenEntry, ...]:
        """Folders of algorithms and datasets that cannot be read, with the reason."""
        return (*self._scan_algorithms()[1], *self._scan_datasets()[1])

    def plan_import(
        self, source: Path, options: ImportOptions, *, format_name: str | None = None, name: str | None = None
    ) -> PlannedImport:
        """Say what would be made of ``source``; changes nothing.

        Args:
            source: The file or folder of a recording.
            options: What users say about it.
            format_name: The importer; None to detect it.
            name: The name of the dataset; None for that of ``source``.

        Raises:
            NotFound: There is no such importer.
            Conflict: The dataset exists already.
            InvalidInput: The name or the source cannot be used; says why.
        """
        from slamhive.recordings.importers.registry import EXPERIMENTAL, IMPORTERS, plan_import

        if format_name is not None:
            IMPORTERS.get(format_name)
        name = _name_of(source) if name is None else name
        self._refuse_taken(name)
        found, plan = plan_import(source, options, format_name)
        return PlannedImport(name, found, plan, EXPERIMENTAL.get(found, ""))

    def import_dataset(self, planned: PlannedImport, progress: Progress) -> Dataset:
        """Make the dataset as planned; a failure leaves nothing behind."""
        from slamhive.recordings.importing import perform

        return perform(planned.plan, self._new_dataset_folder(planned.name), progress)

    def render_room(self, options: RoomOptions, progress: Progress, *, replace: bool = False) -> Dataset:
        """Render the synthetic room as a new dataset."""
        from slamhive.recordings.room import render_room

        folder = self._new_dataset_folder(options.name, replace=replace)
        return render_room(folder, options, progress)

    def remove_dataset(self, name: str) -> None:
        """Delete a dataset's folder; runs that used it keep their results."""
        check_writable(self._settings)
        shutil.rmtree(self.dataset(name).folder)

    def _new_dataset_folder(self, name: str, *, replace: bool = False) -> Path:
        folder = self.dataset_folder(name)
        self._refuse_taken(name, replace=replace)
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            if folder.exists():
                shutil.rmtree(folder)
        except OSError as error:
            raise Unavailable(f"{folder} cannot be made: {error.strerror}", "check space and rights") from None
        return folder

    def _refuse_taken(self, name: str, *, replace: bool = False) -> None:
        check_writable(self._settings)
        if self.dataset_folder(check_name("dataset", name)).exists() and not replace:
            raise Conflict(f"dataset {name!r} exists already", "choose another --name, or remove it first")

    def _load(self, path: Path, load: Callable[[Path], Loaded]) -> Loaded:
        """Load the folder of ``path``, or return the cached result if the file has not changed."""
        stamp = stamp_of(path)
        if stamp is None:
            return load(path.parent)
        known = self._parsed.get(path)
        if known is None or known[0] != stamp:
            known = (stamp, load(path.parent))
            self._parsed[path] = known
        loaded: Loaded = known[1]
        return loaded

    def _scan_algorithms(self) -> tuple[Sequence[Algorithm], list[BrokenEntry]]:
        """Find algorithms and broken folders. If no file has changed, the files are not looked into."""
        from slamhive.packages.algorithm_file import ALGORITHM_FILE, ALGORITHM_FOLDERS, load_algorithms
        from slamhive.packages.published.folder import MAPPING, SCRIPTS

        own = [(root, stamped(root, ALGORITHM_FILE)) for root in self._algorithm_roots]
        plugged = [(name, folder, stamp_of(folder / ALGORITHM_FILE)) for name, folder in ALGORITHM_FOLDERS]
        # Those of the published SLAM Hive, which have no algorithm.yaml.
        strange = [
            root / name
            for root, ours in own
            for name, _ in stamped(root, f"{SCRIPTS}/{MAPPING}")
            if name not in dict(ours)
        ]
        stamps = (own, plugged, strange)
        known = self._scanned.get("algorithms")
        if known is not None and known[0] == stamps:
            return known[1], []
        folders = [(name, root / name) for root, ours in own for name, _ in ours]
        folders += [(name, folder) for name, folder, _ in plugged]
        found: list[Algorithm] = []
        broken: list[BrokenEntry] = []
        for name, folder in folders:
            path = folder / ALGORITHM_FILE
            try:
                algorithms = self._load(path, load_algorithms)
                _check_package(name, path, algorithms, found)
                found.extend(algorithms)
            except SlamHiveError as error:
                broken.append(BrokenEntry(name, folder, str(error), is_algorithm=True))
        packages = {algorithm.package.name for algorithm in found}
        for folder in strange:
            if folder.name not in packages:
                problem = f"{folder} has no {ALGORITHM_FILE}; import it: slamhive algorithm import {folder}"
                broken.append(BrokenEntry(folder.name, folder, problem, is_algorithm=True))
        self._keep("algorithms", stamps, found, broken)
        return found, broken

    def _keep(self, what: str, stamps: object, found: Sequence[Any], broken: Sequence[BrokenEntry]) -> None:
        """Keep what was found. Why a folder is broken may lie in any of its files, so it is looked into each time."""
        if broken:
            self._scanned.pop(what, None)
        else:
            self._scanned[what] = (stamps, found)

    @property
    def _algorithm_roots(self) -> tuple[Path, Path]:
        return self.project_root / "algorithms", self._settings.algorithms_folder

    def _scan_datasets(self) -> tuple[Sequence[Dataset], list[BrokenEntry]]:
        """Find datasets and broken folders, like :meth:`_scan_algorithms`."""
        from slamhive.packages.dataset_file import DATASET_FILE, load_dataset

        stamps = stamped(self._settings.datasets_folder, DATASET_FILE)
        known = self._scanned.get("datasets")
        if known is not None and known[0] == stamps:
            return known[1], []
        found: list[Dataset] = []
        broken: list[BrokenEntry] = []
        for name, _ in stamps:
            path = self._settings.datasets_folder / name / DATASET_FILE
            try:
                dataset = self._load(path, load_dataset)
                if dataset.name != name:
                    raise InvalidInput(
                        f"{path}: name {dataset.name!r} differs from its folder's", "rename the one or the other"
                    )
                found.append(dataset)
            except SlamHiveError as error:
                broken.append(BrokenEntry(name, path.parent, str(error), is_algorithm=False))
        self._keep("datasets", stamps, found, broken)
        return found, broken


def _name_of(source: Path) -> str:
    """The name of a file or folder, with ``_`` in place of what names of datasets must not contain."""
    resolved = source.resolve()
    stem = resolved.stem if resolved.is_file() else resolved.name
    return re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_-")[:64] or "dataset"


def check_writable(settings: Settings) -> None:
    """Raise Forbidden in view-only mode."""
    if settings.mode is Mode.VIEW_ONLY:
        raise Forbidden("this installation is view-only", "set MODE to workstation to change anything")


def _check_package(name: str, path: Path, algorithms: tuple[Algorithm, ...], others: list[Algorithm]) -> None:
    """Raise InvalidInput if the package is not called ``name``, or if another package has one of its names."""
    package = algorithms[0].package
    if package.name != name:
        owner = "folder" if path.parent.name == name else "entry point"
        raise InvalidInput(
            f"{path}: package {package.name!r} differs from its {owner}'s name", "rename the one or the other"
        )
    if package.name in {other.package.name for other in others}:
        raise InvalidInput(f"{path}: there is a package {package.name!r} in the project already", "rename one of them")
    taken = {other.name: other.package.name for other in others}
    for algorithm in algorithms:
        if algorithm.name in taken:
            raise InvalidInput(
                f"{path}: package {taken[algorithm.name]} has an algorithm {algorithm.name!r} already",
                "give the mode another name",
            )


def dataset_document(dataset: Dataset) -> schema.DatasetDocument:
    """A dataset as JSON shows it, and whether the file of its ground truth exists."""
    from slamhive.documents import catalogue as schema

    truth, path = dataset.groundtruth, dataset.groundtruth_path
    shown = None if truth is None else schema.GroundTruthDocument.of(truth, exists=path is not None and path.is_file())
    return schema.DatasetDocument.of(dataset, groundtruth=shown)


# Algorithms of runs: those with a package, and external ones, of which only trajectories were imported.


def algorithm_here_or_elsewhere(store: Store, catalogue: Catalogue, run: RunRecord) -> Algorithm:
    """The algorithm of a run; raises as the catalogue does.

    A run that names a version has the algorithm of that version, or, if its folder was removed, as it is now.
    """
    name = run.algorithm
    if run.package == EXTERNAL_PACKAGE:
        return external_algorithm(name, SensorSetup(store.read(lambda t: t.catalogue.algorithm(name)).mode))
    if run.asked_version is not None:
        with contextlib.suppress(NotFound):
            return catalogue.algorithm(version_label(name, run.asked_version))
    return catalogue.algorithm(name)


def trajectory_frame(store: Store, catalogue: Catalogue, run: RunRecord) -> Matrix4:
    """The pose, in the body frame, of the sensor that the trajectory describes; that of an import is the body's."""
    if run.executor == IMPORTED:
        return IDENTITY4
    algorithm = algorithm_here_or_elsewhere(store, catalogue, run)
    return algorithm.assign(catalogue.dataset(run.dataset), run.sensors)[algorithm.trajectory_role].T_body_sensor


def imported_algorithms(store: Store) -> tuple[Algorithm, ...]:
    """All external algorithms."""
    records = store.read(lambda t: t.catalogue.algorithms())
    return tuple(
        external_algorithm(record.name, SensorSetup(record.mode))
        for record in records
        if record.package == EXTERNAL_PACKAGE
    )


def choose_algorithm(store: Store, catalogue: Catalogue, name: str, setup: SensorSetup | None) -> Algorithm:
    """The algorithm of imported trajectories.

    Args:
        store: Knows the external algorithms.
        catalogue: Knows the algorithms with a package.
        name: The name of the algorithm.
        setup: The sensor setup, if the user specified it.

    Raises InvalidInput if the setup is unknown or contradicts the known one.
    """
    known = next((algorithm for algorithm in catalogue.algorithms() if algorithm.name == name), None)
    if known is None:
        known = next((algorithm for algorithm in imported_algorithms(store) if algorithm.name == name), None)
    if known is None:
        if setup is None:
            raise InvalidInput(
                f"algorithm {name} is not installed here, and what it senses with decides the default alignment",
                f"say it with --sensors {name}=SETUP ({', '.join(SensorSetup)})",
            )
        return external_algorithm(name, setup)
    if setup is not None and setup is not known.setup:
        raise InvalidInput(
            f"algorithm {name} senses with {known.setup.value} here, not with {setup.value}",
            f"leave out its --sensors, or say --sensors {name}={known.setup.value}",
        )
    return known


def stored_numbers(store: Store) -> Numbers:
    """All numbers of this installation; what no configuration has used yet has none. Empty without a data root."""

    def work(t: Transaction) -> Numbers:
        return Numbers(
            algorithms={record.id: record.name for record in t.catalogue.algorithms()},
            datasets={record.id: record.name for record in t.catalogue.datasets()},
            experiments=t.run_table.experiment_names(),
        )

    return Numbers() if isinstance(store, AbsentStore) else store.read(work)
