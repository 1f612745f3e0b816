"""Any text in the values and conditions of experiments, and any grid."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.experiments.condition import compared_names, parse_condition
from slamhive.experiments.expansion import expand
from slamhive.experiments.file import parse_experiment
from slamhive.experiments.values import parse_values
from tests.experiments.sweep_world import view
from tests.experiments.test_sweep_expand import plan

pytestmark = pytest.mark.integration  # hypothesis takes long to load


@settings(deadline=None)
@given(st.text("abnotr<>=!()[]'\", .-15\n#%", max_size=30))
def test_any_text_is_a_condition_or_refused(text):
    with suppress(InvalidInput):
        assert compared_names(parse_condition(text))


@settings(deadline=None)
@given(st.text("linog(),.|:-+ e0159\n", max_size=30))
def test_any_text_gives_values_or_is_refused(text):
    with suppress(InvalidInput):
        assert parse_values(text)


@settings(deadline=None)
@given(st.integers(-1000, 1000), st.integers(1, 50), st.integers(0, 100))
def test_ranges_are_like_arithmetic_says(first, step, count):
    assert parse_values(f"{first}:{first + step * count}:{step}") == tuple(first + step * k for k in range(count + 1))


@settings(max_examples=40, deadline=None)
@given(
    rates=st.lists(st.sampled_from([20, 10, 5, 4, 2]), min_size=1, max_size=4, unique=True),
    scales=st.lists(st.sampled_from([1, 0.8, 0.5]), min_size=1, max_size=3, unique=True),
    features=st.lists(st.integers(100, 9999), min_size=1, max_size=3, unique=True),
    algorithms=st.lists(st.sampled_from(["mono", "stereo", "icp"]), min_size=1, max_size=3, unique=True),
    where=st.sampled_from(
        ["image_rate >= 2", "image_rate > 4 or features > 500", "not image_resolution == 1 or a == icp"]
    ),
    repeats=st.integers(1, 3),
)
def test_what_is_counted_is_what_comes(rates, scales, features, algorithms, where, repeats):
    text = strict_yaml.dump(
        {
            "name": "t",
            "algorithms": algorithms,
            "datasets": "room",
            "steps": {
                "image_rate": {"step": "rate", "sensors": "camera | lidar0", "every": [20 // rate for rate in rates]},
                "image_resolution": {"step": "resolution", "sensors": "image | left", "scale": scales},
            },
            "parameters": {"features": features},
            "where": where,
            "repeats": repeats,
        }
    )
    try:
        expansion = expand(parse_experiment(text), view())
    except SlamHiveError:
        reject()
    runs = list(expansion)
    hashes = [run.content_hash for run in runs]
    assert len(set(hashes)) + expansion.merged == expansion.size.configurations
    assert len(runs) == len(set(hashes)) * repeats
    assert [run.number for run in runs] == list(range(1, len(runs) + 1))
    assert [(run.name, run.content_hash) for run in plan(text)] == [(run.name, run.content_hash) for run in runs]
