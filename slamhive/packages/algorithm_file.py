"""``algorithm.yaml`` to :class:`~slamhive.domain.algorithm.Algorithm`, also in packages that others carry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, lacks
from slamhive.base.files import hash_files
from slamhive.base.registry import Registry
from slamhive.documents.model import check_name_in, first_problem
from slamhive.domain.algorithm import (
    Algorithm,
    AlgorithmPackage,
    Base,
    Bound,
    GpuNeed,
    Input,
    LidarNeed,
    LidarNeeds,
    Requirement,
    RunUser,
)
from slamhive.domain.calibration import PointOrder
from slamhive.domain.configuration import Playback, PlaybackMode
from slamhive.domain.names import check_name, plain
from slamhive.domain.packages import PackageOrigin, PinnedImage, Weights, version_label
from slamhive.domain.parameters import Parameter, ParameterType, SensorProperty, parse_settings
from slamhive.domain.protocol import Alignment, PoseTime, TrajectoryKind
from slamhive.domain.roles import TopicOf
from slamhive.domain.sensors import SensorKind, SensorSetup
from slamhive.packages.image_context import COMPILE_STAGE
from slamhive.runtime.point_times import TimeReference, TimeUnit

# The parameters of ``algorithm.yaml``.


PlainValue = bool | int | float | str | list[float]


class ParameterModel(BaseModel):
    """One parameter."""

    model_config = ConfigDict(extra="forbid")
    type: ParameterType
    default: PlainValue | None = None
    source: str | None = Field(default=None, alias="from")
    required: bool = False
    help: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: list[str] = Field(default_factory=list)
    general: str | None = None

    @model_validator(mode="after")
    def _definition_makes_sense(self) -> ParameterModel:
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise ValueError(f"minimum {plain(self.minimum)} is larger than maximum {plain(self.maximum)}")
        if not self.required and self.default is None and self.source is None:
            raise ValueError("give a default, the property of a sensor that it is taken from, or required: true")
        if self.required and not (self.default is None and self.source is None):
            raise ValueError("a required parameter has neither a default nor a property of a sensor")
        if self.type is ParameterType.ENUM and not self.choices:
            raise ValueError("an enum needs choices")
        return self


class ModeEntry(Protocol):
    """Conditions on the mode that has a parameter."""

    @property
    def title(self) -> str:
        """For messages."""

    @property
    def inputs(self) -> Mapping[str, SensorKind]:
        """Its roles."""

    @property
    def defaults(self) -> Mapping[str, PlainValue]:
        """Its own defaults, by key."""


def check_general_names(path: Path, mode: str, parameters: dict[str, ParameterModel]) -> None:
    """A name leads to one parameter, whether it is a key or a general name; raises InvalidInput naming ``path``."""
    owners: dict[str, str] = {}
    for key, model in parameters.items():
        general = model.general
        if general is None:
            continue
        other = owners.get(general) or (general if general in parameters and general != key else None)
        if other is not None:
            raise InvalidInput(
                f"{path}: mode {mode}: the general name {general!r} of {key} is also that of {other}",
                "give each parameter of a mode a name of its own",
            )
        owners[general] = key


def read_parameter(path: Path, key: str, model: ParameterModel, mode: ModeEntry) -> Parameter:
    """The parameter ``key`` of one mode; raises InvalidInput naming ``path``."""
    raw = mode.defaults.get(key, model.default)
    parameter = Parameter(
        key=key,
        type=model.type,
        default=None,
        help=model.help,
        unit=model.unit,
        minimum=model.minimum,
        maximum=model.maximum,
        choices=tuple(model.choices),
        general=model.general,
        source=_source(path, key, model, mode),
    )
    if raw is None:
        return parameter
    try:
        return replace(parameter, default=parameter.parse(raw))
    except InvalidInput as error:
        raise InvalidInput(f"{path}: default of {error.message}", error.remedy) from None


def _source(path: Path, key: str, model: ParameterModel, mode: ModeEntry) -> SensorProperty | None:
    """The property of a sensor that the parameter is taken from; raises InvalidInput for a role that is no input."""
    if model.source is None:
        return None
    try:
        source = SensorProperty.parse(model.source)
    except InvalidInput as error:
        raise InvalidInput(f"{path}: parameter {key}: {error.message}", error.remedy) from None
    missing = [role for role in source.roles if role not in mode.inputs]
    if missing and key not in mode.defaults and model.default is None:
        raise InvalidInput(
            f"{path}: {mode.title}: parameter {key} is taken from {source}, but there is no input {missing[0]}",
            "name the parameters of the mode, or give the parameter a default",
        )
    return None if missing else source


# What ``algorithm.yaml`` says of packages that were made for the published SLAM Hive.


_TOPIC = r"^/[A-Za-z][\w/]{0,200}$"


class OriginModel(BaseModel):
    """Where the package was imported from; see :class:`slamhive.domain.algorithm.PackageOrigin`."""

    model_config = ConfigDict(extra="forbid", defer_build=True)
    source: str
    commit: str | None = None
    checksum: str | None = None
    image: str | None = None
    added: tuple[str, ...] = ()
    imported_at: str | None = None


class TopicModel(BaseModel):
    """The way in which the algorithm learns the topic of a role; see :class:`slamhive.domain.roles.TopicOf`."""

    model_config = ConfigDict(extra="forbid", defer_build=True)
    fixed: str | None = Field(default=None, pattern=_TOPIC)
    argument: str | None = Field(default=None, pattern=r"^[A-Za-z]\w{0,63}$")
    parameter: str | None = None

    @model_validator(mode="after")
    def _one_way(self) -> TopicModel:
        if sum(entry is not None for entry in (self.fixed, self.argument, self.parameter)) != 1:
            raise ValueError("say one of fixed, argument and parameter")
        return self


ALGORITHM_FILE = "algorithm.yaml"
MAPPING_SCRIPT = "slamhive/mapping.py"


class _LidarModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    point_time: LidarNeed = LidarNeed.OPTIONAL
    ring: LidarNeed = LidarNeed.IGNORED
    organised: LidarNeed = LidarNeed.IGNORED
    point_time_units: tuple[TimeUnit, ...] = ()
    point_time_references: tuple[TimeReference, ...] = ()
    point_orders: tuple[PointOrder, ...] = ()


class _ModeModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    title: str
    setup: SensorSetup
    inputs: dict[str, SensorKind]
    trajectory_role: str
    trajectory: TrajectoryKind | None = None
    pose_time: PoseTime | None = None
    name: str | None = None
    parameters: list[str] | None = None
    map_input: bool = False
    lidar: _LidarModel | None = None
    defaults: dict[str, PlainValue] = Field(default_factory=dict)
    topics: dict[str, TopicModel] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _topics_are_of_inputs(self) -> _ModeModel:
        for role in self.topics:
            if role not in self.inputs:
                raise ValueError(f"topics: {role!r} is none of the inputs {sorted(self.inputs)}")
        return self

    @model_validator(mode="after")
    def _frame_is_an_input(self) -> _ModeModel:
        if self.trajectory_role not in self.inputs:
            raise ValueError(f"trajectory_role {self.trajectory_role!r} is none of the inputs {sorted(self.inputs)}")
        return self


class _ResourcesModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    cpu_cores: float = Field(default=2.0, gt=0)
    memory_mb: int = Field(default=4096, gt=0)
    shm_mb: int | None = Field(default=None, gt=0)
    time_factor: float = Field(default=0.0, ge=0, le=1000)


class _WeightsModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=200)
    licence: str
    page: str
    address: str | None = None
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")
    size_bytes: int | None = Field(default=None, gt=0)


class _BoundModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    poses: int = Field(ge=1)
    ate_rmse_m: float | None = Field(default=None, gt=0)
    relations_m: float | None = Field(default=None, gt=0)
    relations_deg: float | None = Field(default=None, gt=0)
    alignment: Alignment
    playback_mode: PlaybackMode = PlaybackMode.SEQUENTIAL
    playback_rate: float = Field(default=1.0, ge=0.01, le=100)
    parameters: dict[str, PlainValue] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _an_error_is_limited(self) -> _BoundModel:
        if self.ate_rmse_m is None and self.relations_m is None:
            raise ValueError("give ate_rmse_m, or relations_m for a dataset without ground truth")
        return self


class _PackageModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    format: Literal[1]
    package: str
    title: str
    version: str
    upstream: str
    licence: str
    citation: str
    image: str = "own"
    system_packages: list[str] = Field(default_factory=list)
    system_libraries: list[str] = Field(default_factory=list)
    resources: _ResourcesModel = Field(default_factory=_ResourcesModel)
    reports_tracking: bool = False
    user: RunUser = RunUser.WORKER
    base: Base = Base.PYTHON
    playback: tuple[PlaybackMode, ...] = Field(default=tuple(PlaybackMode), min_length=1)
    gpu: GpuNeed = GpuNeed.NONE
    imported: OriginModel | None = None
    weights: list[_WeightsModel] = Field(default_factory=list)
    lidar: _LidarModel = Field(default_factory=_LidarModel)
    requires: dict[str, list[str] | None] = Field(default_factory=dict)
    map_output: str | None = None
    modes: dict[str, _ModeModel] = Field(min_length=1)
    parameters: dict[str, ParameterModel] = Field(default_factory=dict)
    bounds: dict[str, dict[str, _BoundModel]] = Field(default_factory=dict)


def load_algorithms(folder: Path) -> tuple[Algorithm, ...]:
    """Read ``folder/algorithm.yaml``: the algorithms of one package, one for each mode.

    A mode may narrow the package's parameters (``parameters: [names]``) and override defaults. Raises InvalidInput
    naming the file and the place.
    """
    path = folder / ALGORITHM_FILE
    content = strict_yaml.load(path)
    try:
        model = _PackageModel.model_validate(content)
    except ValidationError as error:
        raise InvalidInput(f"{path}: {first_problem(error, _PackageModel)}") from None
    _check_names(path, model)
    if not (folder / MAPPING_SCRIPT).is_file():
        raise InvalidInput(
            f"{folder} lacks {MAPPING_SCRIPT}", "the container contract starts it; see docs/container-contract.md"
        )
    if model.image == "standard":
        if (path.parent / "Dockerfile").exists():
            raise InvalidInput(f"{path}: image: standard, but there is a Dockerfile", "remove the one or the other")
        if model.base is Base.ROS1 and not (path.parent / COMPILE_STAGE).is_file():
            raise InvalidInput(
                f"{path}: image: standard with base: ros1, but there is no {COMPILE_STAGE}",
                "add the stage that compiles the nodes, as in algorithms/aloam",
            )
    package = AlgorithmPackage(
        name=model.package,
        folder=folder,
        title=model.title,
        version=model.version,
        upstream=model.upstream,
        licence=model.licence,
        citation=model.citation,
        standard_image=model.image == "standard",
        system_packages=tuple(model.system_packages),
        system_libraries=tuple(model.system_libraries),
        cpu_cores=model.resources.cpu_cores,
        memory_mb=model.resources.memory_mb,
        reports_tracking=model.reports_tracking,
        base=model.base,
        user=model.user,
        map_output=model.map_output,
        playback=model.playback,
        gpu=model.gpu,
        shm_mb=model.resources.shm_mb,
        time_factor=model.resources.time_factor,
        origin=None if model.imported is None else PackageOrigin(**model.imported.model_dump()),
        weights=tuple(Weights(**entry.model_dump()) for entry in model.weights),
        pinned_image=_pinned_image(path, model.image),
    )
    algorithms = tuple(_algorithm(path, package, name, mode, model) for name, mode in model.modes.items())
    names = [algorithm.name for algorithm in algorithms]
    for name in names:
        if names.count(name) > 1:
            raise InvalidInput(f"{path}: two modes have the name {name!r}", "give each mode a name of its own")
    return algorithms


def package_hash(folder: Path) -> str:
    """SHA-256 over the names and contents of the package's files: which version of the wrapper ran."""
    return hash_files(folder)


