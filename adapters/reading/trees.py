"""YAML and JSON of strangers read into trees of texts, so that every error names the file and the key.

Nothing in a file is executed or made an object: YAML's tags are ignored, and all leaves are texts until a
caller asks for a number. Anchors, by which a small file can expand to gigabytes, are refused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sfm.files.csv_tables import MAX_NUMBER
from sfm.files.plain_text import MAX_SIDE_PX, is_name, shorten
from sfm.model.conventions import FloatArray
from sfm.model.errors import SurveyFileError, one_line

MAX_YAML_BYTES = 2_000_000  # of which PyYAML reads 0.3 MB in a second; a camera has 2,000
MAX_JSON_BYTES = 100_000_000
HEAD_BYTES = 65_536  # by which the format of a file is recognised

TRUE, FALSE = ("true", "1", "yes", "on"), ("false", "0", "no", "off", "")


@dataclass(frozen=True)
class Tree:
    """Texts, lists and trees by their keys."""

    path: Path
    values: Mapping[str, Any]
    place: str = ""  # keys that lead here, each followed by a dot

    def error(self, message: str) -> SurveyFileError:
        """Return an error in this file."""
        return SurveyFileError(f"{self.path}: {message}")

    def key(self, *names: str) -> str | None:
        """Return the first of some keys that is there; None if none is."""
        return next((name for name in names if self.values.get(name) is not None), None)

    def due(self, *names: str) -> str:
        """Return the first of some keys that is there.

        Raises:
            SurveyFileError: none of them is.
        """
        name = self.key(*names)
        if name is None:
            raise self.error(f"{self.place}{names[0]} is missing")
        return name

    def below(self, name: str) -> Tree:
        """Return the tree of a key.

        Raises:
            SurveyFileError: it has none.
        """
        value = self.values[self.due(name)]
        if not isinstance(value, Mapping):
            raise self.error(f"{self.place}{name} is '{shorten(str(value))}', needed keys and values")
        return Tree(self.path, value, f"{self.place}{name}.")

    def items(self, name: str) -> list[Tree]:
        """Return the trees in the list of a key; none if it is missing or empty.

        Raises:
            SurveyFileError: it is no list, or something in it has no keys.
        """
        values = self.values.get(name) or []  # Boost writes "" for an empty list
        if not isinstance(values, list):
            raise self.error(f"{self.place}{name} is '{shorten(str(values))}', needed a list")
        for k, value in enumerate(values):
            if not isinstance(value, Mapping):
                raise self.error(
                    f"{self.place}{name}[{k}] is '{shorten(str(value))}', needed keys and values"
                )
        return [Tree(self.path, value, f"{self.place}{name}[{k}].") for k, value in enumerate(values)]

    def entries(self, name: str) -> dict[str, Tree]:
        """Return the trees below a key by their own keys; none if it is missing.

        Raises:
            SurveyFileError: it has no keys, or something below it has none.
        """
        if self.key(name) is None:
            return {}
        tree = self.below(name)
        return {key: tree.below(key) for key in tree.values}

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text.

        Raises:
            SurveyFileError: it is missing, or is no plain text.
        """
        if default is not None and self.key(name) is None:
            return default
        value = self.values[self.due(name)]
        if not (isinstance(value, str) and is_name(value)):
            raise self.error(f"{self.place}{name} is '{shorten(str(value))}', needed plain text")
        return value

    def truth(self, *names: str) -> bool:
        """Return whether the first of some keys that is there is true; False if none is.

        Raises:
            SurveyFileError: it is no truth value of YAML or JSON.
        """
        name = self.key(*names)
        if name is None:
            return False
        value = str(self.values[name]).lower()
        if value not in TRUE and value not in FALSE:
            raise self.error(
                f"{self.place}{name} is '{shorten(str(self.values[name]))}', needed true or false"
            )
        return value in TRUE

    def number(self, *names: str) -> float:
        """Return a finite number, of the first of some keys that is there."""
        name = self.due(*names)
        return self._number(name, self.values[name])

    def numbers(self, names: tuple[str, ...], *counts: int) -> FloatArray:
        """Return the numbers of a list, of lists in it, or of a matrix of OpenCV or ROS, row by row.

        Args:
            names: keys, of which the first that is there is taken.
            counts: how many numbers there may be; any number if none is given.

        Raises:
            SurveyFileError: missing, another count, or not finite numbers.
        """
        name = self.due(*names)
        value = self.values[name]
        if isinstance(value, Mapping) and "data" in value:
            matrix = Tree(self.path, value, f"{self.place}{name}.")
            data = matrix.numbers(("data",))
            shape = [int(matrix.number(side)) for side in ("rows", "cols") if matrix.key(side)]
            if len(shape) == 2 and shape[0] * shape[1] != len(data):
                raise self.error(
                    f"{self.place}{name}: {len(data)} numbers, rows and cols state {shape[0]} x {shape[1]}"
                )
        else:
            data = np.array([self._number(name, leaf) for leaf in _leaves(value)])
        if counts and len(data) not in counts:
            needed = " or ".join(str(count) for count in counts)
            raise self.error(f"{self.place}{name}: {len(data)} numbers, needed {needed}")
        return data

    def sides(self, width: tuple[str, ...], height: tuple[str, ...]) -> tuple[int, int]:
        """Return width and height of photographs, px.

        Raises:
            SurveyFileError: missing, or no possible numbers of pixels.
        """
        return self.side(self.due(*width), self.number(*width)), self.side(
            self.due(*height), self.number(*height)
        )

    def side(self, name: str, value: float) -> int:
        """Return a number as the side of a photograph, px.

        Raises:
            SurveyFileError: no possible number of pixels.
        """
        if not (1 <= value <= MAX_SIDE_PX and value == int(value)):
            raise self.error(
                f"{self.place}{name} is {value:g} px, needed a whole number from 1 to {MAX_SIDE_PX}"
            )
        return int(value)

    def _number(self, name: str, value: Any) -> float:
        try:
            number = float(value) if isinstance(value, str) and value.isascii() and "_" not in value else None
        except ValueError:
            number = None
        if number is None or not math.isfinite(number) or abs(number) > MAX_NUMBER:
            raise self.error(
                f"{self.place}{name} is '{shorten(str(value))}', needed a finite number of at most "
                f"{MAX_NUMBER:g}"
            )
        return number


