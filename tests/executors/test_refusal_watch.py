from __future__ import annotations

import pytest

from slamhive.executors.refusals import RefusalWatch

P = 3.0


@pytest.mark.parametrize(
    ("looks", "ended_at_s"),
    [
        ([(0, False), (1, False), (9, False)], None),
        ([(0, True), (1, False), (4, False), (9, False)], None),
        ([(0, True), (1, True), (2, True), (3, True), (4, True)], 3),
        ([(0, True), (2, False), (3, True)], 3),
        # A calm as long as the patience: what came before no longer counts.
        ([(0, True), (2, True), (5.5, True), (6, False), (8, True), (8.5, True)], 8.5),
        ([(0, True), (4, True), (8, True), (12, True)], None),
    ],
)
def test_a_run_is_ended_that_goes_on_being_refused(looks, ended_at_s):
    watch = RefusalWatch(P)
    ends = [now_s for now_s, refused in looks if watch.see(refused=refused, now_s=now_s)]
    assert (ends[0] if ends else None) == ended_at_s
    assert watch.refused is any(refused for _, refused in looks)


def test_without_patience_the_first_one_ends_it():
    assert RefusalWatch(0.0).see(refused=True, now_s=7.0)
