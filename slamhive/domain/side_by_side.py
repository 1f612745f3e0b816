"""The one rule for runs that stand side by side: their errors compare under one protocol and one kind of trajectory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from slamhive.domain.names import plural
from slamhive.domain.protocol import Alignment, Protocol, TrajectoryKind, with_trajectory

_FREEDOM = (
    Alignment.NONE,
    Alignment.SCALE,
    Alignment.FIRST_POSE,
    Alignment.YAW_POSITION,
    Alignment.SE3,
    Alignment.SIM3,
)
"""Alignments, from the one that moves an estimate the least."""
_MOST_NAMED = 3


@dataclass(frozen=True, slots=True)
class ProtocolUse:
    """Protocol of the errors of ``runs`` runs, by fingerprint and label, and the trajectory that was judged."""

    fingerprint: str
    label: str
    trajectory: TrajectoryKind | None
    runs: int = 1

    @property
    def full_label(self) -> str:
        """The label with the kind of the trajectory."""
        return with_trajectory(self.label, self.trajectory)


@dataclass(frozen=True, slots=True)
class MixedProtocols:
    """Runs side by side whose errors are not comparable.

    ``uses`` are the protocols and kinds of trajectories, the most used first. ``common`` is the protocol that all of
    the runs can be evaluated under, None where no protocol helps or none is known. Of live and final trajectories, it
    is the one that judges the live trajectory of all, or the final one where some run has no live one. ``refused`` is
    the protocol that would have helped, with the number of runs whose evaluation under it failed.
    """

    uses: tuple[ProtocolUse, ...]
    common: ProtocolUse | None = None
    refused: ProtocolUse | None = None

    @property
    def words(self) -> str:
        """The counts as a sentence: ``6 runs use Sim(3), 6 SE(3): not comparable``, and what was tried."""
        if self.refused is None or self.refused.trajectory is None:
            return f"{self.counts}: not comparable."
        tried = f"the {self.refused.trajectory.adjective} trajectory of {plural(self.refused.runs, 'run')}"
        return f"{self.counts}: not comparable. No evaluation of {tried} succeeded."

    @property
    def counts(self) -> str:
        """``6 runs use Sim(3), 6 SE(3)``; the other words of the protocols are the same."""
        names = short_names([use.full_label for use in self.uses])
        if self.only_trajectories:
            kinds = [use.trajectory for use in self.uses]
            names = ["an unstated one" if kind is None else f"the {kind.adjective} trajectory" for kind in kinds]
        first, *others = self.uses[:_MOST_NAMED]
        verb = "uses" if first.runs == 1 else "use"
        told = [f"{plural(first.runs, 'run')} {verb} {names[0]}"]
        told += [f"{use.runs} {name}" for use, name in zip(others, names[1:], strict=False)]
        rest = sum(use.runs for use in self.uses[_MOST_NAMED:])
        # Names that hold commas need stronger signs between them.
        between = "; " if any(", " in name for name in names) else ", "
        return between.join([*told, *([f"{rest} others"] if rest else [])])

    @property
    def only_trajectories(self) -> bool:
        """True if one protocol judged live, final or keyframe trajectories."""
        return len({use.fingerprint for use in self.uses}) == 1

    @property
    def remedy(self) -> str:
        """The way out, as an imperative."""
        if self.common is None and self.refused is not None:
            return "compare runs of one kind of trajectory"
        if self.common is None and self.only_trajectories:
            return "compare runs of one kind of trajectory, or evaluate all under a protocol that names one"
        if self.common is None:
            return "evaluate all runs under one protocol"
        command = f"slamhive evaluate RUNS --protocol {self.common.fingerprint} --current"
        return f"evaluate all under {self.common_name}: {command}"

    @property
    def sentences(self) -> str:
        """The counts and the way out in one line, for text, files and JSON."""
        return f"{self.words} {self.remedy[0].upper()}{self.remedy[1:]}"

    @property
    def common_name(self) -> str:
        """The short name of the common protocol, for a button; empty without one."""
        if self.common is None:
            return ""
        if self.only_trajectories and self.common.trajectory is not None:
            return f"the {self.common.trajectory.adjective} trajectory"
        labels = [use.label for use in self.uses if use.fingerprint != self.common.fingerprint]
        return short_names([self.common.label, *labels])[0]


@dataclass(frozen=True, slots=True)
class PlannedMixture:
    """Planned runs whose errors would not be comparable.

    Attributes:
        protocols: Those of the runs.
        remedy: The entries of ``evaluate`` that would make the errors comparable; empty if none are known.
    """

    protocols: MixedProtocols
    remedy: Mapping[str, str]

    @property
    def sentences(self) -> str:
        """The counts and the way out in one line."""
        return f"{self.protocols.words} {self.way_out[0].upper()}{self.way_out[1:]}"

    @property
    def way_out(self) -> str:
        """The way out alone, as an imperative."""
        if not self.remedy:
            return "choose one alignment: evaluate: {alignment: ...}."
        option = f"evaluate: {{{', '.join(f'{name}: {value}' for name, value in self.remedy.items())}}}"
        return f"to evaluate all under {self.protocols.common_name}, add to the file: {option}"


def mixed_protocols(
    uses: Iterable[ProtocolUse],
    definitions: Mapping[str, Protocol] | None = None,
    refused: Mapping[str, int] | None = None,
) -> MixedProtocols | None:
    """The protocols of runs side by side if they are not comparable; None if they are.

    Args:
        uses: Protocols and trajectories of the runs; runs without errors are left out.
        definitions: {fingerprint: protocol}, from which the common one is chosen.
        refused: {fingerprint: number of the runs that could not be evaluated under it}; it is not offered again.
    """
    runs: Counter[ProtocolUse] = Counter()
    for use in uses:
        runs[replace(use, runs=0)] += use.runs
    # A run may not say which kind its trajectory is. It then stands beside either kind.
    stated = {use for use in runs if use.trajectory is not None}
    groups = {use.full_label: use for use in (stated or runs)}
    fingerprints = {use.fingerprint for use in runs}
    if len(fingerprints) < 2 and len(groups) < 2:
        return None
    order = sorted(runs, key=lambda use: (-runs[use], use.trajectory is None, use.full_label, use.fingerprint))
    found = tuple(replace(use, runs=runs[use]) for use in order)
    common = None
    of_kinds: list[ProtocolUse] = []
    if len(fingerprints) > 1:
        # A protocol that names a trajectory fits only the runs that left one of this kind.
        known = [definitions[use.fingerprint] for use in found if definitions and use.fingerprint in definitions]
        chosen = common_protocol(known)
        common = next((use for use in found if chosen is not None and use.fingerprint == chosen.fingerprint), None)
        # Under it, live and final trajectories would stand side by side, which is no way out.
        if definitions and chosen is not None and len({use.trajectory for use in stated}) > 1:
            of_kinds = _of_kinds(chosen, definitions)
    elif definitions and found[0].fingerprint in definitions:
        # Algorithms with corrections leave the poses from before them as well; the others have nothing but live poses.
        of_kinds = _of_kinds(definitions[found[0].fingerprint], definitions)
    if not of_kinds:
        return MixedProtocols(found, common)
    in_vain = refused or {}
    tried = next((replace(use, runs=lost) for use in of_kinds if (lost := in_vain.get(use.fingerprint))), None)
    return MixedProtocols(found, next((use for use in of_kinds if use.fingerprint not in in_vain), None), tried)


def _of_kinds(protocol: Protocol, definitions: Mapping[str, Protocol]) -> list[ProtocolUse]:
    """The same protocol for one kind of trajectory, as far as it is known: the live one first."""
    kinds = (of_live(protocol), replace(protocol, trajectory=TrajectoryKind.FINAL))
    return [
        ProtocolUse(one.fingerprint, one.label, one.trajectory, 0) for one in kinds if one.fingerprint in definitions
    ]


def of_live(protocol: Protocol) -> Protocol:
    """The same protocol for the live trajectory of a run."""
    return replace(protocol, trajectory=TrajectoryKind.LIVE)


def common_protocol(protocols: Sequence[Protocol]) -> Protocol | None:
    """The protocol that is fair to all runs: the one whose alignment removes the most.

    A single camera does not see the scale, so its error under SE(3) says nothing. Under Sim(3) both errors mean
    something. None if no alignment removes all that the others do.

    Args:
        protocols: Those in use, the most used first.
    """
    if not protocols:
        return None
    freest = max(protocols, key=lambda protocol: (protocol.trajectory is None, _FREEDOM.index(protocol.alignment)))
    scales = {entry.alignment for entry in protocols} & {Alignment.SCALE, Alignment.SIM3}
    moved = {entry.alignment for entry in protocols} - {Alignment.SCALE, Alignment.NONE}
    return None if scales and moved and freest.alignment is not Alignment.SIM3 else freest


def short_names(labels: Sequence[str]) -> list[str]:
    """Each label without the words that all of them share, so that they differ and stay short."""
    words = [label.split(", ") for label in labels]
    shared = set.intersection(*map(set, words)) if len(set(labels)) > 1 else set()
    short = [[word for word in entry if word not in shared] for entry in words]
    if not all(short):  # one has all words of another, so the alignment is named too
        short = [[entry[0], *(word for word in entry[1:] if word not in shared)] for entry in words]
    return [", ".join(entry) for entry in short]
