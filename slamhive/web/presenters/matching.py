"""How an algorithm fits a dataset, for pages."""

from __future__ import annotations

from typing import Any

from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.schema.matching import Match
from slamhive.services.hive import Hive


def match_of_run(services: Hive, record: dict[str, Any], configuration_id: int) -> Match | None:
    """What the record of a run says, or what its configuration says now if the run has not started."""
    if "match" not in record:
        return match_of_configuration(services, configuration_id)
    try:
        return Match.read(record["match"])
    except InvalidInput:
        return None


def match_of_configuration(services: Hive, configuration_id: int) -> Match | None:
    """How the algorithm fits the dataset now; None if one of them is gone, or if they do not fit any more."""
    try:
        return Match.of_match(services.configurations.match(configuration_id))
    except SlamHiveError:
        return None
