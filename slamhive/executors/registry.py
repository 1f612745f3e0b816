"""The executors, and the one that ``auto`` means on this machine."""

from __future__ import annotations

import fcntl
import uuid
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.base.registry import Registry
from slamhive.base.settings import SETTINGS, ExecutorOption
from slamhive.executors.base import Executor, ExecutorContext

AUTO = "auto"
_INSTALLATION_FILE = "installation"

ExecutorFactory = Callable[[ExecutorContext], Executor]
ExecutorFinder = Callable[[str], Executor]
"""Returns the executor of a name, as :meth:`Hive.executor` does."""


def _read(name: str, found: Any) -> Mapping[str, ExecutorFactory]:
    if not callable(found):
        raise InvalidInput(
            f"it makes no executor, but is of type {type(found).__name__}", "see docs/extend/executor.md"
        )
    options = getattr(found, "options", ())
    if not isinstance(options, tuple) or not all(isinstance(option, ExecutorOption) for option in options):
        raise InvalidInput("its options are no tuple of ExecutorOption", "see docs/extend/executor.md")
    for option in options:
        if (setting := _setting_name(name, option)) in SETTINGS:
            raise InvalidInput(f"its option {option.name} would be the setting {setting.upper()}, which SLAM Hive has")
    return {name: found}


EXECUTORS: Registry[ExecutorFactory] = Registry("executor", "slamhive.executors", _read)


@dataclass(frozen=True, slots=True)
class _LoadedLate:
    """A class or function that is imported when it makes its first executor: the Docker SDK takes 0.2 s to import.

    ``declares`` is the module with the options of the executor, if it has any. ``by_name``: it has no preference, so
    ``auto`` need not make it to find out.
    """

    module: str
    name: str
    declares: str | None = None
    by_name: bool = False

    def __call__(self, context: ExecutorContext) -> Executor:
        executor: Executor = getattr(import_module(self.module), self.name)(context)
        return executor

    @property
    def options(self) -> tuple[ExecutorOption, ...]:
        return () if self.declares is None else import_module(self.declares).OPTIONS


EXECUTORS.register("docker", _LoadedLate("slamhive.executors.docker.executor", "DockerExecutor"))
EXECUTORS.register("process", _LoadedLate("slamhive.executors.process.executor", "ProcessExecutor"))
EXECUTORS.register(
    "slurm",
    _LoadedLate("slamhive.executors.slurm.remote", "open_slurm", "slamhive.executors.slurm.options", by_name=True),
)
EXECUTORS.register(
    "kubernetes",
    _LoadedLate(
        "slamhive.executors.kubernetes.executor",
        "open_kubernetes",
        "slamhive.executors.kubernetes.options",
        by_name=True,
    ),
)


def declared_settings() -> list[ExecutorOption]:
    """The options of all executors, by the names of their settings."""
    return [
        replace(option, name=_setting_name(name, option))
        for name, factory in EXECUTORS
        for option in _options_of(factory)
    ]


def given_options(name: str, further: Mapping[str, str]) -> dict[str, str]:
    """Those options of the executor ``name`` that the settings ``further`` give a value."""
    names = {option.name: _setting_name(name, option) for option in _options_of(EXECUTORS.get(name))}
    return {option: further[setting] for option, setting in names.items() if setting in further}


def _options_of(factory: ExecutorFactory) -> tuple[ExecutorOption, ...]:
    return tuple(getattr(factory, "options", ()))


def _setting_name(executor: str, option: ExecutorOption) -> str:
    return f"{executor}_{option.name}".replace("-", "_").lower()


def open_executor(name: str, context: ExecutorContext) -> Executor:
    """The executor called ``name``, usable or not; raises NotFound that lists the choices.

    A plug-in whose executor cannot be made counts as broken from then on.
    """
    factory = EXECUTORS.get(name)
    try:
        return factory(context)
    except SlamHiveError:
        raise
    except Exception as error:
        if not EXECUTORS.is_plugin(name):
            raise
        EXECUTORS.drop(name, error)
    return EXECUTORS.get(name)(context)


