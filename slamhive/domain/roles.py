"""Assignment of a dataset's sensors to an algorithm's roles: by rule, or as the user chose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from slamhive.base.errors import InvalidInput, lacks
from slamhive.domain.sensors import Sensor

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


# How an algorithm learns on which topic it gets the messages of a role: the entry ``topics`` of ``algorithm.yaml``.


@dataclass(frozen=True, slots=True)
class TopicOf:
    """The topic of a role. At most one of the three is set; without any, the algorithm listens to ``/<role>``.

    Attributes:
        role: The role.
        fixed: The algorithm always listens to this topic.
        argument: A launch argument that names the topic.
        parameter: A parameter that names the topic.
    """

    role: str
    fixed: str | None = None
    argument: str | None = None
    parameter: str | None = None

    def seen(self, values: Mapping[str, object]) -> str:
        """The topic that the algorithm listens to, with the parameters ``values``."""
        if self.fixed is not None:
            return self.fixed
        value = str(values.get(self.parameter, "")) if self.parameter else ""
        return value if value.startswith("/") or not value else f"/{value}"

    @property
    def words(self) -> str:
        """Describe for people the way the recording reaches the algorithm."""
        if self.parameter is not None:
            return f"the recording is played under the value of the parameter {self.parameter}"
        way = f"launch argument {self.argument}" if self.argument else "always"
        return f"the recording is played as {self.default} ({way})"

    @property
    def default(self) -> str:
        """The topic that an argument or a parameter names unless the user sets it."""
        return self.fixed or f"/{self.role}"


@dataclass(frozen=True, slots=True)
class Remap:
    """The topic ``recorded`` is played as ``seen``; ``through`` says in words how the algorithm learns of that."""

    role: str
    recorded: str
    seen: str
    through: str

    @property
    def words(self) -> str:
        """For people: ``/cam0/image_raw is played as /left (launch argument mono_topic)``."""
        return f"{self.recorded} is played as {self.seen} ({self.through})"


def remaps_of(
    topics: Mapping[str, TopicOf], recorded: Mapping[str, str], values: Mapping[str, object], owner: str
) -> tuple[Remap, ...]:
    """The remaps of a run.

    Args:
        topics: What ``algorithm.yaml`` says, by role.
        recorded: The topic of the recording that serves each role.
        values: The parameters of the run.
        owner: The name of the algorithm, for messages.

    Raises InvalidInput if two roles would be played on one topic.
    """
    remaps: list[Remap] = []
    for role, topic in recorded.items():
        said = topics.get(role, TopicOf(role))
        if said.parameter is not None:
            through = f"parameter {said.parameter}"
        elif said.argument is not None:
            through = f"launch argument {said.argument}"
        else:
            through = "fixed in the package" if said.fixed else "topic of the role"
        remaps.append(Remap(said.role, topic, said.seen(values) or said.default, through))
    owners: dict[str, str] = {}
    for entry in remaps:
        other = owners.setdefault(entry.seen, entry.role)
        if other != entry.role:
            raise InvalidInput(
                f"{owner} would get {other} and {entry.role} on one topic, {entry.seen}", "give each a topic of its own"
            )
    return tuple(remaps)
