"""Check of the finished site without a network: internal links must have a target, and nothing is loaded.

Links to other sites are for readers to follow and are not checked. Scripts, styles, fonts and pictures from
other sites are errors, since the site is also read offline.
"""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

if TYPE_CHECKING:  # the tests of this check have no Sphinx
    from sphinx.application import Sphinx

LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "link": "href"}
NOT_LOADED = {"canonical", "next", "prev", "index", "search", "author", "help"}  # of <link rel=...>
MAX_TOLD = 20


class Page(HTMLParser):
    """The links, loaded files and link targets of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.places: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        """Record the links, loaded files and target of an element."""
        values = {name: value or "" for name, value in attributes}
        self.places |= {values[name] for name in ("id", "name") if values.get(name)}
        if tag == "a" and values.get("href"):
            self.links.append(values["href"])
        target = values.get(LOADS.get(tag, ""), "")
        if target and not NOT_LOADED & set(values.get("rel", "").split()):
            self.loads.append(target)


def faults_of(site: Path) -> list[str]:
    """Return the errors in the links of a site, one line each.

    Args:
        site: folder of the pages.
    """
    pages = {
        path: Page(path.read_text(encoding="utf-8"))
        for path in sorted(site.rglob("*.html"))
        if "_static" not in path.relative_to(site).parts  # templates of the theme
    }
    faults = []
    for path, page in pages.items():
        where = path.relative_to(site)
        for target in page.loads:
            parts = urlsplit(target)
            if parts.scheme == "data":
                continue
            if parts.scheme or parts.netloc:
                faults.append(f"{where}: loads {target} from elsewhere")
            elif not (path.parent / unquote(parts.path)).is_file():
                faults.append(f"{where}: {target} is not there")
        for target in page.links:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            other = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not other.is_file():
                faults.append(f"{where}: link to {target}, which is not there")
            elif parts.fragment and other.suffix == ".html":
                places = pages[other].places if other in pages else set()
                if unquote(parts.fragment) not in places:
                    faults.append(f"{where}: link to {target}, which has no such place")
    for style in sorted(site.rglob("*.css")):
        addresses = re.findall(r"url\(['\"]?(https?:[^)'\"]+)", style.read_text(encoding="utf-8"))
        faults += [f"{style.relative_to(site)}: loads {target} from elsewhere" for target in addresses]
    return faults


def check(sphinx: Sphinx, failed: Exception | None) -> None:
    """Check the finished site.

    Args:
        sphinx: the application, which states the folder of the site.
        failed: exception that ended the build, or None.

    Raises:
        RuntimeError: a link has no target, or a file is loaded from another site.
    """
    if failed is None and sphinx.builder.name == "html":
        faults = faults_of(Path(sphinx.outdir).resolve())
        if faults:
            more = f"\n... and {len(faults) - MAX_TOLD} more" if len(faults) > MAX_TOLD else ""
            raise RuntimeError("links of the site:\n" + "\n".join(faults[:MAX_TOLD]) + more)


def setup(sphinx: Sphinx) -> dict[str, Any]:
    """Register the check, which runs when the site is built."""
    sphinx.connect("build-finished", check, priority=900)
    return {"parallel_read_safe": True}
