"""Rented machines: plan, up, status, down and sweep."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from slamhive.base import strict_yaml
from slamhive.base.clock import SYSTEM_CLOCK, Clock
from slamhive.base.errors import Conflict, InvalidInput
from slamhive.base.files import size_bytes
from slamhive.base.settings import Settings
from slamhive.cloud.lifecycle import Hands, Rising, cluster_resources, remove_all, take_down
from slamhive.cloud.machines import Preparer, read_public_key
from slamhive.cloud.plan import CloudFile, ProviderName, Work, load_cloud_file, make_plan
from slamhive.cloud.providers import open_provider
from slamhive.cloud.resources import CLUSTER_TAG, INSTALLATION_TAG, UID_TAG, CloudRecords, Provider, Resource
from slamhive.documents.machines import CloudPlanDocument, CloudRecord, CloudResource, CloudState, CloudStatus
from slamhive.experiments.file import parse_experiment
from slamhive.services.datasets import Catalogue, check_writable
from slamhive.services.experiments import ExperimentService, ExperimentSource


def work_of(order: CloudFile, path: Path, experiments: Callable[[], ExperimentService], catalogue: Catalogue) -> Work:
    """The work that the cloud file at ``path`` names; raises as the preview of an experiment."""
    if order.experiment is None:
        return Work(order.hours or 0.0)
    service = experiments()
    source = service.context.with_datasets(ExperimentSource.read(path.parent / order.experiment))
    found = service.preview(source)
    datasets = tuple(map(str, parse_experiment(source.text, source.name).datasets.values))
    copied = order.prepare is not None and order.prepare.datasets
    return Work(
        hours=(found.time_s - found.build_time_s) * found.slots / 3600,  # packages are built before
        runs=found.runs,
        data_bytes=sum(size_bytes(catalogue.dataset_folder(name)) for name in datasets) if copied else 0,
        datasets=datasets if copied else (),
    )


# Clusters of rented machines, from the plan until nothing is left.

Tell = Callable[[str], None]
Place = tuple[ProviderName, str]
"""A provider and a region of it."""


def _silent(_text: str) -> None:
    """Say nothing."""


@dataclass(frozen=True, slots=True)
class Swept:
    """Result of a sweep in one region; ``foreign`` belongs to other installations and was left."""

    provider: str
    region: str
    deleted: int
    foreign: int


class Clouds:
    """The rented machines of one installation.

    Args:
        settings: Data root, join command and endpoint.
        catalogue: Has the datasets to copy.
        experiments: Estimates how long an experiment takes; called on first use.
        environment: Has the access keys.
        clock: Dates and waits.
    """

    def __init__(
        self,
        settings: Settings,
        catalogue: Catalogue,
        experiments: Callable[[], ExperimentService],
        environment: Mapping[str, str] = os.environ,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._settings = settings
        self._catalogue = catalogue
        self._experiments = experiments
        self._environment = environment
        self._clock = clock
        self._records = CloudRecords(settings.clouds_folder)

    def plan(self, path: Path) -> CloudPlanDocument:
        """Read the plan in the cloud file at ``path``; no provider is asked. Raises InvalidInput."""
        order, _ = self._order(path)
        return make_plan(order, self._work(order, path), self._clock.utc_now())

    def up(self, path: Path, tell: Tell = _silent) -> CloudStatus:
        """Rent what the plan of ``path`` shows, or go on where an interrupted command stopped.

        Raises InvalidInput or Forbidden before anything is created; Conflict if the name is taken.
        """
        check_writable(self._settings)
        order, text = self._order(path)
        if not self._settings.cloud_join.strip():
            raise InvalidInput("CLOUD_JOIN is empty, so machines would join nothing", "docs/cloud.md has examples")
        work = self._work(order, path)
        with self._records.held(order.name):
            record = self._known(order, text)
            plan = make_plan(order, work, self._clock.utc_now()) if record is None else None
            hands = self._hands(order, work, tell)
            if plan is not None:
                record = self._begin(hands, order, text, plan)
            assert record is not None
            return self._status(Rising(hands, order, record).up(), hands.provider)

    def _begin(self, hands: Hands, order: CloudFile, text: str, plan: CloudPlanDocument) -> CloudRecord:
        """Write the record of a new cluster; raises InvalidInput or Conflict if the provider cannot have it."""
        hands.provider.check(order)
        self._sweep(hands, (order.provider, order.region), everything=False)
        self._refuse_taken(hands.provider, order.name)
        now = self._clock.utc_now()
        record = CloudRecord(
            name=order.name,
            uid=uuid.uuid4().hex,
            state=CloudState.UP,
            made_at=now,
            ends_at=plan.ends_at(now),
            order=text,
            plan=plan,
        )
        return self._records.write(record)

    def status(self, name: str | None = None) -> list[CloudStatus]:
        """One cluster, or all that are not down; asks their providers. Raises NotFound."""
        if name is not None:
            records = [self._records.get(name)]
        else:
            records = [record for record in self._records.all() if record.state is not CloudState.DOWN]
        return [self._status(record, self._provider(_place(record))) for record in records]

    def down(self, name: str, tell: Tell = _silent) -> int:
        """Delete all that a cluster has; returns how many resources. It may be repeated. Raises NotFound."""
        check_writable(self._settings)
        record = self._records.get(name)
        with self._records.held(name):
            return take_down(self._hands(_order_of(record), Work(0.0), tell, keys=False), self._records.get(name))

    def sweep(self, path: Path | None = None, tell: Tell = _silent, *, everything: bool = False) -> list[Swept]:
        """Delete what clusters have left that are down, unknown or past their end.

        Args:
            path: A cloud file, whose region is searched; None for the regions of all clusters of this installation.
            tell: Called with what is deleted.
            everything: Also of other installations that use the same account.
        """
        check_writable(self._settings)
        orders = [self._order(path)[0]] if path is not None else [_order_of(record) for record in self._records.all()]
        places = {(order.provider, order.region): order for order in orders}
        if not places:
            raise InvalidInput("no cluster was ever up here, so no region is known", "name a cloud file")
        hands = {place: self._hands(order, Work(0.0), tell, keys=False) for place, order in places.items()}
        return [self._sweep(found, place, everything=everything) for place, found in hands.items()]

    def _sweep(self, hands: Hands, place: Place, *, everything: bool) -> Swept:
        """Delete what no cluster that is up has."""
        now, installation = self._clock.utc_now(), self._records.installation()
        kept = {record.uid for record in self._records.all() if record.state is CloudState.UP and now < record.ends_at}

        def left(entry: Resource) -> bool:
            own = everything or entry.tags.get(INSTALLATION_TAG) == installation
            return own and entry.tags[UID_TAG] not in kept

        foreign = [entry for entry in hands.provider.found() if entry.tags.get(INSTALLATION_TAG) != installation]
        deleted = remove_all(hands, left)
        for record in self._records.all():
            if _place(record) == place and record.uid not in kept and record.state is not CloudState.DOWN:
                self._records.write(record.model_copy(update={"state": CloudState.DOWN}))
        return Swept(place[0].value, place[1], deleted, 0 if everything else len(foreign))

    def _known(self, order: CloudFile, text: str) -> CloudRecord | None:
        """The record of an interrupted ``up``, None if there is none; raises Conflict if it is of another file."""
        record = self._records.find(order.name)
        if record is None or record.state is CloudState.DOWN:
            return None
        remedy = f"slamhive cloud down {order.name} removes it"
        if record.state is CloudState.ENDING:
            raise Conflict(f"cluster {order.name} is being taken down", remedy)
        if record.order != text:
            raise Conflict(
                f"cluster {order.name} is up, and its cloud file was another", f"{remedy}; or use another name"
            )
        return record

    def _refuse_taken(self, provider: Provider, name: str) -> None:
        taken = [entry for entry in provider.found() if entry.tags.get(CLUSTER_TAG) == name]
        if taken:
            raise Conflict(
                f"the name {name} is taken: another installation has {taken[0].kind} {taken[0].id} for it",
                "choose another name",
            )

    def _order(self, path: Path) -> tuple[CloudFile, str]:
        text = strict_yaml.read_text(path)
        return load_cloud_file(text, str(path)), text

    def _work(self, order: CloudFile, path: Path) -> Work:
        return work_of(order, path, self._experiments, self._catalogue)

    def _hands(self, order: CloudFile, work: Work, tell: Tell, *, keys: bool = True) -> Hands:
        folders: Sequence[Path] = [self._catalogue.dataset_folder(name) for name in work.datasets]
        return Hands(
            provider=self._provider((order.provider, order.region)),
            records=self._records,
            clock=self._clock,
            prepare=Preparer(self._records, folders, self._clock),
            join=self._settings.cloud_join,
            public_key=read_public_key(order) if keys else None,
            tell=tell,
        )

    def _provider(self, place: Place) -> Provider:
        return open_provider(*place, self._settings.cloud_endpoint, self._environment, self._clock)

    def _status(self, record: CloudRecord, provider: Provider) -> CloudStatus:
        # At most: as if all machines had run since the start.
        plan = record.plan
        hours = (min(self._clock.utc_now(), record.ends_at) - record.made_at).total_seconds() / 3600
        most_until_now = hours * (plan.hour_price * plan.nodes + plan.image_day_cost / 24)
        return CloudStatus.of(
            record,
            provider=record.plan.provider,
            region=record.plan.region,
            currency=record.plan.currency,
            cost_until_now=most_until_now,
            most_cost=record.plan.most_cost,
            resources=tuple(
                CloudResource.of(entry, kind=entry.kind.value, state=entry.state.value)
                for entry in cluster_resources(provider, record.uid)
            ),
        )


def _order_of(record: CloudRecord) -> CloudFile:
    return load_cloud_file(record.order, f"the record of cluster {record.name}")


def _place(record: CloudRecord) -> Place:
    return ProviderName(record.plan.provider), record.plan.region
