"""The numbers that the database gives to algorithms, datasets and experiments."""

from __future__ import annotations

from slamhive.foreign.numbers import Numbers
from slamhive.store import AbsentStore, Store, Transaction


def stored_numbers(store: Store) -> Numbers:
    """All numbers of this installation; what no configuration has used yet has none. Empty without a data root."""

    def work(t: Transaction) -> Numbers:
        return Numbers(
            algorithms={record.id: record.name for record in t.catalogue.algorithms()},
            datasets={record.id: record.name for record in t.catalogue.datasets()},
            experiments=t.run_table.experiment_names(),
        )

    return Numbers() if isinstance(store, AbsentStore) else store.read(work)
