"""Names of what eval and render write into a run folder, if told no other."""

from __future__ import annotations

EVALUATION, FILMS = OUTPUTS = "eval", "render"
"""Folders in that of a run; each has the name of its command."""

METRICS = "metrics.json"
"""The file of figures that eval writes, which tells whose the report beside it is."""

REPORTS = "report.md", "report.html"
"""The pages that eval writes beside it."""
