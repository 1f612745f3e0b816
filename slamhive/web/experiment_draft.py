"""An experiment being edited: its YAML, the fields, and the preview or the error."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from werkzeug.datastructures import MultiDict

from slamhive.bags.variants.steps import STEPS
from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.schema.api_requests import LONGEST_YAML
from slamhive.services.experiments import ExperimentPreview, ExperimentSource
from slamhive.services.hive import Hive
from slamhive.web.experiment_fields import (
    SOURCE,
    ExperimentFields,
    field_at,
    fields_from_form,
    fields_from_yaml,
    line_of,
    renamed,
    yaml_from_fields,
)
from slamhive.web.presenters.experiment_builder import new_step
from slamhive.web.request_input import form_text, uploaded_text

MOST_TEXT = LONGEST_YAML
"""Characters in the YAML of an experiment."""


@dataclass(frozen=True, slots=True)
class Draft:
    """The content of the page. ``text`` is what starts; ``fields`` is None if the text cannot be shown in fields.

    A draft has either a ``preview`` or an ``error``. ``line``, ``excerpt`` and ``field`` locate the error, if known.
    An empty draft has neither.
    """

    text: str
    fields: ExperimentFields | None
    preview: ExperimentPreview | None = None
    error: str = ""
    line: int | None = None
    excerpt: str = ""
    field: str | None = None


def empty_draft() -> Draft:
    """A draft without content."""
    return Draft("", ExperimentFields())


def copied(hive: Hive, name: str) -> Draft:
    """A copy of the experiment ``name`` under an unused name; raises NotFound."""
    text = hive.experiments.source(name).text
    taken = {status.name for status in hive.experiments.list()}
    stem = name[:56]
    free = next(new for number in itertools.count(2) if (new := f"{stem}-{number}") not in taken)
    return draft_from_text(hive, renamed(text, free))


def draft_from_form(hive: Hive, form: MultiDict[str, str]) -> Draft:
    """The edited draft: ``from`` names the side that was edited, ``do`` the button that was pressed."""
    action = form.get("do", "")
    if form.get("from") == "fields":
        fields = _changed(fields_from_form(form), action, form.get("kind", ""))
        text = yaml_from_fields(fields)
        return _checked(hive, text, fields)
    return draft_from_text(hive, _opened() if action == "open" else form_text("yaml"))


def draft_from_text(hive: Hive, text: str) -> Draft:
    """A draft from YAML. Text that is too long is rejected."""
    if len(text) > MOST_TEXT:
        return Draft("", None, error=f"the text has more than {MOST_TEXT:,} characters; is this the right file?")
    if not text.strip():
        return empty_draft()
    try:
        text = hive.experiments.with_datasets(ExperimentSource(text, SOURCE)).text
        fields = fields_from_yaml(text)
    except InvalidInput as error:
        return with_error(Draft(text, None), error)
    return _checked(hive, text, fields)


def with_error(draft: Draft, error: SlamHiveError) -> Draft:
    """The draft with an error and its location."""
    line = line_of(error.message)
    lines = draft.text.splitlines()
    return Draft(
        draft.text,
        draft.fields,
        error=str(error) if line is None else str(error).removeprefix(f"{SOURCE} line {line}: "),
        line=line,
        excerpt=lines[line - 1].strip() if line is not None and line <= len(lines) else "",
        field=None if line is None or draft.fields is None else field_at(draft.text, line, draft.fields),
    )


def _checked(hive: Hive, text: str, fields: ExperimentFields) -> Draft:
    draft = Draft(text, fields)
    try:
        preview = hive.experiments.preview(ExperimentSource(text, SOURCE))
    except SlamHiveError as error:
        return with_error(draft, error)
    return Draft(text, fields, preview)


def _changed(fields: ExperimentFields, action: str, kind: str) -> ExperimentFields:
    """The fields after one of their buttons was pressed."""
    what, _, number = action.partition(":")
    index = int(number) if number.isascii() and number.isdigit() and len(number) < 4 else -1
    if what == "add":
        STEPS.get(kind)
        return fields.with_step(new_step(kind))
    if what == "drop" and 0 <= index < len(fields.steps):
        return fields.without_step(index)
    if what == "earlier":
        return fields.with_step_earlier(index)
    return fields


def _opened() -> str:
    uploaded = uploaded_text("file", 4 * MOST_TEXT)
    if uploaded is None:
        raise InvalidInput("no file is selected", "select one, then press the button again")
    return uploaded[1]
