"""report.html: one page, readable with no manual, with everything it shows inside it.

In the order of a surveyor's questions: did it work, how good is it, what was rejected and why, does the
other adjuster agree, where are my coordinates. What it says stands in `templates/report.html` and
`templates/report/`.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from importlib.metadata import version

from sfm.report.figures.overlays import Overlay
from sfm.report.figures.plot_data import Plot
from sfm.report.findings.findings import Findings
from sfm.report.html.page import render
from sfm.report.viewer.embedded import Viewer


def report_page(
    findings: Findings,
    plots: Sequence[Plot],
    overlays: Sequence[Overlay],
    *,
    has_model: bool = False,
    viewer: Viewer | None = None,
) -> str:
    """Return the report as one HTML page.

    Args:
        findings: the result and what is said of it.
        plots: the pictures of the adjustment.
        overlays: the drawn photographs; their thumbnails are embedded, links lead to the overlays folder.
        has_model: whether the folder holds the compared solution as a COLMAP model.
        viewer: the scene to explore, whose pictures may lie beside the page; None leaves it out.
    """
    return render(
        "report.html",
        viewer=viewer,
        pictures_beside=viewer is not None,
        f=findings,
        r=findings.result,
        a=findings.result.adjustment,
        pictures={plot.stem: plot for plot in plots},
        overlays=overlays,
        has_model=has_model,
        written=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        version=version("kolinear"),
    )
