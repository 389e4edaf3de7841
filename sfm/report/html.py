"""A declared page as HTML, with everything that it shows inside it, and its Content-Security-Policy.

Names, reasons and remarks in a page come from files of strangers. The template escapes them; should that ever
fail somewhere, a browser still refuses any script, style or address that is not in the policy.

Source: W3C, Content Security Policy Level 3 (https://www.w3.org/TR/CSP3/), sections 2.3.1 and 6.7.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from sfm.display import bound
from sfm.report.numbers import is_number
from sfm.report.page import Page

NOTHING = "'none'"


def html(page: Page) -> str:
    """Return a page as HTML."""
    style, script = source("report.css"), source("tables.js")
    policy = content_policy(
        [style, page.viewer.style] if page.viewer else [style],
        [page.viewer.script, script] if page.viewer else [script],
        pictures_beside=page.pictures_beside,
    )
    parts = {"style": Markup(style), "tables_script": Markup(script), "policy": policy}
    return _template().render(page=page, **parts)


def data_url(data: bytes, kind: str) -> str:
    """Return a picture as an address that contains it."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


@cache
def source(name: str) -> str:
    """Return the style sheet or the script of all pages."""
    return files("sfm.report").joinpath(f"templates/{name}").read_text(encoding="utf-8")


@cache
def _template() -> Template:
    """Return the template of all pages: it escapes texts, and a name that is not defined is an error."""
    made = Environment(
        loader=PackageLoader("sfm.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"bound": bound, "data_url": data_url, "quoted": quote}
    made.tests["numeric"] = lambda cell: is_number(str(cell))
    return made.get_template("page.html")


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
