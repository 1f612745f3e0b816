"""The names of version 0.1, for plug-ins that import them; new code imports :mod:`slamhive.analysis.plot_types`."""

from slamhive.analysis.forms.base import FORMS, Form, FormData, FormOptions, RunFiles, RunTrack, RunUsage, one_value

__all__ = ["FORMS", "Form", "FormData", "FormOptions", "RunFiles", "RunTrack", "RunUsage", "one_value"]