def _pinned_image(path: Path, text: str) -> PinnedImage | None:
    """The image that ``image`` names, None without a digest. Raises InvalidInput for a name that says nothing."""
    if text in {"own", "standard"}:
        return None
    try:
        return PinnedImage.parse(text)
    except InvalidInput as error:
        raise InvalidInput(f"{path}: image: {error.message}", f"{error.remedy}, or own, or standard") from None


def _check_names(path: Path, model: _PackageModel) -> None:
    """All names that become paths, labels, keys of the configuration or elements of a page are plain."""
    named = [("package", model.package)]
    named += [] if model.map_output is None else [("map_output", model.map_output)]
    takers = [mode for mode, content in model.modes.items() if content.map_input]
    if takers and model.map_output is None:
        raise InvalidInput(f"{path}: mode {takers[0]} has map_input, but the package has no map_output")
    for mode, content in model.modes.items():
        named += [("mode", mode), *(("role", role) for role in content.inputs)]
        named += [] if content.name is None else [("algorithm", content.name)]
    for key, parameter in model.parameters.items():
        named += [("parameter", key)]
        named += [] if parameter.general is None else [("general parameter", parameter.general)]
    for dataset, modes in model.bounds.items():
        named += [("dataset", dataset)]
        for mode in modes:
            if mode not in model.modes:
                raise lacks(f"{path}: bounds.{dataset}: the package", "mode", mode, list(model.modes))
    for kind, name in named:
        check_name_in(path, kind, name)


