"""Creates a challenge: keeps its ground truth apart, and publishes the rest."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from slamhive import strict_yaml
from slamhive.domain.challenge import Format
from slamhive.errors import Conflict, InvalidInput, SlamHiveError, Unavailable
from slamhive.files import held_folder, make_shared_folder, remedy_of, write_aside
from slamhive.schema.challenge import ChallengeFile, SecretTimes, SequenceEntry
from slamhive.services.challenges.definition import Definition, load_definition
from slamhive.services.challenges.folder import DEFINITION, RECORDINGS, SECRET, SUBMISSIONS, TIMES, ChallengeFolder
from slamhive.services.challenges.frames import frame_trajectory
from slamhive.services.challenges.recordings import keep_recording
from slamhive.trajectory.kitti import parse_kitti_matrices
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.tum import read_tum

_PRIVATE_FOLDER, _PRIVATE_FILE = 0o700, 0o600


def create_challenge(root: Path, path: Path) -> ChallengeFolder:
    """Make the challenge of the file at ``path``, complete or not at all.

    Raises:
        InvalidInput: The file or a ground truth cannot be used.
        NotFound: A ground truth does not exist.
        Conflict: There is a challenge of that name.
        Unavailable: The disk refuses.
    """
    definition = load_definition(path)
    truths = _truths(definition, path.parent)
    final = root / definition.file.name
    aside = root / f".{definition.file.name}"
    if final.exists():
        raise Conflict(f"challenge {definition.file.name} exists already", "choose another name")
    try:
        make_shared_folder(root)
        with held_folder(aside):
            _fill(aside, definition.file, truths, path.parent)
            aside.rename(final)
    except OSError as error:
        shutil.rmtree(aside, ignore_errors=True)
        raise Unavailable(f"{final} cannot be made: {error.strerror}", remedy_of(error)) from None
    except SlamHiveError:
        shutil.rmtree(aside, ignore_errors=True)
        raise
    return ChallengeFolder(final)


def _fill(folder: Path, file: ChallengeFile, truths: dict[str, bytes], source: Path) -> None:
    secret = folder / SECRET
    secret.mkdir(mode=_PRIVATE_FOLDER)
    secret.chmod(_PRIVATE_FOLDER)  # whatever the umask says
    for name, data in truths.items():
        write_aside(secret / name, data, _PRIVATE_FILE)
    for entry in file.sequences:
        if entry.recording is not None:
            keep_recording(source / entry.recording, entry.name, secret / RECORDINGS / entry.name)
    make_shared_folder(folder / SUBMISSIONS)
    times = {entry.name: entry.time_range_s for entry in file.sequences if entry.secret and entry.time_range_s}
    if times:
        write_aside(secret / TIMES, json.dumps(SecretTimes(time_ranges_s=times).content), _PRIVATE_FILE)
    published = file.model_copy(update={"sequences": tuple(map(_published, file.sequences))})
    write_aside(folder / DEFINITION, strict_yaml.dump(published.model_dump(mode="json", exclude_none=True)))


def _published(entry: SequenceEntry) -> SequenceEntry:
    """What everybody may know: the times of a secret recording would tell when it was made, and how long it is."""
    kept = {"groundtruth": None, "recording": None if entry.recording is None else entry.name}
    return entry.model_copy(update={**kept, "time_range_s": None} if entry.secret else kept)


def _truths(definition: Definition, folder: Path) -> dict[str, bytes]:
    """{file in the secret folder: its content}."""
    found: dict[str, bytes] = {}
    for entry in definition.file.sequences:
        if entry.groundtruth is None:
            raise InvalidInput(f"sequence {entry.name} names no groundtruth", "give the file of its secret trajectory")
        path = folder / entry.groundtruth
        if definition.preset.format is Format.KITTI:
            found |= _kitti_truth(entry, path)
        else:
            found[f"{entry.name}.tum"] = _tum_truth(entry, path, definition.protocol.hold_interval_s)
    return found


def _tum_truth(entry: SequenceEntry, path: Path, longest_step_s: float | None) -> bytes:
    stamps_s = read_tum(path).stamps_s
    if entry.time_range_s is None:
        raise InvalidInput(
            f"sequence {entry.name} needs time_range_s", "give it; the times of a secret recording are not published"
        )
    first_s, last_s = entry.time_range_s
    if len(stamps_s) < 3 or stamps_s[0] < first_s or stamps_s[-1] > last_s:
        raise InvalidInput(
            f"{path} has {len(stamps_s)} poses from {stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s; the time range of "
            f"{entry.name} is {first_s:g} to {last_s:g} s",
            "the range is that of the recording, within which the ground truth lies",
        )
    if longest_step_s is not None and np.median(np.diff(stamps_s)) > longest_step_s:
        raise InvalidInput(
            f"{path} has a pose every {np.median(np.diff(stamps_s)):.3g} s; this protocol counts steps of at most "
            f"{longest_step_s:.3g} s",
            "use a faster ground truth, or the preset mean with another protocol",
        )
    return read_bounded(path)


def _kitti_truth(entry: SequenceEntry, path: Path) -> dict[str, bytes]:
    data = read_bounded(path)
    matrices = parse_kitti_matrices(data, str(path))
    if len(matrices) != entry.poses:
        raise InvalidInput(f"{path} has {len(matrices)} poses, {entry.name} has {entry.poses}", "correct the one")
    steps_m = np.linalg.norm(np.diff(matrices[:, :3, 3], axis=0), axis=1)
    if steps_m.sum() <= 100.0:
        raise InvalidInput(
            f"the path in {path} is {steps_m.sum():.4g} m long, the shortest segment of KITTI 100 m",
            "leave the sequence out, or use another preset",
        )
    return {f"{entry.name}.kitti": data, f"{entry.name}.tum": frame_trajectory(matrices)}
