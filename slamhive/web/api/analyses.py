"""Analyses: reports that a worker computes from a file."""

from __future__ import annotations

from flask import Response

from slamhive.schema.api_answers import Analyses, Analysis, AnalysisWithFile, CheckedFile, Removal
from slamhive.schema.api_requests import AnalysisRequest, ListingRequest, VisibilityRequest, YamlRequest
from slamhive.services.analyses import MEDIA_TYPES
from slamhive.services.sharing import SharingChange
from slamhive.web import context
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.context import hive
from slamhive.web.json_exchange import answer


@TABLE.get(Section.ANALYSES, "/analyses", Analyses)
def analyses() -> Analyses:
    """The listed analyses."""
    return Analyses(analyses=tuple(map(Analysis.of, hive().stored_analyses.listed())))


@TABLE.post(Section.ANALYSES, "/analyses", Analysis, body=AnalysisRequest, status=201)
def create_analysis(body: AnalysisRequest) -> Analysis:
    """Store an analysis file and queue its computation."""
    record = hive().stored_analyses.create(body.yaml, listed=body.listed)
    computer = context.analysis_computer()
    if computer is not None:
        computer.wake()
    return Analysis.of(record)


@TABLE.post(Section.ANALYSES, "/analyses/check", CheckedFile, body=YamlRequest)
def check_analysis(body: YamlRequest) -> CheckedFile:
    """Check an analysis file without storing it."""
    return CheckedFile(name=hive().stored_analyses.check(body.yaml))


@TABLE.get(Section.ANALYSES, "/analyses/{token}", AnalysisWithFile)
def analysis(token: str) -> AnalysisWithFile:
    """One analysis: its state, its file, and the files of its report."""
    return hive().analysis_files.document(token)


@TABLE.get(Section.ANALYSES, "/analyses/{token}/report", ("application/json",))
def analysis_report(token: str) -> Response:
    """The whole report of one analysis: its plots and tables as data (`report.schema.json`)."""
    return answer(hive().analysis_files.report(token))


@TABLE.get(Section.ANALYSES, "/analyses/{token}/files/{key}", tuple(sorted(set(MEDIA_TYPES.values()))))
def analysis_file(token: str, key: str) -> Response:
    """One file of the report: a plot for print, a table, the self-contained page, or everything as a zip file."""
    content = hive().analysis_files.get(token, key)
    response = Response(content, mimetype=MEDIA_TYPES[key.rpartition(".")[2]])
    response.headers["Content-Disposition"] = f'attachment; filename="{key}"'
    return response


@TABLE.post(Section.ANALYSES, "/analyses/{token}/recompute", Analysis, status=202)
def recompute_analysis(token: str) -> Analysis:
    """Compute one analysis again from the current runs."""
    return Analysis.of(hive().stored_analyses.recompute(token))


@TABLE.post(Section.ANALYSES, "/analyses/{token}/list", Analysis, body=ListingRequest)
def list_analysis(token: str, body: ListingRequest) -> Analysis:
    """Show one analysis in the list, or hide it; its address always works."""
    return Analysis.of(hive().stored_analyses.list_or_not(token, listed=body.listed))


@TABLE.post(Section.ANALYSES, "/analyses/{token}/share", Analysis, body=VisibilityRequest, status=202)
def share_analysis(token: str, body: VisibilityRequest) -> Analysis:
    """Choose who may see one analysis. It is computed again, of the runs that each of its readers may see."""
    return Analysis.of(hive().sharings.analysis(token, SharingChange(body.visibility)))


@TABLE.post(Section.ANALYSES, "/analyses/{token}/delete", Removal)
def delete_analysis(token: str) -> Removal:
    """Delete one analysis for good."""
    hive().stored_analyses.delete(token)
    return Removal(removed=token)
