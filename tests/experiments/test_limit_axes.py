"""Limits of runs are axes of experiments like any parameter."""

from __future__ import annotations

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.documents.limits import Limits
from slamhive.experiments.expansion import count, expand
from slamhive.experiments.experiment import candidates_of
from slamhive.experiments.file import parse_experiment
from tests.experiments.sweep_world import view

HEAD = "name: t\nalgorithms: stereo\ndatasets: room\n"
BUDGETS = HEAD + "limits: {cpus: 0.5 | 1, memory: 500 MB | 1 GB, slow_down: 4}\n"


def plan(text):
    return list(expand(parse_experiment(text), view()))


def test_each_combination_of_limits_is_a_cell_of_the_same_configuration():
    runs = plan(BUDGETS)
    assert [(run.cell, run.limits.cpu_cores, run.limits.memory_mb, run.limits.slow_down) for run in runs] == [
        (1, 0.5, 500, 4.0),
        (2, 0.5, 1000, 4.0),
        (3, 1.0, 500, 4.0),
        (4, 1.0, 1000, 4.0),
    ]
    assert len({run.content_hash for run in runs}) == 1
    assert runs[1].values["cpu_cores"] == 0.5
    assert runs[1].values["memory_mb"] == 1000
    assert dict(count(parse_experiment(BUDGETS), view()).axes) == {"cpu_cores": 2, "memory_mb": 2}


def test_limits_are_part_of_a_candidate():
    candidates = candidates_of((run.cell, run.values) for run in plan(BUDGETS))
    assert [candidate.label for candidate in candidates] == [
        "cpu_cores 0.5, memory_mb 500",
        "cpu_cores 0.5, memory_mb 1000",
        "cpu_cores 1, memory_mb 500",
        "cpu_cores 1, memory_mb 1000",
    ]


def test_limits_move_together_and_can_be_conditions():
    linked = plan(BUDGETS + "linked: [[cpu_cores, memory_mb]]\n")
    assert [(run.limits.cpu_cores, run.limits.memory_mb) for run in linked] == [(0.5, 500), (1.0, 1000)]
    kept = plan(BUDGETS + "where: cpu_cores >= 1 and memory_mb < 800\n")
    assert [(run.limits.cpu_cores, run.limits.memory_mb) for run in kept] == [(1.0, 500)]
    with pytest.raises(NotFound, match="memory_mb"):
        plan(HEAD + "limits: {memory: 500}\nwhere: memory_mbs < 800\n")


def test_one_value_is_a_limit_as_ever_under_either_name():
    old, new = (
        parse_experiment(HEAD + f"limits: {{{limits}}}\n")
        for limits in ("cpu_cores: 2, memory_mb: 500, timeout_s: 60", "cpus: 2, memory: 0.5 GB, timeout_s: 1 min")
    )
    assert old.limits == new.limits == Limits(cpu_cores=2.0, memory_mb=500, timeout_s=60.0)
    assert old.content_hash == new.content_hash == "a3398b20d184ae7ba49cd2d6f9dfaa3276f2d1bb56f1007cbf7843f1fd205c5d"


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ("cpus: 0.5 | 1 | 0.01", r"line 4: CPU limit in cores 0.01 is not allowed; use 0.1 to 1024"),
        ("cpus: few", r"line 4: CPU limit in cores 'few' is no number; use 0.1 to 1024"),
        ("memory: 500 MB | 1 s", r"line 4: memory limit in MB '1 s' is no whole number"),
        ("memory: 500.5", "'500.5' is no whole number"),
        ("memory: 1 GB | 1000", "the value 1000 is given twice"),
        ("cpus: 1, cpu_cores: 2", "line 4: cpu_cores and cpus are the same; keep one of them"),
        ("slow_down: 0.5", "slowed down in times 0.5 is not allowed; use 1 to 20"),
        ("cores: 2", "line 4: .*cores.*"),
    ],
)
def test_a_limit_that_makes_no_sense_is_refused_with_its_line(limits, message):
    with pytest.raises(InvalidInput, match=message):
        parse_experiment(HEAD + f"limits: {{{limits}}}\n")
