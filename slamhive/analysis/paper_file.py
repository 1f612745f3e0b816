"""Analysis files of the published SLAM Hive (``group_name``, ``evaluation_form``, ``configuration_choose``).

They are converted to analysis files of SLAM Hive, and mean what the paper says. Where the published code differs from
the paper (first repeat only, failed runs at invented values, ``best`` without effect), the paper decides;
``docs/analysis.md`` lists the differences.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from slamhive.analysis.analysis_model import Combined, Expression, SetName, names_in, union_of
from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, unknown
from slamhive.domain.metrics import CATALOGUE
from slamhive.packages.published.combination import Part, only, parts_of
from slamhive.packages.published.knowledge import Numbers, meant

# Keys and values of published analysis files in the language of filters and columns.


_STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse")
_PREFIXES = {
    "dataset_resolution": "variant.resolution.scale",
    "dataset_frequency": "variant.rate.every",
}
_SEEN = {
    "image_width": "image_width",
    "image_height": "image_height",
    "image_frequency": "image_rate_hz",
    "imu_frequency": "imu_rate_hz",
}
"""Columns that say what a run saw, by the general names of parameters that said so."""


def our_key(name: str) -> str:
    """The key of a metric or parameter of the published system.

    ``ate_rmse`` is ``ate.rmse``; in ``general+nFeatures``, the name of the parameter follows the plus sign. Size and
    rate of images are columns of their own, because datasets and steps give them here.
    """
    kind, _, statistic = name.partition("_")
    if (kind in {"ate", "rpe"} and statistic in _STATISTICS) or name in {"cpu_mean", "cpu_max", "ram_max"}:
        return f"{kind}.{statistic}"
    prefix, plus, rest = name.partition("+")
    return _PREFIXES.get(prefix, _SEEN.get(rest, rest)) if plus else name


def any_of(key: str, names: Sequence[str]) -> str:
    """A filter for runs with any of these names."""
    return "(" + " or ".join(f"{key} = {quoted(name)}" for name in names) + ")"


def quoted(value: str) -> str:
    """A value in the filter language: numbers and plain words as they are, all others in quotes."""
    try:
        float(value)
    except ValueError:
        plain = value.replace("_", "").replace("-", "").replace(".", "").isalnum()
        return value if plain else json.dumps(value, ensure_ascii=False)
    return value


# Finds the one analysis in a published file that also holds prose and other documents.


MARK = "evaluation_form"
"""The key that identifies a file of the published system."""

_TOP_KEY = re.compile(r"(group_name|group_description|evaluation_form|configuration_choose|is_visualized|ids)\s*:")


def only_analysis(text: str, source: str) -> str:
    """The one analysis in a text that may also hold prose and other documents, which become empty lines.

    Published files have prose before the first key, lines of dashes between documents, and sometimes two analyses, each
    with its ``group_name``. Raises InvalidInput if there are two analyses, with the line of the second.
    """
    lines = text.split("\n")
    found: list[Part] = []
    for first, last in parts_of(lines):
        # A part is cut before each ``group_name`` after the first one.
        named = [number for number in range(first, last) if lines[number].startswith("group_name:")]
        found += pairwise([first, *named[1:], last])
    holding = [part for part in found if any(line.startswith(f"{MARK}:") for line in lines[slice(*part)])]
    if len(holding) > 1:
        raise InvalidInput(
            f"{source}, line {holding[1][0] + 1}: a second analysis begins", "give each a file of its own"
        )
    if not holding:
        return text
    first, last = holding[0]
    while not _TOP_KEY.match(lines[first]):
        first += 1
    return only(lines, (first, last))


IDS = "ids"
"""The key, of ours, that says what the numbers in such a file mean."""

_SETS = ("configurations", "combinations", "rules")
_SIGNS = {"U": "|", "I": "&"}
_FORMS = {
    "1_trajectory_comparison": "trajectories",
    "2_accuracy_metrics_comparison": "distributions",
    "3_accuracy_metrics_comparison": "by_algorithm",
    "4_usage_metrics_comparison": "usage",
    "6_scatter_diagram": "scatter",
    "7_3d_scatter_diagram": "scatter_3d",
    "8_repeatability_test": "repeatability",
}
_IGNORED_FORMS = {"algorithm_dataset_type", "5_scatter_diagram", "7_comparison_table"}
_ONE_OF_TYPE = {0: ["algorithm", "dataset"], 1: ["dataset"], 2: ["algorithm"], 3: []}
_KEYS: dict[tuple[str, ...], frozenset[str]] = {
    (): frozenset({"group_name", "group_description", MARK, "configuration_choose", "is_visualized", IDS}),
    ("configuration_choose",): frozenset(
        {
            "configuration_id",
            "comb_configuration_id",
            "trajectory_length_lower_bound",
            "limitation_rules",
            "combination_rule",
        }
    ),
    ("configuration_choose", "limitation_rules"): frozenset(
        {"algorithm_id", "dataset_id", "parameters_value", "evaluation_value"}
    ),
    ("configuration_choose", "combination_rule"): frozenset({"first_one", "first_rule", "second_one", "second_rule"}),
}
"""The keys of each section with fixed keys."""


def is_paper_file(content: object) -> bool:
    """Tell if parsed YAML is a file of the published system."""
    return isinstance(content, dict) and MARK in content


def convert(
    content: Mapping[str, Any], places: strict_yaml.Places, here: Numbers, given: Mapping[str, str]
) -> dict[str, Any]:
    """Convert the file to the content of an analysis file with the same meaning.

    Args:
        content: The parsed file.
        places: The lines of its parts, for messages.
        here: The numbers of this installation.
        given: What a user said about the numbers, see :func:`slamhive.packages.published.combination.meant`.

    Raises:
        InvalidInput: with the place of the mistake, also for a number that nobody says the meaning of.
    """
    paper = _Paper(content, places, here, meant(content.get(IDS), given, here, places.of(IDS)))
    paper.check_keys()
    sets = dict(paper.sets())
    use = paper.expression(sets)
    converted: dict[str, Any] = {
        "name": paper.text("group_name"),
        "text": paper.text("group_description", optional=True),
        "select": {name: sets[name] for name in sorted(names_in(use))},
        "use": _as_text(use),
        "one": paper.one_of(),
        "forms": list(paper.forms()),
    }
    bound = paper.chosen("configuration_choose").get("trajectory_length_lower_bound")
    converted["failed_when"] = {"tracked_fraction_below": None if bound in (None, "") else bound}
    return converted


class _Paper:
    def __init__(
        self, content: Mapping[str, Any], places: strict_yaml.Places, here: Numbers, names: Numbers | None
    ) -> None:
        self._content = content
        self._places = places
        self._here = here
        self._names = here if names is None else names

    def check_keys(self) -> None:
        """Raise InvalidInput for a key that means nothing: without it, the selection would be another one."""
        for path, known in _KEYS.items():
            for key in self.chosen(*path):
                if key not in known:
                    place = self._places.of(*path, key)
                    raise InvalidInput(f"{place}: {unknown('key', key, sorted(known)).message}")

    def text(self, key: str, *, optional: bool = False) -> str:
        value = self._content.get(key)
        if value is None and optional:
            return ""
        if not isinstance(value, str | int | float) or not str(value).strip():
            raise InvalidInput(f"{self._places.of(key)}: {key} must be text, found {value!r}")
        return str(value)

    def chosen(self, *path: str) -> Mapping[str, Any]:
        """The section at ``path``; empty if it is absent."""
        value: Any = self._content
        for depth, key in enumerate(path):
            value = value.get(key)
            if value is None:
                return {}
            if not isinstance(value, dict):
                raise self._error(path[: depth + 1], "must be keys with values", value)
        return dict(value)

    def one_of(self) -> list[str]:
        """The meaning of ``algorithm_dataset_type``: what the selection must have only one of."""
        kind = self.chosen(MARK).get("algorithm_dataset_type")
        if kind not in _ONE_OF_TYPE or isinstance(kind, bool):
            raise self._error((MARK, "algorithm_dataset_type"), "must be 0, 1, 2 or 3", kind)
        return _ONE_OF_TYPE[kind]

    def forms(self) -> Iterator[dict[str, Any]]:
        """The chosen plots with their options."""
        section = self.chosen(MARK)
        for key in section:
            if key not in _FORMS and key not in _IGNORED_FORMS and not key.startswith("9_"):
                raise InvalidInput(f"{self._places.of(MARK, key)}: {unknown('form', key, list(_FORMS)).message}")
        wanted: list[str] = []
        for key in _FORMS:
            choose = self.chosen(MARK, key).get("choose", 0)
            if choose not in (0, 1):
                raise self._error((MARK, key, "choose"), "must be 0 or 1", choose)
            wanted += [key] if choose else []
        if not wanted:
            raise InvalidInput(f"{self._places.of(MARK)}: nothing has choose: 1", "set it for at least one entry")
        for key in wanted:
            yield {"form": _FORMS[key], **self._options(key, self.chosen(MARK, key))}

    def sets(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """The sets that are not empty, of three."""
        section = self.chosen("configuration_choose")
        configurations = self._numbers(section, "configuration_id")
        if configurations:
            yield _SETS[0], {"configurations": [self._configuration(number) for number in configurations]}
        combinations = [
            self._name("experiment", number, "comb_configuration_id")
            for number in self._numbers(section, "comb_configuration_id")
        ]
        if combinations:
            yield _SETS[1], {"where": any_of("experiment", combinations)}
        where = self._where()
        if where is not None:
            yield _SETS[2], {"where": where}

    def expression(self, sets: Mapping[str, Any]) -> Expression:
        """(first) minus (second) by ``combination_rule``; empty sets are ignored."""
        rule = self.chosen("configuration_choose", "combination_rule")
        if not rule and sets:
            return union_of(sorted(sets))
        first = self._side(rule, "first", sets)
        second = self._side(rule, "second", sets)
        if first is None:
            place = self._places.of("configuration_choose", "combination_rule")
            raise InvalidInput(f"{place}: its first part has no set with a member", "use 0, 1 or 2 in first_one")
        return first if second is None else Combined("-", first, second)

    def _side(self, rule: Mapping[str, Any], side: str, sets: Mapping[str, Any]) -> Expression | None:
        operands = self._numbers(rule, f"{side}_one", least=0)
        signs = rule.get(f"{side}_rule") or []
        result: Expression | None = None
        for place, number in enumerate(operands):
            if number > 2:
                path = ("configuration_choose", "combination_rule", f"{side}_one")
                raise self._error(path, "holds 0, 1 and 2", number)
            operand = SetName(_SETS[number]) if _SETS[number] in sets else None
            if place == 0:
                result = operand
                continue
            sign = signs[place - 1] if place <= len(signs) else None
            if sign not in _SIGNS:
                path = ("configuration_choose", "combination_rule", f"{side}_rule")
                raise self._error(path, "holds U or I between each two sets", sign)
            result = _joined(_SIGNS[sign], result, operand)
        return result

    def _where(self) -> str | None:
        """The rule search as a filter; None where it matches nothing, as an absent list of algorithms does."""
        rules = self.chosen("configuration_choose", "limitation_rules")
        parts = []
        for key, field_name in (("algorithm_id", "algorithm"), ("dataset_id", "dataset")):
            listed = rules.get(key)
            if not listed:
                return None
            if listed not in ("All", ["All"]):
                numbers = self._numbers(rules, key)
                parts.append(any_of(field_name, [self._name(field_name, number, key) for number in numbers]))
        for index, text in enumerate(rules.get("parameters_value") or []):
            parts.append(self._parameter(text, index))
        parts += self._bounds(rules.get("evaluation_value") or {})
        return " and ".join(parts) or "id >= 1"

    def _parameter(self, text: object, index: int) -> str:
        """``nFeatures < 4000``; ``key: v`` and ``key = v`` are both equality."""
        place = self._places.of("configuration_choose", "limitation_rules", "parameters_value", index)
        if isinstance(text, dict) and len(text) == 1:
            ((key, value),) = text.items()
            text = f"{key} = {value}"
        if not isinstance(text, str):
            raise InvalidInput(f"{place}: expected a condition such as 'nFeatures < 4000', found {text!r}")
        for sign in ("<=", ">=", "=>", "<", ">", "=", ":"):
            key, found, value = text.partition(sign)
            if found and key.strip() and value.strip():
                return f"{our_key(key.strip())} {'=' if sign == ':' else sign} {quoted(value.strip())}"
        raise InvalidInput(f"{place}: expected a condition such as 'nFeatures < 4000', found {text!r}")

    def _bounds(self, values: object) -> Iterator[str]:
        path = ("configuration_choose", "limitation_rules", "evaluation_value")
        if not isinstance(values, dict):
            raise self._error(path, "must be keys with values", values)
        for key, value in values.items():
            name, _, kind = key.rpartition("_")
            if kind == "nolimitation" or value in (None, "") or values.get(f"{name}_nolimitation") == 1:
                continue
            metric = our_key(name)
            if kind not in {"minimum", "maximum", "maximun"} or metric not in CATALOGUE:
                raise self._error((*path, key), "is no bound of a metric", value)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise self._error((*path, key), "must be a number", value)
            number = value * 2**20 if metric == "ram.max" else value  # the published system counts MiB
            yield f"{metric} {'>=' if kind == 'minimum' else '<='} {number!r}"

    def _options(self, key: str, section: Mapping[str, Any]) -> dict[str, Any]:
        path = (MARK, key)
        if key.startswith("3_"):
            method = section.get("calculate_method", 0)
            if method not in (0, 1):
                raise self._error((*path, "calculate_method"), "must be 0 (average) or 1 (best)", method)
            return {"metric": self._axis(path, section, "metric"), "of": "best" if method == 1 else "average"}
        if key.startswith("8_"):
            return {"metrics": [self._axis(path, section, "metric")]}
        if key.startswith(("6_", "7_")):
            axes = ("x", "y", "z") if key.startswith("7_") else ("x", "y")
            options: dict[str, Any] = {axis: self._axis(path, section, f"{axis}-axis") for axis in axes}
            if section.get("extend_choose") == 1:
                thresholds = section.get("extend_threshold") or []
                multiples = section.get("extend_multiple") or []
                options |= {"coverage_thresholds": thresholds, "coverage_multiples": multiples}
            return options
        return {}

    def _axis(self, path: tuple[str, ...], section: Mapping[str, Any], name: str) -> str:
        value = section.get(name)
        if not isinstance(value, str) or not value:
            raise self._error((*path, name), "names a metric or a parameter", value)
        return our_key(value)

    def _numbers(self, section: Mapping[str, Any], key: str, least: int = 1) -> list[int]:
        values = section.get(key) or []
        fine = isinstance(values, list) and all(type(value) is int and value >= least for value in values)
        if not fine:
            place = self._places.of("configuration_choose")
            raise InvalidInput(f"{place}: {key} must be a list of numbers, found {values!r}")
        return list(values)

    def _name(self, kind: str, number: int, key: str) -> str:
        """The name of an algorithm, dataset or experiment; raises InvalidInput if nobody says what a number means."""
        known, here = (getattr(numbers, f"{kind}s") for numbers in (self._names, self._here))
        if number in known:
            return str(known[number])
        section = ("configuration_choose",) if kind == "experiment" else ("configuration_choose", "limitation_rules")
        place = self._places.of(*section, key)
        if self._names is self._here:
            listed = ", ".join(f"{entry} {name}" for entry, name in sorted(known.items())[:10]) or "none"
            raise InvalidInput(f"{place}: {key}: there is no {kind} {number} here", f"known: {listed}")
        raise self._unsaid(place, kind, number, f", where {number} is {here[number]}" if number in here else "")

    def _configuration(self, number: int) -> int:
        known = self._names.configurations
        if known is None:
            return number
        if number not in known:
            raise self._unsaid(self._places.of("configuration_choose", "configuration_id"), "configuration", number, "")
        return known[number]

    def _unsaid(self, place: strict_yaml.YamlPlace, kind: str, number: int, here: str) -> InvalidInput:
        return InvalidInput(
            f"{place}: {kind} {number} may be another one in this installation{here}",
            f"say what it is, --id {kind}:{number}={'NUMBER' if kind == 'configuration' else 'NAME'}, or that all "
            "numbers are those of this installation: --id here, or the line 'ids: here' in the file",
        )

    def _error(self, path: Sequence[str], problem: str, found: object) -> InvalidInput:
        return InvalidInput(f"{self._places.of(*path)}: {path[-1]} {problem}, found {found!r}")


def _joined(sign: str, left: Expression | None, right: Expression | None) -> Expression | None:
    """Union or intersection; None is the empty set."""
    if left is None or right is None:
        return None if sign == "&" else left or right
    return Combined(sign, left, right)


def _as_text(expression: Expression) -> str:
    if isinstance(expression, SetName):
        return expression.name
    return f"({_as_text(expression.left)} {expression.sign} {_as_text(expression.right)})"
