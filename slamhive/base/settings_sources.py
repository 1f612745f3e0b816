"""Where settings come from: defaults < ``configuration.py`` < environment (``SLAMHIVE_<NAME>``) < options."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from slamhive.base.bounds import check_value
from slamhive.base.errors import InvalidInput, unknown
from slamhive.base.project import ROOT_VARIABLE, place_data_root
from slamhive.base.settings import ENVIRONMENT_PREFIX, SETTINGS, ExecutorOption, SettingKind, Settings

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
        SettingInfo(name.upper(), _variable(name), str(about.default), about.unit, about.help)
        for name, about in SETTINGS.items()
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
    values: dict[str, Any] = {}
    declared: dict[str, str] = {}
    for name, (raw, source) in given.items():
        try:
            if name in SETTINGS:
                values[name] = _checked(SETTINGS[name], raw)
            else:
                declared[name] = _read(str, raw)
        except ValueError as error:
            raise InvalidInput(f"{name.upper()}={raw!r} from {source}: {error}") from None
    placed = place_data_root(project_root, values["data"].expanduser() if "data" in values else None)
    return Settings(**{**values, "data": placed}, further=declared)


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
    values = {name: (getattr(settings, name), about.secret) for name, about in SETTINGS.items()}
    values |= {entry.name: (settings.further.get(entry.name, entry.default), entry.secret) for entry in further}
    return [
        SettingInForce(info, _shown(value, secret=secret), given[name][1] if name in given else "default")
        for (name, (value, secret)), info in zip(values.items(), describe(further), strict=True)
    ]


def _shown(value: object, *, secret: bool) -> str:
    if secret and value:
        return "(not shown)"
    return re.sub(r"://.*@", "://***@", str(value))


def _checked(about: SettingKind, raw: object) -> Any:
    """The value that ``raw`` stands for; raises ValueError that says in words what is wrong."""
    value = _read(about.kind, raw)
    if about.minimum is not None and not value >= about.minimum:
        raise ValueError(f"must be at least {about.minimum:g}")
    if about.maximum is not None and not value <= about.maximum:
        raise ValueError(f"must be at most {about.maximum:g}")
    return value


def _read(kind: type[Any], raw: object) -> Any:
    expected = f"one of {', '.join(kind)}" if issubclass(kind, StrEnum) else kind.__name__
    try:
        return _READ.get(kind, kind)(raw)
    except (TypeError, ValueError):
        raise ValueError(f"expected {expected}") from None


def _text(raw: object) -> str:
    if not isinstance(raw, str):
        raise TypeError
    return raw


def _path(raw: object) -> Path:
    return raw if isinstance(raw, Path) else Path(_text(raw))


def _float(raw: object) -> float:
    if isinstance(raw, bool) or not isinstance(raw, int | float | str):
        raise TypeError
    return float(raw)


def _int(raw: object) -> int:
    """Also from text, and from a float without a fraction. A whole number need not be exact as a float."""
    if isinstance(raw, str):
        with suppress(ValueError):
            return int(raw)
    number = _float(raw)
    if not number.is_integer():
        raise ValueError
    return raw if isinstance(raw, int) else int(number)


def _bool(raw: object) -> bool:
    words = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
    word = str(raw).strip().lower()
    if not isinstance(raw, bool | int | str) or word not in words:
        raise ValueError
    return words[word]


_READ: dict[type[Any], Callable[[object], Any]] = {str: _text, Path: _path, float: _float, int: _int, bool: _bool}
"""How values are read from text, or from what ``configuration.py`` holds; those of an enumeration by itself."""


def _given(
    project_root: Path, environment: Mapping[str, str] | None, options: Mapping[str, Any] | None, further: Declared
) -> dict[str, tuple[Any, str]]:
    """The settings that are not left at their defaults: value and source. Later sources win."""
    prefix = ENVIRONMENT_PREFIX.lower()
    variables = {
        name.lower().removeprefix(prefix): value
        for name, value in (os.environ if environment is None else environment).items()
        if value and name.lower().startswith(prefix)
    }
    given: dict[str, tuple[Any, str]] = {}
    for name, raw in _configuration_values(project_root / CONFIGURATION_FILE, further).items():
        given[name] = raw, CONFIGURATION_FILE
    own = {name: raw for name, raw in variables.items() if name in SETTINGS}
    # Plug-ins are asked for the settings that they declare only where something may be one.
    strange = {name: raw for name, raw in variables.items() if name not in {_ROOT, *SETTINGS}}
    declared = {entry.name for entry in further()} if strange else set()
    for name, raw in (own | {name: raw for name, raw in strange.items() if name in declared}).items():
        given[name] = raw, f"environment variable {_variable(name)}"
    for name, raw in (options or {}).items():
        if raw is not None:
            given[name] = raw, f"option --{name.replace('_', '-')}"
    return given


def _variable(name: str) -> str:
    return ENVIRONMENT_PREFIX + name.upper()


def _configuration_values(path: Path, further: Declared) -> dict[str, Any]:
    """The upper-case names that ``configuration.py`` defines. It is the user's own code, run by path."""
    if not path.is_file():
        return {}
    import runpy  # noqa: PLC0415 - few installations have the file

    try:
        content = runpy.run_path(str(path))
    except (Exception, SystemExit) as error:  # noqa: BLE001 - the file is the user's; whatever it raises is explained
        raise InvalidInput(f"{path} cannot be run: {type(error).__name__}: {error}") from None
    values = {key.lower(): value for key, value in content.items() if key.isupper()}
    if values.keys() - SETTINGS.keys():
        known = [*SETTINGS, *(entry.name for entry in further())]
        for name in values:
            if name not in known:
                raise unknown(f"setting in {path}", name.upper(), [entry.upper() for entry in known])
    return values
