"""Builds what all pages have around their content: one file, no network, light and dark."""

from __future__ import annotations

from html import escape
from importlib import resources

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {scripts}"


def shell(
    title: str, kicker: str, heading: str, header: str, main: str, footer: str, script: str = ""
) -> str:
    """Return a page.

    Args:
        title: of the window, plain text.
        kicker: what kind of page it is, plain text.
        heading: what it is about, plain text.
        header: HTML below the heading.
        main: HTML of the content.
        footer: HTML at the end.
        script: name of a file beside this one that is run by the page, if any.
    """
    own = resources.files(__package__)
    style = own.joinpath("page.css").read_text("utf-8")
    code = f"<script>\n{own.joinpath(script).read_text('utf-8')}</script>\n" if script else ""
    policy = _POLICY.format(scripts="'unsafe-inline'" if script else "'none'")
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{style}</style>
</head>
<body>
<header>
<p class="kicker">{escape(kicker)}</p>
<h1>{escape(heading)}</h1>
{header}
</header>
<main>
{main}</main>
<footer>{footer}</footer>
{code}</body>
</html>
"""
