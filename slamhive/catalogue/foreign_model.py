"""What ``algorithm.yaml`` says of packages that were made for the published SLAM Hive."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, model_validator

_TOPIC = r"^/[A-Za-z][\w/]{0,200}$"


class OriginModel(BaseModel):
    """Where the package was imported from; see :class:`slamhive.domain.algorithm.PackageOrigin`."""

    model_config = ConfigDict(extra="forbid", defer_build=True)
    source: str
    commit: str | None = None
    checksum: str | None = None
    image: str | None = None
    added: tuple[str, ...] = ()
    imported_at: str | None = None


class TopicModel(BaseModel):
    """How the algorithm learns of the topic of a role; see :class:`slamhive.domain.remaps.TopicOf`."""

    model_config = ConfigDict(extra="forbid", defer_build=True)
    fixed: str | None = Field(default=None, pattern=_TOPIC)
    argument: str | None = Field(default=None, pattern=r"^[A-Za-z]\w{0,63}$")
    parameter: str | None = None

    @model_validator(mode="after")
    def _one_way(self) -> TopicModel:
        if sum(entry is not None for entry in (self.fixed, self.argument, self.parameter)) != 1:
            raise ValueError("say one of fixed, argument and parameter")
        return self
