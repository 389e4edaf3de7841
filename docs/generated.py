"""Pages generated from the program when the site is built: survey file, commands and public names."""

from __future__ import annotations

import inspect
import re
import typing
from typing import Any, ClassVar

import typer
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.domains.python import PythonDomain
from sphinx.util.docutils import SphinxDirective
from survey_keys import rows_of, section_of
from typer.testing import CliRunner

import sfm
from sfm.cli.app import app
from sfm.survey.inputs.survey_file import SurveyFile


def setup(sphinx: Sphinx) -> dict[str, Any]:
    """Add the directives."""
    sphinx.add_directive("survey-file", SurveyFileReference)
    sphinx.add_directive("commands", CommandReference)
    sphinx.add_directive("public-names", PythonReference)
    return {"parallel_read_safe": True}


class _Made(SphinxDirective):
    """A directive whose content consists of the sections that `parts` returns."""

    def run(self) -> list[nodes.Node]:
        """Return one section for each part."""
        sections: list[nodes.Node] = []
        for title, content in self.parts():
            section = nodes.section(ids=[label_of(title)])
            section += nodes.title(title, title)
            section += content
            sections.append(section)
        return sections

    def parts(self) -> list[tuple[str, list[nodes.Node]]]:
        """Return title and content of each section."""
        raise NotImplementedError


def label_of(title: str) -> str:
    """Return the fragment of a link to a section."""
    return re.sub(r"\W+", "-", title).strip("-").lower()


class SurveyFileReference(_Made):
    """Every key of the survey file, from the models that check it."""

    def parts(self) -> list[tuple[str, list[nodes.Node]]]:
        """Return a table for each section of the file."""
        rows = []
        for name, field in SurveyFile.model_fields.items():
            section = section_of(field.annotation)
            doc = (inspect.getdoc(section) or "").partition("]: ")[2] or inspect.getdoc(section) or ""
            table = table_of(("key", "type", "default", "meaning"), rows_of(section))
            said = field.alias or name
            title = f"[[{said}]]" if typing.get_origin(field.annotation) is tuple else f"[{said}]"
            rows.append((title, [nodes.paragraph("", doc.lstrip("]: ").capitalize()), table]))
        return rows


class CommandReference(_Made):
    """The --help text of every command."""

    HELP: ClassVar[CliRunner] = CliRunner()

    def parts(self) -> list[tuple[str, list[nodes.Node]]]:
        """Return the help of each command."""
        return [
            (f"kolinear {' '.join(words)}", [nodes.literal_block("", self.help_of(words), language="text")])
            for words in command_names()
        ]

    def help_of(self, words: tuple[str, ...]) -> str:
        """Return the help of a command.

        Raises:
            RuntimeError: the command has no help.
        """
        said = self.HELP.invoke(app, [*words, "--help"], prog_name="kolinear", env={"COLUMNS": "100"})
        if said.exit_code:
            raise RuntimeError(f"kolinear {' '.join(words)} --help ended with {said.exit_code}")
        return str(said.output).strip()


class PythonReference(_Made):
    """Signature and docstring of every public name."""

    def parts(self) -> list[tuple[str, list[nodes.Node]]]:
        """Return signature and docstring of each name."""
        pages = []
        domain = self.env.domains["py"]
        assert isinstance(domain, PythonDomain)
        for name in sorted(sfm.__all__, key=str.lower):
            value = getattr(sfm, name)
            domain.note_object(f"sfm.{name}", "function", label_of(f"sfm.{name}"))
            described = inspect.isfunction(value)
            signature = f"{name}{inspect.signature(value)}" if described else name
            text = f"{signature}\n\n{inspect.getdoc(value)}"
            pages.append((f"sfm.{name}", [nodes.literal_block("", text, language="text")]))
        return pages


def command_names() -> list[tuple[str, ...]]:
    """Return the words of every command; the commands of a group follow the group."""
    root: Any = typer.main.get_command(app)
    names: list[tuple[str, ...]] = []
    for name, command in root.commands.items():
        names.append((name,))
        names += [(name, inner) for inner in getattr(command, "commands", {})]
    return names


def table_of(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> nodes.table:
    """Return a table."""
    group = nodes.tgroup(cols=len(head))
    group += [nodes.colspec(colwidth=width) for width in (2, 4, 2, 6)]
    for kind, lines in ((nodes.thead(), [head]), (nodes.tbody(), rows)):
        for line in lines:
            kind += nodes.row("", *(nodes.entry("", nodes.paragraph("", cell)) for cell in line))
        group += kind
    return nodes.table("", group)
