"""Datasets that an experiment chooses by a filter: ``datasets: {where: indoor and sensor = stereo}``.

The filter is replaced by the names that it describes when the experiment is planned or started. The stored file has
names, so it means the same when datasets come and go.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

from pydantic import ValidationError
from ruamel.yaml import YAML

from slamhive import strict_yaml
from slamhive.errors import InvalidInput
from slamhive.schema.validation import first_problem
from slamhive.sweep.binding import at
from slamhive.sweep.experiment_model import DatasetsWhere

KEY = "datasets"


def name_datasets(text: str, source: str, choose: Callable[[str], Sequence[str]]) -> str:
    """The experiment file with names in place of its filter over datasets; ``text`` itself if it has none.

    Args:
        text: The YAML.
        source: What to call it in messages.
        choose: The names of the datasets that a filter describes; raises InvalidInput.

    Raises:
        InvalidInput: naming source, line and what is wrong; also if no dataset fits.
    """
    content, lines = strict_yaml.parse_with_lines(text, source)
    if not isinstance(content.get(KEY), dict):
        return text
    place = strict_yaml.Places(source, lines).of(KEY, "where")
    try:
        where = DatasetsWhere.model_validate(content[KEY]).where
        names = choose(where)
    except ValidationError as error:
        raise InvalidInput(f"{place}: {KEY}.{first_problem(error, DatasetsWhere)}") from None
    except InvalidInput as error:
        raise at(place, InvalidInput(error.message, error.remedy)) from None
    if not names:
        raise InvalidInput(f"{place}: no dataset fits {where!r}", "slamhive dataset list shows all")
    start, end = _span(text)
    named = json.dumps(list(names)) + "\n" * text[start:end].count("\n")
    return f"{text[:start]}{named}{text[end:].rstrip()}\n# chosen by: {' '.join(where.split())}\n"


def _span(text: str) -> tuple[int, int]:
    """Where the value of the key stands, without the space after it; the text has been parsed already."""
    for key, value in YAML(typ="safe", pure=True).compose(text).value:
        if key.value == KEY:
            start, end = value.start_mark.index, value.end_mark.index
            return start, start + len(text[start:end].rstrip())
    raise AssertionError(text)
