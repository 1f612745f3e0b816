from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session", autouse=True)
def types_read_once(request: pytest.FixtureRequest) -> Iterator[None]:
    """Definitions of messages are read once for all tests that open recordings; other tests load nothing for it."""
    if not any(item.get_closest_marker("integration") for item in request.session.items):
        yield
        return
    from tests.recordings import types_once  # noqa: PLC0415 - rosbags takes long to load

    with types_once.types_read_once():
        yield
