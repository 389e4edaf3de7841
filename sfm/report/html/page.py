"""HTML pages, all made from one base template, with the style sheet and its Content-Security-Policy inside.

Every text that comes from a file is escaped by the templates, and a name that they do not know is an error.

The Content-Security-Policy of a page: what it may show and run is what it holds, and nothing else.

Names, reasons and remarks in a page come from files of strangers. They are escaped; should that ever fail
somewhere, a browser still refuses any script, style or address that was not written into the policy.

Source: W3C, Content Security Policy Level 3 (https://www.w3.org/TR/CSP3/), sections 2.3.1 and 6.7.

report.html: one page, readable with no manual, with everything it shows inside it.

In the order of a surveyor's questions: did it work, how good is it, what was rejected and why, does the
other adjuster agree, where are my coordinates. What it says stands in `templates/report.html` and
`templates/report/`.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Sequence
from datetime import datetime
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from sfm.adjustment.quality.statistics import STRONG
from sfm.display import program_name
from sfm.report.figures.overlays import Overlay
from sfm.report.figures.plot_data import Plot
from sfm.report.findings.findings import Findings
from sfm.report.given import R_AND_W, given_parts
from sfm.report.numbers import FILTERS, finer_unit, finer_unit_of, is_number
from sfm.report.page import Page
from sfm.report.phrases import NORMAL_95, PHRASES
from sfm.report.template_cache import template_cache
from sfm.report.viewer.embedded import Viewer

NOTHING = "'none'"


def render(
    template: str, *, viewer: Viewer | None = None, pictures_beside: bool = False, **context: Any
) -> str:
    """Return an HTML page with everything that it shows inside it.

    Args:
        template: name of a template that extends `base.html`.
        viewer: the scene to explore, if the page has one.
        pictures_beside: whether the scene shows pictures that lie beside the page, too.
        context: what the template asks for.
    """
    if viewer is not None:
        policy = content_policy(
            [_style(), viewer.style], [viewer.script, _script()], pictures_beside=pictures_beside
        )
        context |= {"viewer": viewer, "policy": policy}
    return environment().get_template(template).render(context)


def html(page: Page) -> str:
    """Return a declared page as HTML."""
    return render(
        "declared.html",
        viewer=page.viewer,
        pictures_beside=page.pictures_beside,
        page=page,
        kind=page.kind,
        title=page.title,
        headline=page.verdict.headline,
        level=page.verdict.level,
        remarks=page.verdict.lines,
    )


def data_url(data: bytes, kind: str) -> str:
    """Return a picture as an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


@cache
def environment() -> Environment:
    """Return what the templates are rendered with: escaping, no undefined names, our filters and phrases."""
    style = _style()
    made = Environment(
        loader=PackageLoader("sfm.report.html"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        extensions=["jinja2.ext.do"],
        bytecode_cache=template_cache(__name__),
    )
    made.filters |= FILTERS | {"data_url": data_url, "quoted": quote, "right": ">{}".format}
    made.filters["program"] = program_name
    made.tests |= {"numeric": lambda cell: is_number(str(cell)), "nan": math.isnan}
    made.globals |= PHRASES | {
        "NORMAL_95": NORMAL_95,
        "finer_unit": finer_unit,
        "finer_unit_of": finer_unit_of,
        "strong": STRONG,
        "given_parts": given_parts,
        "r_and_w": R_AND_W,
        "style": Markup(style),
        "tables_script": Markup(_script()),
        "policy": content_policy([style], [_script()]),
    }
    return made


@cache
def _script() -> str:
    """Return the script of the tables, which every page has."""
    return files("sfm.report.html").joinpath("tables.js").read_text(encoding="utf-8")


@cache
def _style() -> str:
    return files("sfm.report.html").joinpath("templates/report.css").read_text(encoding="utf-8")


def content_policy(
    styles: Sequence[str], scripts: Sequence[str] = (), *, pictures_beside: bool = False
) -> str:
    """Return the policy of a page with these style sheets and scripts inside it, and pictures as data URLs.

    Attributes `style` and `on...` are allowed nowhere: they would need 'unsafe-inline'.

    Args:
        styles: content of each style element, to the letter.
        scripts: content of each script element that is run, to the letter.
        pictures_beside: whether it shows pictures that lie beside it, which the policy calls 'self'.
    """
    allowed = {
        "default-src": [NOTHING],
        "img-src": ["data:", "'self'"] if pictures_beside else ["data:"],
        "style-src": [_hash(text) for text in styles],
        "script-src": [_hash(text) for text in scripts],
        "base-uri": [NOTHING],
        "form-action": [NOTHING],
    }
    return "; ".join(" ".join((name, *(sources or [NOTHING]))) for name, sources in allowed.items())


def _hash(text: str) -> str:
    """Return the source expression that allows one element by its content."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


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
