"""Names of what stands in a run folder beside the run: results, if told no other, and flow."""

from __future__ import annotations

import re

EVALUATION, FILMS = OUTPUTS = "eval", "render"
"""Folders in that of a run; each has the name of its command."""

METRICS = "metrics.json"
"""The file of figures that eval writes, which tells whose the report beside it is."""

REPORTS = "report.md", "report.html"
"""The pages that eval writes beside it."""

PLAYED = "play.html"
"""The page that plays the run, which eval writes beside its report if asked."""

FLOW, FLOW_FILE = "flow", re.compile(r"[0-9a-f]{32}\.npz")
"""The folder in that of a run that keeps flow between pictures, and how its files are called."""
