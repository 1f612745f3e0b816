"""Select the runs of an analysis: look up each set in the store, then evaluate the expression."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from slamhive.analysis.analysis_file import Analysis, set_words
from slamhive.analysis.analysis_model import SetModel
from slamhive.analysis.selection import evaluate, names_in
from slamhive.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.store import Store, Transaction

Find = Callable[[str], Sequence[int]]
"""Returns the runs that match a filter."""


def select_runs(analysis: Analysis, store: Store, find: Find, saved: Callable[[str], str]) -> tuple[int, ...]:
    """The ids of the selected runs, in order.

    Args:
        analysis: Defines the selection.
        store: For experiments, groups and configurations.
        find: Finds the runs of a filter.
        saved: Finds the filter of a saved search.

    Raises:
        InvalidInput: a filter is invalid, or nothing is selected.
        NotFound: an experiment, saved search, group or run does not exist.
    """

    def members(name: str) -> frozenset[int]:
        try:
            return frozenset(_members(analysis.sets[name], store, find, saved))
        except SlamHiveError as error:
            raise analysis.placed(name, error) from None

    sets = {name: members(name) for name in names_in(analysis.use)}
    chosen = evaluate(analysis.use, lambda name: sets[name])
    if not chosen:
        sizes = ", ".join(f"{name} holds {len(sets[name])} ({set_words(analysis.sets[name])})" for name in sorted(sets))
        raise InvalidInput(f"the selection holds no run: {sizes}", "select more, or run the experiment first")
    return tuple(sorted(chosen))


def _members(chosen: SetModel, store: Store, find: Find, saved: Callable[[str], str]) -> Sequence[int]:
    if chosen.where is not None:
        return find(chosen.where)
    if chosen.search is not None:
        return find(saved(chosen.search))
    return store.read(lambda transaction: _listed(chosen, transaction))


def _listed(chosen: SetModel, transaction: Transaction) -> Sequence[int]:
    if chosen.experiment is not None:
        return transaction.run_table.runs_of_experiment(chosen.experiment)
    if chosen.group is not None:
        return transaction.run_table.runs_of_group(chosen.group)
    if chosen.configurations is not None:
        return transaction.run_table.runs_of_configurations(chosen.configurations)
    wanted = chosen.runs or []
    missing = set(wanted) - transaction.run_table.existing(wanted)
    if missing:
        shown = ", ".join(map(str, sorted(missing)[:8])) + (", ..." if len(missing) > 8 else "")
        raise NotFound(f"unknown runs {shown}", "list runs that exist")
    return wanted
