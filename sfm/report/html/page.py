"""HTML pages, all made from one base template, with the style sheet and its Content-Security-Policy inside.

Every text that comes from a file is escaped by the templates, and a name that they do not know is an error.
"""

from __future__ import annotations

import base64
import math
from functools import cache
from importlib.resources import files
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from sfm.adjustment.quality.statistics import STRONG
from sfm.display import program_name
from sfm.report.html.content_policy import content_policy
from sfm.report.numbers import FILTERS, finer_unit, finer_unit_of, is_number
from sfm.report.phrases import NORMAL_95, PHRASES
from sfm.report.template_cache import template_cache
from sfm.report.viewer.embedded import Viewer


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
