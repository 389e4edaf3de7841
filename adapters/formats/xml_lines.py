"""XML read into nodes that remember their line, so that whatever is wrong is named with file and line."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from adapters.formats.json_files import MAX_SIDE_PX
from sfm.conventions import FloatArray
from sfm.errors import SurveyFileError, one_line
from sfm.files.csv_tables import MAX_NUMBER, MAX_TABLE_BYTES

MAX_DEPTH = 100  # of elements in one another; exports have about ten


@dataclass
class Node:
    """An element of an XML file."""

    path: Path
    line: int
    tag: str
    attributes: dict[str, str]
    text: str = ""
    children: list[Node] = field(default_factory=list)

    def error(self, message: str) -> SurveyFileError:
        """Return the error of this element."""
        return SurveyFileError(f"{self.path}, line {self.line}: {message}")

    def all(self, tag: str) -> list[Node]:
        """Return the children of that name."""
        return [child for child in self.children if child.tag == tag]

    def maybe(self, tag: str) -> Node | None:
        """Return the first child of that name, None if there is none."""
        return next(iter(self.all(tag)), None)

    def one(self, tag: str) -> Node:
        """Return the first child of that name, which must be there."""
        found = self.maybe(tag)
        if found is None:
            raise self.error(f"<{self.tag}> without <{tag}>")
        return found

    def attribute(self, name: str) -> str:
        """Return an attribute, which must be there."""
        if name not in self.attributes:
            raise self.error(f"<{self.tag}> without {name}")
        return self.attributes[name]

    def number(self, name: str) -> float:
        """Return an attribute that is a finite number."""
        return self._number(self.attribute(name))

    def numbers(self, count: int) -> FloatArray:
        """Return the text, which must be so many finite numbers."""
        words = self.text.split()
        if len(words) != count:
            raise self.error(f"<{self.tag}> with {len(words)} numbers, needed {count}")
        return np.array([self._number(word) for word in words])

    def _number(self, text: str) -> float:
        try:
            value = float(text) if text.isascii() and "_" not in text else np.nan
        except ValueError:
            value = np.nan
        if not abs(value) <= MAX_NUMBER:
            raise self.error(
                f"'{text[:40]}' in <{self.tag}> is not a finite number of at most {MAX_NUMBER:g}"
            )
        return value

    def side_px(self, name: str) -> int:
        """Return an attribute that is the side of a photograph, px."""
        value = self.number(name)
        if not (1 <= value <= MAX_SIDE_PX and value == int(value)):
            raise self.error(f"{name} is {value:g} px, needed a whole number from 1 to {MAX_SIDE_PX}")
        return int(value)


def read_xml(path: Path) -> Node:
    """Read a file and return its root.

    Raises:
        SurveyFileError: the file cannot be read or is not well-formed, with its line.
    """
    parser = expat.ParserCreate()
    top = Node(path, 0, "", {})
    open_nodes = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        if len(open_nodes) > MAX_DEPTH:
            raise SurveyFileError(
                f"{path}, line {parser.CurrentLineNumber}: elements more than {MAX_DEPTH} deep in one another"
            )
        node = Node(path, parser.CurrentLineNumber, tag, attributes)
        open_nodes[-1].children.append(node)
        open_nodes.append(node)

    def text(data: str) -> None:
        open_nodes[-1].text += data

    def doctype(*_: object) -> None:
        # Entities can blow a small file up to gigabytes, and no exporter writes any.
        raise SurveyFileError(f"{path}, line {parser.CurrentLineNumber}: a document type is not allowed here")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_nodes.pop()
    parser.CharacterDataHandler = text
    parser.StartDoctypeDeclHandler = doctype
    try:
        size = Path(path).stat().st_size
        if size > MAX_TABLE_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_TABLE_BYTES} are read")
        with Path(path).open("rb") as file:
            parser.ParseFile(file)
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
    except expat.ExpatError as error:
        raise SurveyFileError(
            f"{path}, line {error.lineno}: not well-formed XML ({expat.ErrorString(error.code)})"
        ) from error
    except (LookupError, ValueError) as error:  # of encodings that Python does not know or expat cannot take
        raise SurveyFileError(
            f"{path}, line 1: the encoding is none that can be read ({one_line(error):.100})"
        ) from error
    return top.children[0]
