"""What the tests of systems need that are compiled from the sources of other projects."""

from __future__ import annotations

import pytest

from tests.real_datasets import SHARED

FROM_SOURCES = [
    pytest.mark.images,
    pytest.mark.skipif(not (SHARED / "upstream").is_dir(), reason="the sources in ../shared/upstream are not here"),
]
