"""How an algorithm learns on which topic it gets the messages of a role: the entry ``topics`` of ``algorithm.yaml``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slamhive.errors import InvalidInput


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
        """How the recording reaches the algorithm, for people."""
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
    remaps = [_remap(topics.get(role, TopicOf(role)), topic, values) for role, topic in recorded.items()]
    owners: dict[str, str] = {}
    for entry in remaps:
        other = owners.setdefault(entry.seen, entry.role)
        if other != entry.role:
            raise InvalidInput(
                f"{owner} would get {other} and {entry.role} on one topic, {entry.seen}", "give each a topic of its own"
            )
    return tuple(remaps)


def _remap(topic: TopicOf, recorded: str, values: Mapping[str, object]) -> Remap:
    seen = topic.seen(values) or topic.default
    if topic.parameter is not None:
        through = f"parameter {topic.parameter}"
    elif topic.argument is not None:
        through = f"launch argument {topic.argument}"
    else:
        through = "fixed in the package" if topic.fixed else "topic of the role"
    return Remap(topic.role, recorded, seen, through)
