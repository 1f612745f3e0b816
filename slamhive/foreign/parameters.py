"""The parameters of a drafted package: what is known of each, and from where."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from slamhive import strict_yaml
from slamhive.errors import InvalidInput
from slamhive.foreign.facts import FolderFacts, names_a_topic
from slamhive.foreign.folder import MAPPING, SCRIPTS, ForeignFolder
from slamhive.foreign.knowledge import example_of, general_name, source_of

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")
_EXAMPLE = "config_temp.yaml"
_LONGEST_HELP = 200
_ONLY_FOR_VIEWERS = frozenset({"rviz", "gui", "debug"})
SAVE_MAP = "save_map"
Plain = bool | int | float | str | list[float]


@dataclass(frozen=True, slots=True)
class DraftParameter:
    """A parameter of the draft. Without ``default`` and ``source``, each run has to give it.

    ``said_by`` says where it was found, ``note`` where its value comes from. ``choices`` are for the type ``enum``.
    """

    key: str
    type: str
    help: str
    said_by: str
    default: Plain | None = None
    source: str | None = None
    note: str = ""
    general: str | None = None
    choices: tuple[str, ...] = ()


def draft_parameters(folder: ForeignFolder, facts: FolderFacts, roles: tuple[str, ...]) -> Iterator[DraftParameter]:
    """The parameters that the templates, ``mapping.py`` and the launch files of a folder name, each once."""
    examples = _examples(folder)
    names = set(facts.placeholders) | set(facts.mapping.keys)
    topics = {entry.parameter: role for role, entry in facts.topics.items() if entry.parameter and role in roles}
    types = dict(facts.mapping.numbers)
    for name, said_by, text in _named(facts):
        if name in topics:
            help_text = f"Topic of {topics[name]}; the recording is played under this name."
            yield DraftParameter(name, "string", help_text, said_by, default=f"/{topics[name]}")
            continue
        source = source_of(name, roles)
        help_text = _help(text) or f"{name} of {said_by}."
        if source is not None:
            kind = types.get(name, source[1])
            yield DraftParameter(name, kind, help_text, said_by, source=source[0], general=general_name(name))
            continue
        value, note = _value(name, names, facts, examples)
        choices = _lens_templates(name, folder)
        if choices:
            value, note = _chosen_template(value, note, choices)
            yield DraftParameter(name, "enum", help_text, said_by, value, None, note, choices=choices)
            continue
        kind = types.get(name) or type_of(value)
        value = float(value) if kind == "float" and isinstance(value, int) else value
        yield DraftParameter(name, kind, help_text, said_by, value, None, note, general_name(name))


def plain_value(text: str) -> Plain:
    """Text as the value that YAML makes of it: number, bool, list of numbers or text."""
    try:
        value = strict_yaml.parse(f"value: {text}", "a value")["value"]
    except InvalidInput:
        return text
    return value if is_plain(value) else text


def is_plain(value: object) -> bool:
    """Whether ``value`` can be a value of a parameter."""
    if isinstance(value, list):
        return bool(value) and all(isinstance(part, int | float) and not isinstance(part, bool) for part in value)
    return isinstance(value, bool | int | float | str)


def type_of(value: Plain | None) -> str:
    """The type of a parameter with this default; text if it is not known."""
    kinds: tuple[tuple[type, str], ...] = ((bool, "bool"), (int, "int"), (float, "float"), (list, "matrix"))
    return next((name for kind, name in kinds if isinstance(value, kind)), "string")


def _named(facts: FolderFacts) -> Iterator[tuple[str, str, str]]:
    """Name, the file that names it, and its comment."""
    seen: set[str] = set()
    found: list[tuple[str, str, str]] = [
        (name, template, entry.comment) for name, (template, entry) in facts.placeholders.items()
    ]
    found += [(name, "mapping.py", "") for name in facts.mapping.keys if name != SAVE_MAP]
    if "algorithm-parameters" in facts.mapping.sections and not facts.placeholders:
        found += [
            (entry.name, "the launch file", entry.doc)
            for entry in facts.arguments.values()
            if not names_a_topic(entry) and entry.name not in _ONLY_FOR_VIEWERS
        ]
    for name, said_by, text in found:
        if name not in seen and _NAME.fullmatch(name) and ".." not in name:
            seen.add(name)
            yield name, said_by, text


def _value(name: str, names: set[str], facts: FolderFacts, examples: Mapping[str, Any]) -> tuple[Plain | None, str]:
    """The default of a parameter and where it comes from; None if nobody says it."""
    if name in examples:
        return examples[name], f"from {_EXAMPLE}"
    if facts.filled.get(name):
        return plain_value(facts.filled[name]), "from mappingtask.yaml"
    argument = facts.arguments.get(name)
    if argument is not None and argument.default is not None:
        return plain_value(argument.default), ""
    example = example_of(name, names)
    if example is not None:
        return example[0], f"from the examples of {example[1]}"
    return None, ""


def _lens_templates(name: str, folder: ForeignFolder) -> tuple[str, ...]:
    """What ``cam0_calib`` may be, by which the published VINS choose ``template_cam0_pinhole.yaml`` and the like.

    Raises InvalidInput if other cameras have such templates and this one has none.
    """
    camera = name.removesuffix("_calib")
    if camera == name:
        return ()
    templates = sorted(file.removeprefix("template_") for file in folder.scripts if file.startswith("template_"))
    found = tuple(file for file in templates if file.startswith(f"{camera}_"))
    if not found and "template_" in folder.scripts.get(MAPPING, ""):
        raise InvalidInput(
            f"the parameter {name} chooses a file template_{camera}_NAME.yaml, but {folder.path / SCRIPTS} holds none",
            "add the file",
        )
    return found


def _chosen_template(value: Plain | None, note: str, choices: tuple[str, ...]) -> tuple[Plain | None, str]:
    """The default among the templates: the one that is named elsewhere, or the only one."""
    if value in choices:
        return value, note
    return (choices[0], "the only template of this camera") if len(choices) == 1 else (None, "")


def _examples(folder: ForeignFolder) -> dict[str, Any]:
    """The values of the configuration that some folders hold as an example; an unreadable one says nothing."""
    try:
        content = strict_yaml.parse(folder.scripts.get(_EXAMPLE, "a: b"), _EXAMPLE)
    except InvalidInput:
        return {}
    values = content.get("algorithm-parameters")
    return {key: value for key, value in values.items() if is_plain(value)} if isinstance(values, dict) else {}


def _help(text: str) -> str:
    """A comment as one line of printable text."""
    line = " ".join("".join(character if character.isprintable() else " " for character in text).split())
    return line if len(line) <= _LONGEST_HELP else f"{line[: _LONGEST_HELP - 1]}…"
