from __future__ import annotations

import pytest

from slamhive.base.errors import Unavailable
from slamhive.web.limits import MOST_ADDRESSES, RateLimit

pytestmark = pytest.mark.integration


def test_the_window_slides():
    now = [0.0]
    limit = RateLimit(2, 3600.0, lambda: now[0])
    limit.take("a", "analyses")
    now[0] = 1800.0
    limit.take("a", "analyses")
    limit.take("b", "analyses")
    now[0] = 2400.0
    with pytest.raises(Unavailable, match="your address has sent 2 analyses in 60 min") as caught:
        limit.take("a", "analyses")
    assert caught.value.remedy == "try again in 20 min"
    now[0] = 3600.0
    limit.take("a", "analyses")
    with pytest.raises(Unavailable):
        limit.take("a", "analyses")


def test_only_so_many_addresses_are_remembered():
    limit = RateLimit(1, 3600.0, lambda: 0.0)
    limit.take("first", "analyses")
    limit.take("kept", "analyses")
    for number in range(MOST_ADDRESSES - 2):
        limit.take(f"2001:db8::{number:x}", "analyses")
    with pytest.raises(Unavailable):
        limit.take("kept", "analyses")
    limit.take("one more", "analyses")
    limit.take("first", "analyses")
    with pytest.raises(Unavailable):
        limit.take("kept", "analyses")
