"""A page of the web: the runs that failed most recently, and a button that starts one of them again.

It has an entry in the menu. Copy this file and change the views.
"""

from flask import Blueprint, flash, redirect, render_template_string, request, url_for
from werkzeug.wrappers import Response

from slamhive.domain.run import RunState
from slamhive.filters.words import matching
from slamhive.web.context import hive
from slamhive.web.pages import PluginPage

# Its name and url_prefix must be its own. Templates of a real package lie in its folder: template_folder="templates".
blueprint = Blueprint("failures", __name__, url_prefix="/failures")

# base.html gives menu, style and messages. The Content-Security-Policy allows no inline scripts and nothing from
# elsewhere. A web form needs the CSRF token, and is of no use in view-only mode, so that it is left out there.
TEMPLATE = """
{% extends "base.html" %}
{% block title %}Failures{% endblock %}
{% block content %}
<h1>Failures</h1>
<p class="quiet">{{ runs | length | plural('run') }} failed, the newest first.</p>
<ul>
{% for run in runs %}
  <li><a href="{{ url_for('runs.show', run_id=run.id) }}">run {{ run.id }}</a>
    {{ run.algorithm }} on {{ run.dataset }}: {{ run.detail }}
    {% if not view_only %}
    <form method="post" action="{{ url_for('failures.again') }}">
      <input type="hidden" name="csrf_token" value="{{ csrf_token() }}">
      <button class="btn btn-sm btn-primary" name="run" value="{{ run.id }}">Start again</button>
    </form>
    {% endif %}
  </li>
{% endfor %}
</ul>
{% endblock %}
"""


@blueprint.get("/")
def index() -> str:
    """The page that the menu leads to; it must be called index."""
    failed = hive().runs.page(matching(states=(RunState.FAILED,)), limit=20)
    return render_template_string(TEMPLATE, runs=failed.records)


@blueprint.post("/again")
def again() -> Response:
    """Changes come by POST only. SLAM Hive checks the CSRF token, and refuses every POST in view-only mode."""
    made = hive().runs.retry(int(request.form["run"]))
    flash(f"Run {made.id} waits for a worker.", "success")
    return redirect(url_for("failures.index"))


PAGE = PluginPage("Failures", blueprint)