def _algorithm(path: Path, package: AlgorithmPackage, mode: str, model: _ModeModel, whole: _PackageModel) -> Algorithm:
    keys = list(whole.parameters) if model.parameters is None else model.parameters
    for key in [*keys, *model.defaults, *(topic.parameter for topic in model.topics.values() if topic.parameter)]:
        if key not in whole.parameters:
            raise InvalidInput(f"{path}: mode {mode} names parameter {key!r}, which is not defined")
    check_general_names(path, mode, {key: whole.parameters[key] for key in keys})
    parameters = tuple(read_parameter(path, key, whole.parameters[key], model) for key in keys)
    name = model.name or (package.name if len(whole.modes) == 1 else f"{package.name}-{mode}")
    bounds = {dataset: modes[mode] for dataset, modes in whole.bounds.items() if mode in modes}
    return Algorithm(
        name=check_name_in(path, "algorithm", name),
        package=package,
        mode=mode,
        title=model.title,
        setup=model.setup,
        inputs=tuple(Input(role, kind) for role, kind in model.inputs.items()),
        trajectory_role=model.trajectory_role,
        trajectory=model.trajectory,
        pose_time=model.pose_time,
        parameters=parameters,
        topics=tuple(TopicOf(role, **topic.model_dump()) for role, topic in model.topics.items()),
        requires=tuple(entry for entry in _requirements(path, whole) if entry.source.role in model.inputs),
        bounds=tuple(_bound(path, dataset, bound, parameters) for dataset, bound in bounds.items()),
        map_input=model.map_input,
        lidar=LidarNeeds(
            **{
                **whole.lidar.model_dump(),
                **({} if model.lidar is None else model.lidar.model_dump(exclude_unset=True)),
            }
        ),
    )