def _leaves(value: Any, depth: int = 2) -> list[Any]:
    """Return what is in a list and the lists in it, as in a matrix; a value alone is its only leaf."""
    if not isinstance(value, list) or not depth:
        return [value]
    return [leaf for item in value for leaf in _leaves(item, depth - 1)]


class _Texts(yaml.BaseLoader):  # type: ignore[misc]  # PyYAML has no types
    """Reads every leaf as text, and no anchors."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return a node of the file.

        Raises:
            ComposerError: it stands for another node.
        """
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "an alias, which is not read", event.start_mark)
        return super().compose_node(parent, index)


def head_of(path: Path) -> str:
    """Return the beginning of a file as text, for its format to be recognised.

    Raises:
        SurveyFileError: it cannot be read.
    """
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise SurveyFileError(f"{path}: not a file, a file of a camera is needed")
        with path.open("rb") as file:
            return file.read(HEAD_BYTES).decode("utf-8", "replace")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SurveyFileError(f"{path}: cannot be read ({reason})") from error


def text_of(path: Path, most: int, what: str) -> str:
    """Return a text file in UTF-8.

    Args:
        path: the file.
        most: bytes that are read at most.
        what: name of such a file with its article, for error messages.

    Raises:
        SurveyFileError: it cannot be read, is too large or is not text.
    """
    try:
        if path.exists() and not path.is_file():
            raise SurveyFileError(f"{path}: not a file, {what} is needed")
        size = path.stat().st_size
        if size > most:
            raise SurveyFileError(f"{path}: {size} bytes, {what} has at most {most}")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SurveyFileError(f"{path}: not a text file in UTF-8 (byte {error.start})") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SurveyFileError(f"{path}: cannot be read ({reason})") from error


def read_tree(path: Path, what: str) -> Tree:
    """Read a file of YAML or JSON, which begins with a brace; see `read_trees`."""
    values = _parsed(path, what)
    if not isinstance(values, dict):
        raise SurveyFileError(f"{path}: not {what}, no keys and values are in it")
    return Tree(path, values)


def read_trees(path: Path, what: str) -> list[Tree]:
    """Read a file with a list of trees, which is JSON if it begins with a bracket.

    Args:
        path: the file.
        what: name of such a file with its article, for error messages.

    Raises:
        SurveyFileError: it cannot be read, is too large, or is no list of trees; with the line.
    """
    values = _parsed(path, what)
    if not (isinstance(values, list) and values and all(isinstance(value, dict) for value in values)):
        raise SurveyFileError(f"{path}: not {what}, no list of keys and values is in it")
    return [Tree(path, value, f"[{k}].") for k, value in enumerate(values)]


def _parsed(path: Path, what: str) -> Any:
    """Return what is in a file of YAML or JSON.

    Args:
        path: the file.
        what: name of such a file with its article, for error messages.

    Raises:
        SurveyFileError: it cannot be read, is too large, or is neither; with the line.
    """
    text = text_of(path, MAX_JSON_BYTES, what)
    try:
        if text.lstrip().startswith(("{", "[")):
            return json.loads(text, parse_float=str, parse_int=str, parse_constant=str)
        if len(text) > MAX_YAML_BYTES:
            raise SurveyFileError(f"{path}: {len(text)} characters, at most {MAX_YAML_BYTES} are read")
        # OpenCV begins with %YAML:1.0, which is no directive of YAML
        version, _, rest = text.partition("\n")
        return yaml.load(f"\n{rest}" if version.startswith("%YAML") else text, _Texts)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise SurveyFileError(
            f"{path}, line {line}: not {what} ({' '.join(str(error.problem).split())})"
        ) from error
    except yaml.YAMLError as error:
        raise SurveyFileError(f"{path}: not {what} ({one_line(error):.100})") from error
    except json.JSONDecodeError as error:
        raise SurveyFileError(f"{path}, line {error.lineno}: not {what} ({error.msg})") from error
    except (RecursionError, ValueError) as error:
        raise SurveyFileError(
            f"{path}: not {what} (lists nested too deeply, or a number too long)"
        ) from error
