"""Which sensor of a dataset serves which role of an algorithm: by rule, or as the user chose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput, lacks

Chosen = Mapping[str, str]
"""{role: name of the sensor}; roles that are left out follow the rule."""
BY_RULE: Chosen = {}
"""No choice."""
_FORM = "write ROLE=SENSOR, for instance left=cam2"


def parse_choices(texts: Sequence[str]) -> dict[str, str]:
    """``ROLE=SENSOR`` texts as a mapping; raises InvalidInput."""
    chosen: dict[str, str] = {}
    for text in texts:
        role, equals, name = text.partition("=")
        if not role or not equals or not name:
            raise InvalidInput(f"sensor {text!r} is not clear", _FORM)
        if role in chosen:
            raise InvalidInput(f"the sensor for {role} is given twice", "give it once")
        chosen[role] = name
    return chosen


def check_choice(owner: str, dataset: str, roles: Mapping[str, Sequence[Sensor]], chosen: Chosen) -> None:
    """Raise NotFound or InvalidInput for a choice that makes no sense.

    Args:
        owner: The algorithm, for messages.
        dataset: The dataset, for messages.
        roles: The sensors that fit each role.
        chosen: What the user chose.
    """
    for role, name in chosen.items():
        if role not in roles:
            raise lacks(owner, "role", role, list(roles))
        fitting = [sensor.name for sensor in roles[role]]
        if name not in fitting:
            raise InvalidInput(
                f"{name!r} is no sensor of dataset {dataset} that fits {role} of {owner}",
                f"use {', '.join(fitting)}",
            )
        if list(chosen.values()).count(name) > 1:
            raise InvalidInput(f"sensor {name} is chosen for two roles of {owner}", "choose another for one of them")


def assign_in_order(
    roles: Mapping[str, Sequence[Sensor]], sensors: Sequence[Sensor], chosen: Chosen
) -> dict[str, Sensor]:
    """A sensor for each of ``roles``, which need the same kind; there are enough ``sensors`` of it.

    ``roles`` holds the sensors that fit each role; others are taken only if none of these is free.

    Roles without a choice get free sensors in the dataset's order, beginning after the sensor of the role before, and
    at the front after the last one. So ``left=cam2`` alone makes ``cam3`` the right camera.
    """
    named = {sensor.name: sensor for sensor in sensors}
    free = [sensor for sensor in sensors if sensor.name not in chosen.values()]
    assigned: dict[str, Sensor] = {}
    place = -1
    for role in roles:
        if role in chosen:
            assigned[role] = named[chosen[role]]
        else:
            fitting = [sensor for sensor in free if sensor in roles[role]] or free
            assigned[role] = next((sensor for sensor in fitting if sensors.index(sensor) > place), fitting[0])
            free.remove(assigned[role])
        place = sensors.index(assigned[role])
    return assigned