def _bound(path: Path, dataset: str, model: _BoundModel, parameters: tuple[Parameter, ...]) -> Bound:
    values = parse_settings(f"{path}: bounds.{dataset}: the mode", parameters, model.parameters)
    return Bound(
        dataset=dataset,
        poses=model.poses,
        ate_rmse_m=model.ate_rmse_m,
        alignment=model.alignment,
        playback=Playback(model.playback_mode, model.playback_rate),
        parameters={key: values[key] for key in model.parameters},
        relations_m=model.relations_m,
        relations_deg=model.relations_deg,
    )


def _requirements(path: Path, model: _PackageModel) -> Iterator[Requirement]:
    """Facts that must be known of the sensors; raises InvalidInput for a role that no mode has."""
    roles = {role for mode in model.modes.values() for role in mode.inputs}
    for text, allowed in model.requires.items():
        try:
            source = SensorProperty.parse(text)
        except InvalidInput as error:
            raise InvalidInput(f"{path}: requires: {error.message}", error.remedy) from None
        if source.other is not None or source.role not in roles:
            raise InvalidInput(
                f"{path}: requires: {text} is no property of an input", f"use {', '.join(sorted(roles))}"
            )
        yield Requirement(source, tuple(allowed or ()))


# Algorithms that other packages carry, in the entry-point group ``slamhive.algorithms``.
#
# An entry point names a Python package whose folder is the algorithm's: it holds ``algorithm.yaml`` and what
# ``docs/container-contract.md`` asks for. The entry point has the name that ``algorithm.yaml`` gives to the package.


def _read(name: str, found: Any) -> Mapping[str, Path]:
    if isinstance(found, ModuleType) and found.__file__:
        found = Path(found.__file__).parent
    if not isinstance(found, Path):
        raise InvalidInput(f"it is neither a Python package nor a Path, but of type {type(found).__name__}")
    if not (found / ALGORITHM_FILE).is_file():
        raise InvalidInput(f"{found} holds no {ALGORITHM_FILE}", "list it under package-data in pyproject.toml")
    return {check_name("algorithm package", name): found}


ALGORITHM_FOLDERS: Registry[Path] = Registry("algorithm", "slamhive.algorithms", _read)


# Packages as they were: ``<data>/versions/<package>/<number>/`` holds the folder of each version.


def version_folder(root: Path, package: str, number: int) -> Path:
    """Where the folder of a version is kept."""
    return root / package / str(number)


def kept_algorithms(root: Path) -> Iterator[Algorithm]:
    """The algorithms of all versions whose folders are kept. A folder that cannot be read is left out."""
    for path in sorted(root.glob(f"*/*/{ALGORITHM_FILE}")):
        if path.parent.name.isdecimal():
            try:
                yield from _of_folder(path.parent)
            except SlamHiveError:
                continue


def kept_algorithm(root: Path, name: str, number: int) -> Algorithm:
    """The algorithm ``name`` as it was in version ``number`` of its package; raises NotFound or InvalidInput."""
    for path in sorted(root.glob(f"*/{number}/{ALGORITHM_FILE}")):
        for algorithm in _of_folder(path.parent):
            if algorithm.name == name:
                return algorithm
    known = sorted(entry.version or 0 for entry in kept_algorithms(root) if entry.name == name)
    listed = f"kept are {', '.join(map(str, known))}" if known else "no version of it is kept"
    raise NotFound(f"there is no folder of version {version_label(name, number)}", f"{listed}; {name} is the newest")


def _of_folder(folder: Path) -> tuple[Algorithm, ...]:
    return tuple(replace(algorithm, version=int(folder.name)) for algorithm in load_algorithms(folder))
