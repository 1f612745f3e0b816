"""What a request to a challenge may say."""

from __future__ import annotations

from typing import Annotated

from slamhive.errors import InvalidInput
from slamhive.schema.api_requests import Request
from slamhive.schema.fields import described
from slamhive.schema.uploads import Token


class ImageEntry(Request):
    """An image for a challenge: an upload, or a version of a package of the server."""

    upload: Annotated[
        Token | None, described("What `slamhive algorithm export` or `docker save` wrote; removed afterwards.")
    ] = None
    package: Annotated[str | None, described("NAME@NUMBER, or NAME for its newest version.", max_length=200)] = None
    algorithm: Annotated[
        str | None, described("Which algorithm of the package; null: its only one.", max_length=200)
    ] = None
    team: Annotated[str, described("The team; empty: the account.", max_length=64)] = ""
    phase: Annotated[str, described("The phase; empty: the only one that is open.", max_length=64)] = ""

    def check(self) -> None:
        """Raise InvalidInput unless it names either an upload or a package."""
        if (self.upload is None) == (self.package is None):
            raise InvalidInput("an image is either a file or a package", "name one of them")
