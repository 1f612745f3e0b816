"""The options of a model: what a field means, its unit and what is allowed. Forms, commands and messages use them.

Every command that reads runs imports this, so pydantic is loaded only when a document is read.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin, get_type_hints

from slamhive.base.errors import InvalidInput
from slamhive.domain.names import plain

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler

_SHOWN = 40


@dataclass(frozen=True, slots=True)
class Asked:
    """Meaning and allowed values of an option, for ``Annotated``.

    ``help`` is one sentence for users. ``title`` is the label, None for the name of the field. ``unit`` is that of the
    number, empty for none. Options of one ``group`` stand together in web forms. A number is at least ``ge``, more than
    ``gt`` and at most ``le``.
    """

    help: str
    title: str | None = None
    unit: str = ""
    group: str = ""
    ge: float | None = None
    gt: float | None = None
    le: float | None = None

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> Any:
        """Constraints for pydantic and the JSON Schema."""
        from slamhive.documents.model import described  # noqa: PLC0415 - loads pydantic

        rules = {key: limit for key in ("ge", "gt", "le") if (limit := getattr(self, key)) is not None}
        field = described(self.help, title=self.title, unit=self.unit, group=self.group, **rules)
        return handler.generate_schema(Annotated[kind, field])


@dataclass(frozen=True, slots=True)
class Option:
    """One field that a user can set.

    ``name`` is dotted for a field of a nested model (``stop_when.time_s``). ``kind`` is the type of a value, without
    None. ``above`` says that ``minimum`` itself is not allowed.
    """

    name: str
    kind: Any
    default: Any
    title: str
    help: str
    unit: str
    group: str
    minimum: float | None = None
    maximum: float | None = None
    above: bool = False

    @property
    def label(self) -> str:
        """The title with the unit, as messages use it: ``memory limit in MB``."""
        if "." in self.name:
            return self.name.replace(".", " ")
        title = self.title[:1].lower() + self.title[1:] if self.title[1:2].islower() else self.title
        return f"{title} in {self.unit}" if self.unit else title

    @property
    def heading(self) -> str:
        """The title with the unit, as forms and tables show it: ``Memory limit [MB]``."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def choices(self) -> tuple[str, ...]:
        """The values of an enumeration; empty for other kinds."""
        return tuple(self.kind) if isinstance(self.kind, type) and issubclass(self.kind, StrEnum) else ()

    @property
    def is_number(self) -> bool:
        """True if values are numbers."""
        return self.kind in (int, float)

    @property
    def expectation(self) -> str:
        """Describe the allowed values: ``1 to 1000``, ``a whole number above 0``."""
        number = "a whole number" if self.kind is int else "a number"
        if self.maximum is not None and self.minimum is not None:
            return f"{plain(self.minimum)} to {plain(self.maximum)}"
        if self.minimum is not None:
            return f"{number} {'above' if self.above else 'from'} {plain(self.minimum)}"
        return number if self.is_number else f"one of {', '.join(self.choices)}" if self.choices else ""

    def read(self, text: str) -> Any:
        """The value that was typed; empty text stands for the default. Raises InvalidInput."""
        text = text.strip()
        if not text:
            return self.default
        if self.kind is bool:
            return text == "yes"
        if self.is_number:
            try:
                value = self.kind(text)
            except ValueError:
                what = "a whole number" if self.kind is int else "a number"
                raise InvalidInput(f"{text[:_SHOWN]!r} is not {what}", f"use {self.expectation}") from None
            self.check(value)
            return value
        self.check(text)
        return self.kind(text) if self.choices else text

    def check(self, value: Any) -> None:
        """Raise InvalidInput for a value that is not allowed."""
        if value is None:
            return
        if self.choices and value not in self.choices:
            raise InvalidInput(f"{self.label} {str(value)[:_SHOWN]!r} is not known", f"use {self.expectation}")
        if self.is_number and not self.allows(value):
            shown = f"{value:.10g}" if isinstance(value, float) else value
            raise InvalidInput(f"{self.label} {shown} is not allowed", f"use {self.expectation}")

    def allows(self, value: float) -> bool:
        """Tell if a number is in the range of the option."""
        low = self.minimum is None or value > self.minimum or (value == self.minimum and not self.above)
        return low and math.isfinite(value) and (self.maximum is None or value <= self.maximum)


def options_of(model: type[Any], prefix: str = "") -> Iterator[Option]:
    """The described fields of a dataclass, those of nested ones included: its own in order, then inherited ones."""
    hints = get_type_hints(model, include_extras=True)
    for field in sorted(dataclasses.fields(model), key=lambda field: field.name not in model.__annotations__):
        kind, info = _parts(hints[field.name])
        if dataclasses.is_dataclass(kind):
            yield from options_of(kind, f"{prefix}{field.name}.")  # type: ignore[arg-type]
        elif info is not None:
            yield _option(prefix + field.name, kind, field, info)


def _option(name: str, kind: Any, field: dataclasses.Field[Any], info: Asked) -> Option:
    return Option(
        name=name,
        kind=kind,
        default=None if field.default is dataclasses.MISSING else field.default,
        title=info.title or name.replace("_", " ").capitalize(),
        help=info.help,
        unit=info.unit,
        group=info.group,
        minimum=info.gt if info.ge is None else info.ge,
        maximum=info.le,
        above=info.gt is not None,
    )


def _parts(annotation: Any) -> tuple[Any, Asked | None]:
    """The type without None, and how the field is described."""
    info = None
    if get_origin(annotation) is Annotated:
        annotation, *extras = get_args(annotation)
        info = next((entry for entry in extras if isinstance(entry, Asked)), None)
    if get_origin(annotation) in (Union, UnionType):
        (annotation, *_) = (part for part in get_args(annotation) if part is not type(None))
    return annotation, info
