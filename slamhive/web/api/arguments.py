"""The arguments that several operations share, and the places in paths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import TrustLevel
from slamhive.schema.api_requests import LARGEST_RUN_ID
from slamhive.schema.uploads import HEXADECIMAL, LARGEST_UPLOAD_BYTES
from slamhive.services.exports import Format
from slamhive.web.api.operation import Argument, Place
from slamhive.web.configuration_query import LARGEST_PAGE, PAGE_LENGTH
from slamhive.web.experiment_page import CELLS_LENGTH, MOST_CELLS, MOST_NUMBER
from slamhive.web.figures import PLOTS_WITH_DATA
from slamhive.web.run_query import DEFAULT_LIMIT, EXPORT_LIMIT

TEXT: Mapping[str, Any] = {"type": "string"}
_NUMBER: Mapping[str, Any] = {"type": "integer", "minimum": 0, "maximum": LARGEST_RUN_ID}
_YES_OR_NO: Mapping[str, Any] = {"type": "string", "enum": ["yes", "no"]}
_CHANGES = ("pause", "resume", "cancel", "retry-failed")


def _choice(*values: str) -> dict[str, Any]:
    return {"type": "string", "enum": list(values)}


def _limit(default: int, most: int) -> Argument:
    schema = {"type": "integer", "minimum": 1, "maximum": most, "default": default}
    return Argument("limit", "Entries on a page.", schema)


PLACES = {
    "run_id": Place(f"int(max={LARGEST_RUN_ID})", _NUMBER, "Number of the run."),
    "configuration_id": Place(f"int(max={LARGEST_RUN_ID})", _NUMBER, "Number of the configuration."),
    "name": Place("string", TEXT, "The name."),
    "key": Place("string", TEXT, "The key, from the list."),
    "token": Place("string", {"type": "string", "pattern": "^[0-9a-f]{32}$"}, "The token of the analysis."),
    "upload": Place("string", {"type": "string", "pattern": f"^{HEXADECIMAL}$"}, "The token of the upload."),
    "submission": Place("string", TEXT, "The id of the submission."),
    "plot": Place("string", _choice(*PLOTS_WITH_DATA), "The plot."),
    "sensor": Place("string", TEXT, "The name of the sensor."),
    "action": Place(f"any({', '.join(map(repr, _CHANGES))})", _choice(*_CHANGES), "What to do."),
    "format": Place(f"any({','.join(Format)})", _choice(*Format), "The format of the file."),
}
AFTER = Argument("after", "The page after this cursor, which `next` of the page before contains.", TEXT)
SORTED = (
    Argument("sort", "A column, metric or parameter.", {"type": "string", "default": "id"}),
    Argument("order", "Largest or smallest first; by default the newest first.", _choice("asc", "desc")),
)
FILTER = (
    Argument("where", "A filter, such as `ate.rmse < 0.1 and dataset ~ MH_0*`.", TEXT),
    Argument("state", "Only these states.", _choice(*RunState), many=True),
    Argument("reason", "Only these failures.", _choice(*FailureReason), many=True),
    Argument("verdict", "Only these verdicts.", TEXT, many=True),
    Argument("trust", "Only these levels of trust.", _choice(*TrustLevel), many=True),
    Argument("algorithm", "Only these algorithms.", TEXT, many=True),
    Argument("dataset", "Only these datasets.", TEXT, many=True),
    Argument("sensor", "Only algorithms with these sensors.", TEXT, many=True),
    Argument("executor", "Only these executors.", TEXT, many=True),
    Argument("experiment", "Only runs of these experiments.", TEXT, many=True),
    Argument("configuration", "Only runs of this configuration.", _NUMBER),
    Argument("from", "Created at this time or later, as 2026-05-04 or 2026-05-04T12:00.", TEXT),
    Argument("to", "Created at this time or earlier.", TEXT),
    Argument("evaluated", "Only evaluated runs, or only others.", _YES_OR_NO),
    Argument("disturbed", "Only disturbed runs, or only others.", _YES_OR_NO),
)
RUN_ARGUMENTS = (*FILTER, *SORTED, _limit(DEFAULT_LIMIT, EXPORT_LIMIT), AFTER)
EXPORT_ARGUMENTS = (
    *FILTER,
    *SORTED,
    Argument("columns", "Keys of columns, metrics and parameters, with commas.", TEXT),
    Argument("group", "One row for each configuration, with mean and spread.", _choice("configuration")),
)
CONFIGURATION_ARGUMENTS = (
    Argument("algorithm", "Only these algorithms.", TEXT, many=True),
    Argument("dataset", "Only these datasets.", TEXT, many=True),
    Argument("group", "Only those in this group.", TEXT),
    Argument("text", "A part of the name or the note.", TEXT),
    Argument("used", "Only those with runs, or only others.", _YES_OR_NO),
    Argument("where", "A condition such as `features>=1000`.", TEXT, many=True),
    _limit(PAGE_LENGTH, LARGEST_PAGE),
    AFTER,
)
CELL_ARGUMENTS = (
    _limit(CELLS_LENGTH, MOST_CELLS),
    Argument(
        "after", "Those after this number.", {"type": "integer", "minimum": 0, "maximum": MOST_NUMBER, "default": 0}
    ),
)
GRID_ARGUMENTS = (
    Argument("rows", "The axis of the rows; by default one that says much.", TEXT),
    Argument("columns", "The axis of the columns; by default one that says much.", TEXT),
)
COMPARISON_ARGUMENTS = (
    Argument("runs", "Numbers of 2 to 20 runs, with commas.", TEXT, required=True),
    Argument("protocol", "Fingerprint; by default the protocol that most of the runs have.", TEXT),
    Argument("group", "One column for all repeats.", _choice("configuration")),
)
FIND_ARGUMENTS = (
    Argument("q", "Words of names and descriptions, the number of a run, a tag or a filter.", TEXT, required=True),
)
PUBLIC_ARGUMENTS = (Argument("words", "Only sequences that all these words fit.", TEXT),)
TIMESTAMP_ARGUMENTS = (
    Argument("timestamp", "A header timestamp in s.", {"type": "number", "minimum": 0}, required=True),
)
TIME_ARGUMENTS = (
    Argument("time", "From the start of the recording, in s; its middle by default.", {"type": "number", "minimum": 0}),
)
PART_ARGUMENTS = (
    Argument(
        "offset",
        "Where the part begins: `received_bytes` of the upload.",
        {"type": "integer", "minimum": 0, "maximum": LARGEST_UPLOAD_BYTES},
        required=True,
    ),
)
PHASE_ARGUMENTS = (Argument("phase", "The phase; by default the last that has started.", TEXT),)
ENTRY_ARGUMENTS = (
    Argument("team", "The team; by default the account.", TEXT),
    Argument("phase", "The phase; by default the only one that is open.", TEXT),
)
LOG_ARGUMENTS = (
    Argument(
        "bytes",
        "How much of the end of the log.",
        {"type": "integer", "minimum": 1, "maximum": 200_000, "default": 200_000},
    ),
)
