"""The Content-Security-Policy of a page: what it may show and run is what it holds, and nothing else.

Names, reasons and remarks in a page come from files of strangers. They are escaped; should that ever fail
somewhere, a browser still refuses any script, style or address that was not written into the policy.

Source: W3C, Content Security Policy Level 3 (https://www.w3.org/TR/CSP3/), sections 2.3.1 and 6.7.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence

NOTHING = "'none'"


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
