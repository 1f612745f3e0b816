"""Saved searches, and the names that a filter may use."""

from __future__ import annotations

from flask import request

from slamhive.errors import InvalidInput
from slamhive.schema.api_answers import FilterField, FilterFields, FoundThings, Removal, SavedSearch, SavedSearches
from slamhive.schema.api_requests import SearchRequest
from slamhive.schema.finding import FoundThing
from slamhive.services.exports import RunExport
from slamhive.services.finding import LONGEST_TEXT, find
from slamhive.store.records import RunSort, SavedSearchRecord
from slamhive.web.api.arguments import FIND_ARGUMENTS
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.context import hive
from slamhive.web.presenters.search import fields_of_filters


@TABLE.get(Section.SEARCHES, "/fields", FilterFields)
def filter_fields() -> FilterFields:
    """The names that a filter may use, with unit and values to choose from."""
    return FilterFields(fields=tuple(map(FilterField.model_validate, fields_of_filters(hive()))))


@TABLE.get(Section.SEARCHES, "/find", FoundThings, FIND_ARGUMENTS)
def find_anything() -> FoundThings:
    """Everything with these words in its name or description, of each kind the best 8."""
    text = request.args.get("q", "").strip()[:LONGEST_TEXT]
    if not text:
        raise InvalidInput("q is empty", "say what to find, for example ?q=kiss")
    groups = find(hive(), text)
    return FoundThings(found=tuple(FoundThing.of(entry) for entries in groups.values() for entry in entries))


@TABLE.get(Section.SEARCHES, "/searches", SavedSearches)
def searches() -> SavedSearches:
    """All saved searches."""
    return SavedSearches(searches=tuple(map(SavedSearch.of, hive().searches.saved())))


@TABLE.post(Section.SEARCHES, "/searches", SavedSearch, body=SearchRequest, status=201)
def save_search(body: SearchRequest) -> SavedSearch:
    """Save a search, in place of one of the same name."""
    services = hive()
    services.check_writable()
    RunExport(body.columns, services.searches.vocabulary())  # refuses unknown columns
    sort = RunSort(body.sort, descending=body.descending)
    look = body.pinned, body.colours, body.sparks
    record = SavedSearchRecord(body.name, body.where, body.columns, sort, body.group, *look)
    services.searches.save(record)
    return SavedSearch.of(services.searches.saved_named(body.name))


@TABLE.post(Section.SEARCHES, "/searches/{name}/delete", Removal)
def delete_search(name: str) -> Removal:
    """Delete a saved search."""
    hive().searches.delete(name)
    return Removal(removed=name)
