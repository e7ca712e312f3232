"""Shows the quality of the cameras: a table on the screen and an HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.drawing import draw_path
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.scene.scene import View

SHOWN = 12
"""At most so many names of dropped frames are listed; all are in scene.json."""

_STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;
background:#fff;color:#222}
table{border-collapse:collapse}td{padding:.2rem 1.2rem .2rem 0;border-bottom:1px solid #8884}
.warning{border-left:4px solid #e69f00;padding:.3rem .8rem;margin:.6rem 0;background:#e69f0018}
.good{border-left:4px solid #009e73;padding:.3rem .8rem;background:#009e7318}
.views{display:flex;flex-wrap:wrap;gap:1rem}.views svg{width:26rem;max-width:100%;
border:1px solid #8884}
@media(prefers-color-scheme:dark){body{background:#16181c;color:#ddd}}
"""


def rows(quality: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what is reported and its value, in words."""
    frames, focal = quality["frames"], quality["focal"]
    noted = focal["noted_px"]
    beside = "" if noted is None else f"; the camera noted {noted:.0f} px"
    table = [
        ("frames with a camera", f"{frames['registered']} of {frames['chosen']}"),
        ("reprojection error", f"{quality['reprojection_px']:.2f} px"),
        ("points", f"{quality['points']:,}"),
        ("frames a point is found in", f"{quality['track_length']:.1f} on average"),
        (
            "focal length",
            f"{focal['px']:.0f} px, {focal['field_of_view_deg']:.0f} degrees across{beside}",
        ),
        ("distortion in the corner", f"{quality['corner_distortion_px']:.1f} px"),
        (
            "parallax",
            f"{quality['parallax_deg']:.1f} degrees; the path is "
            f"{quality['path_over_depth']:.2f} times as long as the scene is deep",
        ),
        ("matches that move", f"{100 * quality['moving_matches']:.0f} %"),
        ("matches that a turn explains", f"{100 * quality['turning_matches']:.0f} %"),
    ]
    masks = quality["masks"]
    if masks["from"] != "nothing":
        share = f"{100 * masks['covered']:.0f} % of the pictures"
        table.append(("masks cover", f"{share}, at most {100 * masks['most_covered']:.0f} %"))
    if frames["dropped"]:
        table.insert(1, ("frames without one", _listed(frames["dropped"])))
    return table


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def write_page(
    path: Path,
    title: str,
    quality: Mapping[str, Any],
    views: Sequence[View],
    points: NDArray[np.float64],
) -> None:
    """Write the report as one HTML file, for light and dark screens."""
    cells = "\n".join(
        f"<tr><td>{escape(what)}</td><td>{escape(value)}</td></tr>" for what, value in rows(quality)
    )
    warnings = "\n".join(f'<p class="warning">{escape(text)}</p>' for text in quality["warnings"])
    drawings = draw_path(views, points, (0, 1), "from above") + draw_path(
        views, points, (0, 2), "from the side"
    )
    page = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{escape(title)}</title><style>{_STYLE}</style></head><body>
<h1>{escape(title)}</h1>
{warnings or '<p class="good">Nothing about the cameras looks doubtful.</p>'}
<table>{cells}</table>
<h2>The camera's path</h2>
<p>From the first frame (blue) to the last (orange); grey dots are points of the scene.</p>
<div class="views">{drawings}</div>
</body></html>
"""
    with replacing(path) as beside:
        beside.write_text(page, encoding="utf-8")
