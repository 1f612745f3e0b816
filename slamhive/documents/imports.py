"""Imports of runs as JSON: the origin that ``run.json`` states, and the report of an import."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import AliasChoices, Field

from slamhive.documents.api import ApiRequest
from slamhive.documents.model import Document, described
from slamhive.domain.protocol import Duplicates, TrajectoryKind
from slamhive.domain.sensors import SensorSetup
from slamhive.domain.verdict import Hint

_Order = Annotated[str | None, described("Null for files without orientations, and for matrices.")]
_Because = Annotated[dict[str, str], described("Why the unit and the order are believed to be these.")]


class OriginDocument(Document):
    """The file that an imported run comes from."""

    source: Annotated[str, described("Path of the file as the user gave it.")]
    trial: str
    format: str
    checksum: str
    time_unit: Annotated[str | None, described("Unit of its timestamps; null in records of version 0.1.")] = None
    quaternion_order: _Order = None
    because: _Because = Field(default_factory=dict)


class ReadingDocument(Document):
    """Interpretation of a file that was read."""

    name: str
    time_unit: str
    quaternion_order: _Order
    because: _Because


class ProblemDocument(Document):
    """A file that was not imported."""

    name: str
    text: Annotated[str, described("Why it was not imported.")]


class Import(Document):
    """Result of an import, or of its dry run."""

    dry_run: bool
    runs: Annotated[tuple[int, ...], described("Numbers of all runs, also of those that were imported before.")] = (
        Field(validation_alias=AliasChoices("run_ids", "runs"))
    )
    imported: Annotated[int, described("New runs.")]
    known: Annotated[int, described("Runs that were imported before.")]
    datasets: Annotated[tuple[str, ...], described("Datasets that were created from ground truths or relations.")]
    evaluated: int
    failed_evaluations: Annotated[dict[int, str], described("Why evaluations failed, by run.")]
    readings: tuple[ReadingDocument, ...]
    problems: tuple[ProblemDocument, ...]
    left_out: Annotated[tuple[str, ...], described("Files that match no pattern.")]
    hints: Annotated[dict[int, tuple[Hint, ...]], described("Likely mistakes in the input, by run.")]


# Uploads: files that programs send in parts, and what is imported from them.


OCTETS = "application/octet-stream"
"""The media type of a part."""
HEXADECIMAL = "[0-9a-f]{32}"
LARGEST_UPLOAD_BYTES = 2**53 - 1

Token = Annotated[str, described("The token of an upload.", pattern=f"^{HEXADECIMAL}$")]
Word = Annotated[str | None, described("Null: found out from the files.", max_length=300)]
Pattern = Annotated[str | None, described("Null: the default of `slamhive runs import`.", max_length=300)]


class UploadRequest(ApiRequest):
    """A file that will be sent."""

    name: Annotated[str, described("Its name, without folders. The ending says whether it is an archive.")]
    size_bytes: Annotated[int, described("Its size.", unit="bytes", ge=1, le=LARGEST_UPLOAD_BYTES)]
    sha256: Annotated[
        str, described("Its SHA-256 in hexadecimal, checked before the import.", pattern="^[0-9a-f]{64}$")
    ]


class ImportedDocument(Document):
    """Result of an upload."""

    datasets: Annotated[tuple[str, ...], described("New datasets.")] = ()
    algorithms: Annotated[tuple[str, ...], described("New algorithms.")] = ()
    runs: Annotated[Import | None, described("The report of an import of runs.")] = None
    notes: Annotated[tuple[str, ...], described("What to know about it.")] = ()


class ImportProgress(Document):
    """An import that is in progress, or that failed."""

    fraction: Annotated[float, described("How much is done, from 0 to 1.")]
    activity: Annotated[str, described("What is being done.")]
    done: bool
    problem: Annotated[str | None, described("Why it failed.")]


class Upload(Document):
    """A file that is being sent, or has been imported."""

    token: str
    name: str
    size_bytes: int
    sha256: str
    received_bytes: Annotated[int, described("How much has arrived; the next part begins here.")]
    part_bytes: Annotated[int, described("The most that one request may send.")]
    expires_at: Annotated[datetime, described("When it is removed, unless something happens before.")]
    work: Annotated[ImportProgress | None, described("Its import, while it is in progress or if it failed.")]
    imported: Annotated[ImportedDocument | None, described("What it has become; null until then.")]


class UploadsDocument(Document):
    """The uploads of the caller, the newest first."""

    uploads: tuple[Upload, ...]


class RecordingFacts(ApiRequest):
    """Facts about a recording that its files may not state."""

    name: Annotated[
        str | None, described("Name of the new dataset; null: that of the file.", title="Name", max_length=64)
    ] = None
    format: Annotated[
        str | None, described("Format of the recording; null: detected.", title="Format", max_length=64)
    ] = None
    sequence: Annotated[
        str | None, described("Sequence, where the recording holds several.", title="Sequence", max_length=300)
    ] = None
    groundtruth_topic: Annotated[
        str | None,
        described(
            "Topic that holds the ground truth; TOPIC:FRAME of a transform.",
            title="Topic of the ground truth",
            max_length=300,
        ),
    ] = None
    topics: Annotated[
        dict[str, str],
        described("Topics of sensors by name; `none` leaves one out.", title="Topics of sensors", max_length=100),
    ] = Field(default_factory=dict)
    typestore: Annotated[
        str | None, described("Message types, for instance ros2_humble.", title="Message types", max_length=64)
    ] = None
    depth_units_per_m: Annotated[
        float | None, described("Value of a depth pixel that means one metre.", title="Depth units per metre", gt=0)
    ] = None
    frame_rate_hz: Annotated[
        float | None, described("Frames per second, without timestamps.", unit="Hz", title="Frame rate", gt=0)
    ] = None
    uncertainty_m: Annotated[
        float | None,
        described(
            "Standard deviation of the ground truth's positions along each axis.",
            unit="m",
            title="Uncertainty of the ground truth",
            gt=0,
        ),
    ] = None
    accept_loss: Annotated[
        bool,
        described("Import the rest where over 1 % of the messages are lost.", title="Accept losses"),
    ] = False


class DatasetUpload(RecordingFacts):
    """A dataset to make of an uploaded recording: one file, or a zip or tar archive of its folder."""

    upload: Token
    groundtruth: Annotated[Token | None, described("Upload of a ground truth: a TUM or EuRoC file.")] = None
    calibration: Annotated[tuple[Token, ...], described("Uploads of calibration files.", max_length=20)] = ()


Place = Annotated[str, described("An absolute path on the server.", title="Path", min_length=1, max_length=4000)]


class DatasetOnServer(RecordingFacts):
    """A dataset to make of a recording that is on the server: a file or a folder."""

    path: Place
    groundtruth: Annotated[
        Place | None, described("Path of a ground truth: a TUM or EuRoC file.", title="Ground truth")
    ] = None
    calibration: Annotated[
        tuple[Place, ...], described("Paths of calibration files, one a line.", title="Calibration", max_length=20)
    ] = ()


class RunsUpload(ApiRequest):
    """Runs to import from an archive of trajectories, as `slamhive runs import` does."""

    upload: Token
    table: Annotated[str | None, described("Path of a CSV table in the archive, which replaces the patterns.")] = None
    pattern: Pattern = None
    groundtruth: Pattern = None
    relations: Pattern = None
    times: Pattern = None
    image_times: Pattern = None
    format: Annotated[str | None, described("Format of the trajectories; null: detected.")] = None
    columns: Annotated[
        str | None,
        described("Columns of the trajectories, such as t,x,y,z,qw,qx,qy,qz; null: detected.", max_length=1000),
    ] = None
    sensors: Annotated[
        dict[str, SensorSetup], described("Sensors by algorithm; the name `` is for all others.", max_length=100)
    ] = Field(default_factory=dict)
    time_unit: Word = None
    quaternion_order: Word = None
    groundtruth_time_unit: Word = None
    groundtruth_quaternion_order: Word = None
    duplicates: Annotated[Duplicates, described("Which pose counts if a timestamp occurs twice.")] = Duplicates.REFUSE
    trajectory: Annotated[TrajectoryKind | None, described("Which trajectory the files are.")] = None
    gravity_aligned: Annotated[bool, described("The z axis of the ground truth points up.")] = False
    evaluate: Annotated[bool, described("Queue an evaluation of each run that has none.")] = True


class PackageFacts(ApiRequest):
    """Facts about an algorithm to import that its files may not state."""

    name: Annotated[
        str | None, described("Name of the package; null: that of the file.", title="Name", max_length=64)
    ] = None
    setup: Annotated[
        SensorSetup | None, described("Its sensors, if its files do not say.", title="Sensors that it uses")
    ] = None
    replace: Annotated[
        bool, described("Take the place of an imported package of that name.", title="Replace the package of that name")
    ] = False
    executor: Annotated[
        str | None,
        described("The executor that gets the image; null: the one in force.", title="Executor", max_length=64),
    ] = None


class AlgorithmUpload(PackageFacts):
    """An algorithm to import: an image that `docker save` wrote, an exported version, or an archive of a folder."""

    upload: Token


class AlgorithmOnServer(PackageFacts):
    """An algorithm to import from the server: a folder, an image that `docker save` wrote, or an exported version."""

    path: Place
    image: Annotated[
        str | None,
        described(
            "The image to use with the folder: its name, or a saved image; null: it is built.",
            title="Image",
            max_length=300,
        ),
    ] = None
