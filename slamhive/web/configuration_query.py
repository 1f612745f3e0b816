"""The query in the address of the configurations page: filters and page position."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from werkzeug.datastructures import MultiDict

from slamhive.errors import InvalidInput
from slamhive.input_bounds import whole_number
from slamhive.services.configurations import parse_conditions
from slamhive.store import ConfigurationFilter
from slamhive.web.formatting import plural, thousands

CONFIGURATION_ID = "<int(max=9007199254740991):configuration_id>"
"""Configuration numbers up to what JSON and every database can store."""
PAGE_LENGTH = 50
LARGEST_PAGE = 500
_USED = {"": None, "yes": True, "no": False}


@dataclass(frozen=True, slots=True)
class ConfigurationQuery:
    """What the configurations page shows. Equal queries have equal addresses."""

    filter: ConfigurationFilter
    after: str | None
    limit: int

    @classmethod
    def from_args(cls, args: MultiDict[str, str]) -> ConfigurationQuery:
        """Read an address; raises InvalidInput naming the invalid value."""
        used = args.get("used", "")
        if used not in _USED:
            raise InvalidInput(f"unknown value {used[:40]!r} for used", "use yes or no")
        conditions = [part for text in args.getlist("where") for part in text.replace(";", "\n").splitlines()]
        return cls(
            filter=ConfigurationFilter(
                algorithms=_named(args, "algorithm"),
                datasets=_named(args, "dataset"),
                group=args.get("group", "").strip(),
                text=args.get("text", "").strip(),
                used=_USED[used],
                conditions=parse_conditions(part for part in conditions if part.strip()),
            ),
            after=args.get("after") or None,
            limit=whole_number(args.get("limit") or str(PAGE_LENGTH), "limit", 1, LARGEST_PAGE),
        )

    def args(self) -> dict[str, Any]:
        """The query as arguments of an address, without defaults."""
        wanted = self.filter
        everything = {
            "algorithm": list(wanted.algorithms),
            "dataset": list(wanted.datasets),
            "group": wanted.group,
            "text": wanted.text,
            "used": {None: "", True: "yes", False: "no"}[wanted.used],
            "where": self.where,
            "limit": "" if self.limit == PAGE_LENGTH else str(self.limit),
            "after": self.after or "",
        }
        return {name: value for name, value in everything.items() if value}

    @property
    def where(self) -> str:
        """The conditions as typed."""
        return "; ".join(map(str, self.filter.conditions))

    @property
    def restricted(self) -> bool:
        """Whether any filter is set."""
        return self.filter != ConfigurationFilter()

    def at(self, after: str | None) -> ConfigurationQuery:
        """The same query after this key; None is the first page."""
        return replace(self, after=after)

    def summary(self, shown: int, total: int) -> str:
        """What the page shows, as a sentence."""
        wanted = self.filter
        parts = [
            *(
                f"{kind} {' or '.join(names)}"
                for kind, names in (("algorithm", wanted.algorithms), ("dataset", wanted.datasets))
                if names
            ),
            *([f"in group {wanted.group}"] if wanted.group else []),
            *([f"“{wanted.text}” in name or note"] if wanted.text else []),
            *([] if wanted.used is None else ["with runs" if wanted.used else "without runs"]),
            *map(str, wanted.conditions),
            "newest first",
        ]
        following = "the next " if self.after else ""
        return f"Showing {following}{thousands(shown)} of {plural(total, 'configuration')}: {', '.join(parts)}."


def _named(args: MultiDict[str, str], name: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(part.strip() for text in args.getlist(name) for part in text.split(",") if part.strip()))
