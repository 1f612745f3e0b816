"""Configurations: what a run executes, stored under a number, named, grouped, copied and exchanged as YAML."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.configurations.changes import Changes, Label, Stored
    from slamhive.services.configurations.maps import FoundMap, find_map
    from slamhive.services.configurations.service import Checked, Configurations, put_configuration
    from slamhive.services.configurations.submission import unwatchable
    from slamhive.services.configurations.words import check_label, configuration_document, parse_conditions

__all__ = [
    "Changes",
    "Checked",
    "Configurations",
    "FoundMap",
    "Label",
    "Stored",
    "check_label",
    "configuration_document",
    "find_map",
    "parse_conditions",
    "put_configuration",
    "unwatchable",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
