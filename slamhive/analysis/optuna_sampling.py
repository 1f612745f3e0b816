"""The next runs of a search as Optuna would choose them (T. Akiba et al., KDD 2019): the one place that imports it.

Nothing is kept between calls: each makes a study of all runs so far. So a search that was killed goes on with the same
next runs, and several workers need no storage beside the database. Optuna is an extra, which ``pip install
slamhive[optimise]`` installs.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from slamhive.analysis.adaptive_search import Places, SearchSpace
from slamhive.analysis.statistics import Numbers
from slamhive.base.errors import Unavailable
from slamhive.domain.question import SearchSampler

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.samplers import BaseSampler

POPULATION = 24
"""Runs in a generation of NSGA-II. With Optuna's 50, a search of 120 runs would see two generations."""


def check_sampler(sampler: SearchSampler) -> None:
    """Raise Unavailable unless this installation has what ``sampler`` needs."""
    if sampler is not SearchSampler.MODEL and find_spec("optuna") is None:
        raise Unavailable(
            f"sampler {sampler} needs Optuna, which is not installed",
            "pip install slamhive[optimise], or leave out sampler",
        )


def suggested(
    sampler: SearchSampler,
    space: SearchSpace,
    places: Places,
    scores: Numbers,
    at_once: int,
    pending: Places,
) -> tuple[int, ...]:
    """The places of the next runs.

    A suggestion that is no candidate, because a condition leaves it out, becomes the nearest candidate.

    Args:
        sampler: One of Optuna's.
        space: The candidates.
        places: (runs,) of the runs that have ended, in order.
        scores: (runs, objectives), all finite: a failed run has the worst score.
        at_once: How many runs are to come next.
        pending: (runs,) of the runs under way.

    Raises:
        Unavailable: Optuna is not installed.
    """
    check_sampler(sampler)
    import optuna  # noqa: PLC0415 - takes half a second to load, and is an extra

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    levels, distributions = _levels(space)
    study = optuna.create_study(
        directions=["minimize"] * scores.shape[1], sampler=_sampler(sampler, len(places) + len(pending))
    )
    names = list(distributions)
    for run, (place, values) in enumerate(zip(places, scores, strict=True)):
        study.add_trial(
            optuna.trial.create_trial(
                params={name: int(level) for name, level in zip(names, levels[place], strict=True)},
                distributions=distributions,
                values=[float(value) for value in values],
                system_attrs={"NSGAIISampler:generation": run // POPULATION},
            )
        )
    for place in pending:
        study.add_trial(
            optuna.trial.create_trial(
                state=optuna.trial.TrialState.RUNNING,
                params={name: int(level) for name, level in zip(names, levels[place], strict=True)},
                distributions=distributions,
            )
        )
    chosen: list[int] = []
    for _ in range(at_once):
        asked = study.ask(distributions).params
        apart = (levels != np.array([asked[name] for name in names])).sum(axis=1)
        steps = np.abs(levels - np.array([asked[name] for name in names])).sum(axis=1)
        chosen.append(int(np.lexsort([steps, apart])[0]))
    return tuple(chosen)


def _levels(space: SearchSpace) -> tuple[Places, dict[str, BaseDistribution]]:
    """The place of each candidate on each axis, (candidates, axes), and the axes as Optuna has them.

    Where an axis does not apply, its place is 0.
    """
    from optuna.distributions import CategoricalDistribution, IntDistribution  # noqa: PLC0415 - as above

    columns: list[Places] = []
    distributions: dict[str, Any] = {}
    for axis, ordered in enumerate(space.ordered):
        known, inverse = np.unique(np.nan_to_num(space.codes[:, axis], nan=-1.0), return_inverse=True)
        columns.append(inverse.astype(np.intp))
        most = len(known) - 1
        distributions[str(axis)] = IntDistribution(0, most) if ordered else CategoricalDistribution(range(most + 1))
    return np.column_stack(columns), distributions


def _sampler(sampler: SearchSampler, seed: int) -> BaseSampler:
    """The sampler with a seed from the number of runs, so that the same runs lead to the same next ones."""
    import optuna  # noqa: PLC0415 - as above

    if sampler is SearchSampler.NSGA2:
        return optuna.samplers.NSGAIISampler(population_size=POPULATION, seed=seed)
    return optuna.samplers.TPESampler(seed=seed)
