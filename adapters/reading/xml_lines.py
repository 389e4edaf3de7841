"""XML read into nodes that know their line, so that every error names file and line.

Elements that occur in millions are passed on one by one while the file is read, and are not kept. All others
are kept within a limit of memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO
from xml.parsers import expat

import numpy as np

from sfm.files.csv_tables import MAX_NUMBER
from sfm.files.plain_text import MAX_NAME, MAX_SIDE_PX, is_name, shorten
from sfm.model.conventions import FloatArray
from sfm.model.errors import SurveyFileError, one_line

MAX_XML_BYTES = 4_000_000_000
MAX_KEPT_BYTES = 1_000_000_000  # of memory; an export with 100,000 cameras takes half of it
NODE_BYTES, ATTRIBUTE_BYTES = 400, 60  # of memory, without characters
MAX_TEXT = 10_000_000  # characters of an element
MAX_DEPTH = 100  # of nested elements; exports have about ten
MAX_ATTRIBUTES = 100  # of an element
MAX_TAG_BYTES = 1_000_000  # of a tag or comment, which expat must hold whole
PIECE_BYTES = 2**18


@dataclass(slots=True)
class Node:
    """An element of an XML file."""

    path: Path
    line: int
    tag: str
    attributes: dict[str, str]
    text: str = ""
    children: list[Node] = field(default_factory=list)

    def error(self, message: str) -> SurveyFileError:
        """Return an error at this element."""
        return SurveyFileError(f"{self.path}, line {self.line}: {message}")

    def all(self, tag: str) -> list[Node]:
        """Return the children with a tag."""
        return [child for child in self.children if child.tag == tag]

    def maybe(self, tag: str) -> Node | None:
        """Return the first child with a tag; None if there is none."""
        return next(iter(self.all(tag)), None)

    def one(self, tag: str) -> Node:
        """Return the first child with a tag, which must exist.

        Raises:
            SurveyFileError: there is none.
        """
        child = self.maybe(tag)
        if child is None:
            raise self.error(f"<{self.tag}> without <{tag}>")
        return child

    def attribute(self, name: str) -> str:
        """Return an attribute, which must exist.

        Raises:
            SurveyFileError: there is none.
        """
        if name not in self.attributes:
            raise self.error(f"<{self.tag}> without {name}")
        return self.attributes[name]

    def name(self, name: str) -> str:
        """Return an attribute that is a name.

        Raises:
            SurveyFileError: empty, too long or not plain text.
        """
        value = self.attribute(name)
        if not is_name(value):
            raise self.error(f"{name} is '{shorten(value)}', needed plain text of 1 to {MAX_NAME} characters")
        return value

    def number(self, name: str) -> float:
        """Return an attribute that is a finite number."""
        return self._number(self.attribute(name))

    def numbers(self, count: int) -> FloatArray:
        """Return the text, which must consist of a given count of finite numbers.

        Raises:
            SurveyFileError: another count of numbers, or a number that is not finite.
        """
        words = self.text.split(maxsplit=count)
        if len(words) != count:
            count_found = f"more than {count}" if len(words) > count else f"{len(words)}"
            raise self.error(f"<{self.tag}> with {count_found} numbers, needed {count}")
        return np.array([self._number(word) for word in words])

    def _number(self, text: str) -> float:
        try:
            value = float(text) if text.isascii() and "_" not in text else np.nan
        except ValueError:
            value = np.nan
        if not abs(value) <= MAX_NUMBER:
            raise self.error(
                f"'{shorten(text)}' in <{self.tag}> is not a finite number of at most {MAX_NUMBER:g}"
            )
        return value

    def side_px(self, name: str) -> int:
        """Return an attribute that is the side of a photograph, px.

        Raises:
            SurveyFileError: not a possible number of pixels.
        """
        value = self.number(name)
        if not (1 <= value <= MAX_SIDE_PX and value == int(value)):
            raise self.error(f"{name} is {value:g} px, needed a whole number from 1 to {MAX_SIDE_PX}")
        return int(value)


Taken = Mapping[tuple[str, str], Callable[[list[Node]], None]]


def read_xml(path: Path, taken: Taken | None = None) -> Node:
    """Read a file and return its root.

    Args:
        path: the file.
        taken: functions by the tags of a parent and its child. When such a child ends, its function is called
            with the open elements from the root to the child, and the child is not kept.

    Raises:
        SurveyFileError: the file cannot be read, exceeds a limit, or is not well-formed; with the line.
    """
    try:
        size = path.stat().st_size
        if size > MAX_XML_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_XML_BYTES} are read")
        with path.open("rb") as file:
            return _Reader(path, taken or {}).read(file)
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error


class _Reader:
    """Builds nodes from the events of expat."""

    def __init__(self, path: Path, taken: Taken) -> None:
        self.path, self.taken = path, taken
        self.top = Node(path, 0, "", {})
        self.open_nodes: list[Node] = []  # from the root
        self.texts: list[str] = []  # of the innermost element, while it has no children
        self.characters = 0  # in these texts
        self.kept = 0  # bytes of memory
        self.kept_before: list[int] = []  # value of `kept` before each open element
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True  # otherwise every line is a separate piece
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = self.end
        self.parser.CharacterDataHandler = self.text
        self.parser.StartDoctypeDeclHandler = self.refuse_doctype

    def read(self, file: BinaryIO) -> Node:
        """Read a file in pieces, so that nothing too large is held in memory.

        Raises:
            SurveyFileError: not well-formed XML, or a limit is exceeded.
        """
        given = 0
        try:
            while data := file.read(PIECE_BYTES):
                self.parser.Parse(data, False)
                given += len(data)
                if given - self.parser.CurrentByteIndex > MAX_TAG_BYTES:
                    raise self.error(f"a tag or comment of more than {MAX_TAG_BYTES} bytes")
            self.parser.Parse(b"", True)
        except expat.ExpatError as error:
            raise SurveyFileError(
                f"{self.path}, line {error.lineno}: not well-formed XML ({expat.ErrorString(error.code)})"
            ) from error
        except (LookupError, ValueError) as error:  # an encoding that Python or expat do not know
            raise SurveyFileError(
                f"{self.path}, line 1: the encoding cannot be read ({one_line(error):.100})"
            ) from error
        return self.top.children[0]

    def error(self, message: str) -> SurveyFileError:
        """Return an error at the current line."""
        return SurveyFileError(f"{self.path}, line {self.parser.CurrentLineNumber}: {message}")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Open an element.

        Raises:
            SurveyFileError: too many attributes or too deep.
        """
        if len(self.open_nodes) >= MAX_DEPTH:
            raise self.error(f"elements nested more than {MAX_DEPTH} deep")
        if len(attributes) > MAX_ATTRIBUTES:
            raise self.error(f"{len(attributes)} attributes of an element, at most {MAX_ATTRIBUTES} are read")
        node = Node(self.path, self.parser.CurrentLineNumber, tag, attributes)
        (self.open_nodes[-1] if self.open_nodes else self.top).children.append(node)
        self.open_nodes.append(node)
        self.kept_before.append(self.kept)
        self.keep(NODE_BYTES + sum(ATTRIBUTE_BYTES + len(value) for value in attributes.values()))
        self.texts.clear()
        self.characters = 0

    def text(self, piece: str) -> None:
        """Add to the text of the innermost element.

        Raises:
            SurveyFileError: more text than is read.
        """
        self.texts.append(piece)
        self.characters += len(piece)
        if self.characters > MAX_TEXT:
            raise self.error(f"more than {MAX_TEXT} characters of text")

    def end(self, _: str) -> None:
        """Close the innermost element, which has either children or text."""
        node = self.open_nodes[-1]
        if not node.children:
            node.text = "".join(self.texts)
            self.keep(len(node.text))
        self.texts.clear()
        self.characters = 0
        before = self.kept_before.pop()
        take = self.taken.get((self.open_nodes[-2].tag, node.tag)) if len(self.open_nodes) > 1 else None
        if take is not None:
            take(self.open_nodes)
            self.open_nodes[-2].children.pop()
            self.kept = before
        self.open_nodes.pop()

    def keep(self, count: int) -> None:
        """Count bytes of memory.

        Raises:
            SurveyFileError: the limit is exceeded.
        """
        self.kept += count
        if self.kept > MAX_KEPT_BYTES:
            raise self.error(f"the file up to here takes more than {MAX_KEPT_BYTES} bytes of memory")

    def refuse_doctype(self, *_: object) -> None:
        """Refuse entities, which can expand a small file to gigabytes; no exporter writes any.

        Raises:
            SurveyFileError: always.
        """
        raise self.error("a document type is not allowed here")