def check_plugin_executors(context: ExecutorContext) -> None:
    """Make the executor of each plug-in once: one that cannot be made counts as broken from then on."""
    for name in EXECUTORS.names():
        if EXECUTORS.is_plugin(name):
            with suppress(SlamHiveError):
                open_executor(name, context).close()


def open_all(find: ExecutorFinder, *, by_name: bool = True) -> list[Executor]:
    """All executors, usable or not. Plug-ins whose executor cannot be made are left out.

    Without ``by_name``, those that ship with SLAM Hive and must be asked for by name are left out, too.
    """
    found = []
    for name, factory in EXECUTORS:
        if not by_name and isinstance(factory, _LoadedLate) and factory.by_name:
            continue
        try:
            found.append(find(name))
        except NotFound:
            continue  # the registry has warned of it, and lists it
    return found


def candidates(setting: str, find: ExecutorFinder, *, elsewhere: bool = False) -> list[Executor]:
    """The executors that ``setting`` can mean, the preferred one first. Raises NotFound for an unknown name.

    Args:
        setting: The name of one, or ``auto``.
        find: Returns the executor of a name.
        elsewhere: Only those that run algorithms on other machines; ``auto`` then means all of these. Otherwise
            they must be asked for by name.
    """
    if elsewhere:
        found = open_all(find) if setting == AUTO else [find(setting)]
        return [executor for executor in found if not executor.capabilities.takes_cores_here]
    if setting != AUTO:
        return [find(setting)]
    ranked = [(executor.capabilities.preference, executor.name, executor) for executor in open_all(find, by_name=False)]
    return [executor for preference, _, executor in sorted(ranked, key=_rank) if preference is not None]


def _rank(entry: tuple[int | None, str, Executor]) -> tuple[int, str]:
    return entry[0] or 0, entry[1]


def choose_executor(setting: str, find: ExecutorFinder, *, elsewhere: bool = False) -> tuple[Executor, str]:
    """The executor that ``setting`` means here, and the reason in words.

    ``auto`` is the most preferred executor that can be used. Raises NotFound for an unknown name, and Unavailable with
    the remedy if no executor that the setting can mean can be used. The arguments are those of :func:`candidates`.
    """
    problems: dict[str, str] = {}
    found = candidates(setting, find, elsewhere=elsewhere)
    if not found:
        names = ", ".join(executor.name for executor in candidates(AUTO, find, elsewhere=True))
        raise Unavailable(f"the executor {setting} runs algorithms on this machine only", f"choose one of: {names}")
    for executor in found:
        problem = executor.unavailable_because()
        if problem is None:
            reason = f"because {'; '.join(problems.values())}" if problems else "the first choice"
            return executor, f"{executor.name}, {'as set' if setting != AUTO else reason}"
        problems[executor.name] = problem
    if setting in problems:
        raise Unavailable(problems[setting])
    raise Unavailable(
        f"no executor can be used: {'; '.join(f'{name}: {problem}' for name, problem in problems.items())}"
    )


def installation_id(data: Path) -> str:
    """The identifier of the data root, made on first use and kept in ``<data>/installation``.

    All processes get the same one, even if several ask at the same time or are killed.
    """
    path = data / _INSTALLATION_FILE
    try:
        known = _read_id(path)
        if known:
            return known
        data.mkdir(parents=True, exist_ok=True)
        with (data / f".{_INSTALLATION_FILE}.lock").open("ab") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not _read_id(path):
                write_aside(path, uuid.uuid4().hex)
        return _read_id(path)
    except OSError as error:
        raise Unavailable(f"{path} cannot be used: {error.strerror}", "check space and rights") from None


def _read_id(path: Path) -> str:
    """The content of the file; empty if there is none."""
    try:
        return path.read_text(encoding="ascii").strip()
    except FileNotFoundError:
        return ""
