"""Comparisons of the trust in a run as comparisons of what was measured, by the limits of the one rule."""

from __future__ import annotations

from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.external import IMPORTED
from slamhive.domain.run import RunState
from slamhive.domain.trust import DROPPED_FRAMES, LIMITS, TrustLevel
from slamhive.search.binding import Bound, Condition
from slamhive.search.fields import BUILT_IN, metric_field
from slamhive.search.grammar import Junction, join
from slamhive.search.syntax import Sign


def trust_tree(leaf: Condition) -> Bound:
    """The condition behind ``leaf``, which names levels of trust."""
    levels = list(TrustLevel) if leaf.sign is Sign.HAS else [TrustLevel(str(value)) for value in leaf.values]
    trees = {TrustLevel.HIGH: _high(), TrustLevel.LIMITED: _limited(), TrustLevel.LOW: _low()}
    ended = (RunState.SUCCEEDED.value, RunState.FAILED.value) if levels else ()
    parts: list[Bound] = [
        Condition(BUILT_IN["state"], Sign.IN, ended),
        Condition(BUILT_IN["executor"], Sign.NOT_EQUAL, (IMPORTED,)),
    ]
    if levels:
        parts.append(join("or", [trees[level] for level in levels]))
    return join("and", parts)


def _low() -> Bound:
    return _above({limit.metric: limit.low_above for limit in LIMITS})


def _limited() -> Bound:
    return join("and", [_doubtful(), Junction("not", (_low(),))])


def _high() -> Bound:
    counted = join("or", [_playback(PlaybackMode.SEQUENTIAL), Condition(metric_field(DROPPED_FRAMES), Sign.HAS)])
    return join("and", [_disturbed(yes=False), counted, Junction("not", (_doubtful(),))])


def _doubtful() -> Bound:
    return join("or", [_above({limit.metric: limit.limited_above for limit in LIMITS}), _disturbed(yes=True)])


def _above(values: dict[str, float | None]) -> Bound:
    """Whether one of these metrics exceeds its value. Some count in real time only."""
    parts: list[Bound] = []
    for limit in LIMITS:
        value = values[limit.metric]
        if value is not None:
            above = Condition(metric_field(limit.metric), Sign.MORE, (value,))
            parts.append(join("and", [above, _playback(PlaybackMode.REALTIME)]) if limit.realtime_only else above)
    return join("or", parts)


def _playback(mode: PlaybackMode) -> Condition:
    return Condition(BUILT_IN["playback"], Sign.EQUAL, (mode.value,))


def _disturbed(*, yes: bool) -> Condition:
    return Condition(BUILT_IN["disturbed"], Sign.EQUAL, (yes,))
