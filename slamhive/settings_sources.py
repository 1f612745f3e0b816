"""Where settings come from: defaults < ``configuration.py`` < environment (``SLAMHIVE_<NAME>``) < options."""

from __future__ import annotations

import re
import runpy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails
from pydantic_settings import EnvSettingsSource

from slamhive.errors import InvalidInput, unknown
from slamhive.input_bounds import check_value
from slamhive.project import ROOT_VARIABLE
from slamhive.settings import ENVIRONMENT_PREFIX, ExecutorOption, Settings

CONFIGURATION_FILE = "configuration.py"
_ROOT = ROOT_VARIABLE.removeprefix(ENVIRONMENT_PREFIX).lower()
"""The only variable with the prefix that is no setting. Where it is set, no executor need be asked."""


@dataclass(frozen=True, slots=True)
class SettingInfo:
    """One setting as the docs show it."""

    name: str
    environment: str
    default: str
    unit: str
    help: str


@dataclass(frozen=True, slots=True)
class SettingInForce:
    """One setting as ``slamhive settings`` shows it; ``source`` is the default, a file, a variable or an option."""

    info: SettingInfo
    value: str
    source: str


Declared = Callable[[], Sequence[ExecutorOption]]


def no_further() -> Sequence[ExecutorOption]:
    """No settings besides the fields of :class:`Settings`."""
    return ()


def describe(further: Iterable[ExecutorOption] = ()) -> list[SettingInfo]:
    """Every setting with its documentation, in definition order, and those that executors declare."""
    own = [
        SettingInfo(name.upper(), _variable(name), str(field.default), _extra(name)["unit"], field.description or "")
        for name, field in Settings.model_fields.items()
    ]
    return own + [
        SettingInfo(entry.name.upper(), _variable(entry.name), entry.default, "", entry.help) for entry in further
    ]


def load_settings(
    project_root: Path,
    environment: Mapping[str, str] | None = None,
    options: Mapping[str, Any] | None = None,
    further: Declared = no_further,
) -> Settings:
    """Read all sources in their order; raises InvalidInput or NotFound naming the setting, its value and its source.

    Args:
        project_root: Folder that may hold ``configuration.py``; relative data roots start there.
        environment: Defaults to ``os.environ``.
        options: From the command line; None values mean "not given".
        further: Returns the settings that executors declare. It is called only if a source has a name that is none of
            the fields, since it loads plug-ins.
    """
    given = _given(project_root, environment, options, further)
    for name, (raw, source) in given.items():
        check_value(raw, f"{name.upper()} from {source}")
    declared = {name: raw for name, (raw, _) in given.items() if name not in Settings.model_fields}
    for name, raw in declared.items():
        if not isinstance(raw, str):
            raise InvalidInput(f"{name.upper()}={raw!r} from {given[name][1]}: expected str")
    try:
        settings = Settings(**{name: raw for name, (raw, _) in given.items() if name not in declared})
    except ValidationError as error:
        problem = error.errors()[0]
        name = str(problem["loc"][0])
        raw, source = given[name]
        raise InvalidInput(f"{name.upper()}={raw!r} from {source}: {_problem(name, problem)}") from None
    placed = settings.model_copy(update={"data": project_root / settings.data.expanduser()})
    return placed.with_further(declared)


def settings_in_force(
    project_root: Path,
    environment: Mapping[str, str] | None = None,
    options: Mapping[str, Any] | None = None,
    further: Sequence[ExecutorOption] = (),
) -> list[SettingInForce]:
    """Every setting with its value and where that comes from, in definition order; see :func:`load_settings`.

    Keys and passwords are not shown.
    """
    given = _given(project_root, environment, options, lambda: further)
    settings = load_settings(project_root, environment, options, lambda: further)
    values = {name: (getattr(settings, name), _extra(name)["secret"]) for name in Settings.model_fields}
    values |= {entry.name: (settings.further.get(entry.name, entry.default), entry.secret) for entry in further}
    return [
        SettingInForce(info, _shown(value, secret=secret), given[name][1] if name in given else "default")
        for (name, (value, secret)), info in zip(values.items(), describe(further), strict=True)
    ]


def _shown(value: object, *, secret: bool) -> str:
    if secret and value:
        return "(not shown)"
    return re.sub(r"://.*@", "://***@", str(value))


def _extra(name: str) -> dict[str, Any]:
    extra = Settings.model_fields[name].json_schema_extra
    return extra if isinstance(extra, dict) else {}


def _problem(name: str, problem: ErrorDetails) -> str:
    """What is wrong with a value, in words."""
    bounds = {"greater_than_equal": ("at least", "ge"), "less_than_equal": ("at most", "le")}
    if problem["type"] in bounds:
        words, key = bounds[problem["type"]]
        return f"must be {words} {problem['ctx'][key]:g}"
    kind = Settings.model_fields[name].annotation
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return f"expected one of {', '.join(kind)}"
    return f"expected {getattr(kind, '__name__', kind)}"


def _given(
    project_root: Path, environment: Mapping[str, str] | None, options: Mapping[str, Any] | None, further: Declared
) -> dict[str, tuple[Any, str]]:
    """The settings that are not left at their defaults: value and source. Later sources win."""
    variables = EnvSettingsSource(Settings)
    if environment is not None:
        variables.env_vars = {name.lower(): value for name, value in environment.items() if value}
    given: dict[str, tuple[Any, str]] = {}
    for name, raw in _configuration_values(project_root / CONFIGURATION_FILE, further).items():
        given[name] = raw, CONFIGURATION_FILE
    for name, raw in (variables() | _declared_in(variables.env_vars, further)).items():
        given[name] = raw, f"environment variable {_variable(name)}"
    for name, raw in (options or {}).items():
        if raw is not None:
            given[name] = raw, f"option --{name.replace('_', '-')}"
    return given


def _variable(name: str) -> str:
    return ENVIRONMENT_PREFIX + name.upper()


def _declared_in(variables: Mapping[str, str | None], further: Declared) -> dict[str, str]:
    """The values of declared settings among environment ``variables``, whose names are in lower case."""
    prefix = ENVIRONMENT_PREFIX.lower()
    found = {key.removeprefix(prefix): value for key, value in variables.items() if key.startswith(prefix) and value}
    strange = {name: value for name, value in found.items() if name not in {_ROOT, *Settings.model_fields}}
    return {entry.name: strange[entry.name] for entry in further() if entry.name in strange} if strange else {}


def _configuration_values(path: Path, further: Declared) -> dict[str, Any]:
    """The upper-case names that ``configuration.py`` defines. It is the user's own code, run by path."""
    if not path.is_file():
        return {}
    try:
        content = runpy.run_path(str(path))
    except (Exception, SystemExit) as error:  # noqa: BLE001 - the file is the user's; whatever it raises is explained
        raise InvalidInput(f"{path} cannot be run: {type(error).__name__}: {error}") from None
    values = {key.lower(): value for key, value in content.items() if key.isupper()}
    if values.keys() - Settings.model_fields.keys():
        known = [*Settings.model_fields, *(entry.name for entry in further())]
        for name in values:
            if name not in known:
                raise unknown(f"setting in {path}", name.upper(), [entry.upper() for entry in known])
    return values
