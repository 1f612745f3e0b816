"""Configurations: what a run executes, stored under a number, named, grouped, copied and exchanged as YAML."""

from __future__ import annotations

from slamhive.services.configurations.changes import Changes, Label, Stored
from slamhive.services.configurations.service import Checked, Configurations, put_configuration
from slamhive.services.configurations.submission import BOUNDS, Submission, unwatchable
from slamhive.services.configurations.words import check_label, configuration_to_json, parse_conditions

__all__ = [
    "BOUNDS",
    "Changes",
    "Checked",
    "Configurations",
    "Label",
    "Stored",
    "Submission",
    "check_label",
    "configuration_to_json",
    "parse_conditions",
    "put_configuration",
    "unwatchable",
]
