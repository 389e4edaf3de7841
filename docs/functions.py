"""Links from names of functions on the pages to their docstrings; a name that does not exist is an error.

A name in code font such as `sfm.model.camera.project` needs no markup. The directive `functions` makes the
target page, which documents every name on the pages of docs/, sorted by module.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.domains.python import PythonDomain
from sphinx.transforms import SphinxTransform
from sphinx.util.docutils import SphinxDirective

import sfm

NAME = re.compile(r"(?:sfm|adapters)(?:\.\w+)+")
DOCS = Path(__file__).parent
PUBLIC = {f"sfm.{name}" for name in sfm.__all__}


def setup(sphinx: Sphinx) -> dict[str, Any]:
    """Add the directive and the links."""
    sphinx.add_directive("functions", FunctionReference)
    sphinx.add_transform(NamesAsLinks)
    return {"parallel_read_safe": True}


def names_on_pages() -> tuple[str, ...]:
    """Return every name in code font on the pages of docs/, except public names, which have another page."""
    names: set[str] = set()
    for page in DOCS.rglob("*.md"):
        prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
        names |= {name for name in re.findall(r"`([\w.]+)`", prose) if NAME.fullmatch(name)}
    return tuple(sorted(names - PUBLIC))


def module_of(name: str) -> str:
    """Return the longest part of a dotted name that is a module.

    Raises:
        ModuleNotFoundError: not even the first part is a module.
    """
    parts = name.split(".")
    module = parts[0]
    for part in parts[1:]:
        inner = f"{module}.{part}"
        is_package = importlib.util.find_spec(module).submodule_search_locations is not None  # type: ignore[union-attr]
        if not is_package or importlib.util.find_spec(inner) is None:
            break
        module = inner
    return module


def documented(name: str) -> tuple[str, str]:
    """Return signature and docstring of a function, class or constant of a module.

    Raises:
        AttributeError: the module has no such name.
    """
    module = module_of(name)
    value: Any = importlib.import_module(module)
    for part in name.removeprefix(module).strip(".").split("."):
        value = getattr(value, part)
    value = getattr(value, "py_func", value)  # a compiled function keeps its Python function here
    short = name.removeprefix(module + ".")
    if inspect.isfunction(value):
        return f"{short}{inspect.signature(value)}", inspect.getdoc(value) or ""
    if inspect.isclass(value):
        return f"class {short}", inspect.getdoc(value) or ""
    return short, ""


class FunctionReference(SphinxDirective):
    """Directive that documents all names on the pages: for each module its docstring, then its functions."""

    def run(self) -> list[nodes.Node]:
        """Return a section for each module."""
        domain = self.env.domains["py"]
        assert isinstance(domain, PythonDomain)
        by_module: dict[str, list[str]] = {}
        for name in names_on_pages():
            by_module.setdefault(module_of(name), []).append(name)
        sections: list[nodes.Node] = []
        for module, names in sorted(by_module.items()):
            doc = inspect.getdoc(importlib.import_module(module)) or ""
            sections.append(self._entry(domain, module, "module", module, doc))
            for name in names:
                if name != module:
                    signature, text = documented(name)
                    sections[-1] += self._entry(domain, name, "function", name, f"{signature}\n\n{text}")
        return sections

    def _entry(self, domain: PythonDomain, name: str, kind: str, title: str, text: str) -> nodes.section:
        """Return a section that is the target of links."""
        label = name.replace(".", "-")
        section = nodes.section(ids=[label])
        section += nodes.title(title, title)
        section += nodes.literal_block("", text.strip(), language="text")
        if name in PUBLIC:  # links lead to the page of public names
            return section
        if kind == "module":
            domain.note_module(name, label, "", "", False)
        domain.note_object(name, kind, label, location=section)
        return section


class NamesAsLinks(SphinxTransform):
    """Makes each name of the program in code font a link to its documentation."""

    default_priority = 400  # after the page is read, before references are resolved

    def apply(self, **_: Any) -> None:
        """Wrap the names in references."""
        for literal in list(self.document.findall(nodes.literal)):
            name = literal.astext()
            inside = isinstance(literal.parent, nodes.reference | addnodes.pending_xref)
            if inside or not (NAME.fullmatch(name) or name in PUBLIC):
                continue
            link = addnodes.pending_xref(
                "", refdomain="py", reftype="obj", reftarget=name, refwarn=True, refexplicit=True
            )
            link["refdoc"] = self.env.docname
            link.source, link.line = literal.source, literal.line
            literal.replace_self(link)
            link += literal
