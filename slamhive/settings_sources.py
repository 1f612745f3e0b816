"""Where settings come from: defaults < ``configuration.py`` < environment (``SLAMHIVE_<NAME>``) < options."""

from __future__ import annotations

import re
import runpy
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails
from pydantic_settings import EnvSettingsSource

from slamhive.errors import InvalidInput, unknown
from slamhive.input_bounds import check_value
from slamhive.settings import ENVIRONMENT_PREFIX, Settings

CONFIGURATION_FILE = "configuration.py"


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


def describe() -> list[SettingInfo]:
    """Every setting with its documentation, in definition order."""
    return [
        SettingInfo(name.upper(), _variable(name), str(field.default), _extra(name)["unit"], field.description or "")
        for name, field in Settings.model_fields.items()
    ]


def load_settings(
    project_root: Path,
    environment: Mapping[str, str] | None = None,
    options: Mapping[str, Any] | None = None,
) -> Settings:
    """Read all sources in their order; raises InvalidInput or NotFound naming the setting, its value and its source.

    Args:
        project_root: Folder that may hold ``configuration.py``; relative data roots start there.
        environment: Defaults to ``os.environ``.
        options: From the command line; None values mean "not given".
    """
    given = _given(project_root, environment, options)
    for name, (raw, source) in given.items():
        check_value(raw, f"{name.upper()} from {source}")
    try:
        settings = Settings(**{name: raw for name, (raw, _) in given.items()})
    except ValidationError as error:
        problem = error.errors()[0]
        name = str(problem["loc"][0])
        raw, source = given[name]
        raise InvalidInput(f"{name.upper()}={raw!r} from {source}: {_problem(name, problem)}") from None
    return settings.model_copy(update={"data": project_root / settings.data.expanduser()})


def settings_in_force(
    project_root: Path,
    environment: Mapping[str, str] | None = None,
    options: Mapping[str, Any] | None = None,
) -> list[SettingInForce]:
    """Every setting with its value and where that comes from, in definition order; see :func:`load_settings`.

    Keys and passwords are not shown.
    """
    given = _given(project_root, environment, options)
    settings = load_settings(project_root, environment, options)
    return [
        SettingInForce(info, _shown(name, getattr(settings, name)), given[name][1] if name in given else "default")
        for name, info in zip(Settings.model_fields, describe(), strict=True)
    ]


def _shown(name: str, value: object) -> str:
    if _extra(name)["secret"] and value:
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
    project_root: Path, environment: Mapping[str, str] | None, options: Mapping[str, Any] | None
) -> dict[str, tuple[Any, str]]:
    """The settings that are not left at their defaults: value and source. Later sources win."""
    variables = EnvSettingsSource(Settings)
    if environment is not None:
        variables.env_vars = {name.lower(): value for name, value in environment.items() if value}
    given: dict[str, tuple[Any, str]] = {}
    for name, raw in _configuration_values(project_root / CONFIGURATION_FILE).items():
        given[name] = raw, CONFIGURATION_FILE
    for name, raw in variables().items():
        given[name] = raw, f"environment variable {_variable(name)}"
    for name, raw in (options or {}).items():
        if raw is not None:
            given[name] = raw, f"option --{name.replace('_', '-')}"
    return given


def _variable(name: str) -> str:
    return ENVIRONMENT_PREFIX + name.upper()


def _configuration_values(path: Path) -> dict[str, Any]:
    """The upper-case names that ``configuration.py`` defines. It is the user's own code, run by path."""
    if not path.is_file():
        return {}
    try:
        content = runpy.run_path(str(path))
    except (Exception, SystemExit) as error:  # noqa: BLE001 - the file is the user's; whatever it raises is explained
        raise InvalidInput(f"{path} cannot be run: {type(error).__name__}: {error}") from None
    values = {key.lower(): value for key, value in content.items() if key.isupper()}
    for name in values:
        if name not in Settings.model_fields:
            raise unknown(f"setting in {path}", name.upper(), [known.upper() for known in Settings.model_fields])
    return values
