"""Cameras and moments that the names of photographs propose, as in left07.jpg and right07.jpg.

A name is a folder, runs of letters and runs of digits. One of these parts may stand for the camera if it
takes few values over all photographs, and if the photographs of these values pair up: at least half of them
are of moments that more than half of the cameras share. Dates and times are no cameras. The parts that tell
photographs of one camera apart are then the moment.

Names only propose: two objects that one camera took, numbered alike, are named like two cameras.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import NamedTuple

import numpy as np

FOLDER, LETTERS, DIGITS = "/", "a", "0"
PARTS = re.compile(r"[0-9]+|[^\W\d_]+|(?:[\W_]|[^\D0-9])+")
# Day, and a time after it, as cameras and telephones write them: 20200217, 2020-02-17 at 20.10.05, 17.02.20
DATE = re.compile(
    r"(?:(?:19|20)\d\d([-_. ]?)(?:0\d|1[0-2])\1(?:[0-2]\d|3[01])"
    r"|(?<!\d)[0-3]?\d([-_. ])[0-3]?\d\2(?:19|20)?\d\d(?!\d))"
    r"(?:[-_.,T\s]*(?:[a-z]+\s+)?[0-2]?\d[-_.:h ]?[0-5]\d(?:[-_.:m ]?[0-5]\d)?)?"
)
# Words that people write for a camera; they decide only between parts that could all be one.
CAMERA_WORDS = re.compile(r"cam|camera|left|right|l|r", re.IGNORECASE)
MIN_OF_CAMERA = 2  # photographs
# Bare numbers stand for two cameras, or are serial numbers of at least so many digits: rows and columns of
# positions are numbered too.
MIN_SERIAL_DIGITS = 5
# Largest spread of one moment, in gaps between moments, of cameras whose photographs are numbered by a clock.
# By chance a photograph is so near with a probability of a half, and all of six moments in one of 64 folders.
MAX_SPREAD = 0.25
IN_ORDER = "order"  # moment of `[[rig]]`: by the order of the names


class Part(NamedTuple):
    """A part of a name."""

    kind: str  # FOLDER, LETTERS, DIGITS, or the text itself between these
    text: str


@dataclass(frozen=True)
class NamedCameras:
    """Cameras that the names of photographs propose."""

    camera: Mapping[str, str]  # part of the name that stands for the camera, by photograph
    moment: Mapping[str, str]  # part that photographs of one moment share, by photograph
    pattern: str  # of `[[rig]]`: regular expression with one group, which is the moment; or IN_ORDER


def cameras_in_names(names: Sequence[str]) -> NamedCameras | None:
    """Return the cameras that the names of photographs propose; None if they are of one camera.

    Args:
        names: names of photographs with their folders, such as cam0/0001.png, each once.
    """
    parts = {name: _parts(name) for name in names}
    shapes = Counter(tuple(part.kind for part in parts[name]) for name in names)
    shape, count = shapes.most_common(1)[0] if shapes else ((), 0)
    if 2 * count <= len(names):
        return None
    alike = [name for name in names if tuple(part.kind for part in parts[name]) == shape]
    dated = np.any([_dated(name, parts[name]) for name in alike], axis=0)
    proposals = [
        (
            _strength([parts[name] for name in alike], k),
            -len(set(proposal.camera.values())),
            len(proposal.camera),
            proposal,
        )
        for k, kind in enumerate(shape)
        if kind in (FOLDER, LETTERS, DIGITS)
        and not dated[k]
        and (proposal := _proposal(alike, parts, k)) is not None
    ]
    if not proposals:
        return None
    best = max(proposals, key=lambda proposal: proposal[:3])
    groupings = set()  # sets of photographs of the cameras of each of the best proposals
    for *rank, proposal in proposals:
        if tuple(rank) == best[:3]:
            of: dict[str, set[str]] = defaultdict(set)
            for name, part in proposal.camera.items():
                of[part].add(name)
            groupings.add(frozenset(map(frozenset, of.values())))
    return best[3] if len(groupings) == 1 else None


def divisions_by_names(names: Sequence[str]) -> list[dict[str, str]]:
    """Return the divisions of photographs by a folder or word of their names, whatever their numbers.

    Args:
        names: names of photographs with their folders, each once.

    Returns:
        For each division the word of each photograph, by its name; no word is of fewer than MIN_OF_CAMERA.
    """
    parts = {name: _parts(name) for name in names}
    divisions = []
    for k in range(min((len(name_parts) for name_parts in parts.values()), default=0)):
        word = {name: of_name[k].text for name, of_name in parts.items()}
        if {of_name[k].kind for of_name in parts.values()} not in ({FOLDER}, {LETTERS}):
            continue
        if len(set(word.values())) > 1 and min(Counter(word.values()).values()) >= MIN_OF_CAMERA:
            divisions.append(word)
    return divisions


def _parts(name: str) -> tuple[Part, ...]:
    """Return the parts of a name without its ending."""
    path = PurePosixPath(name)
    folder = (Part(FOLDER, path.parent.as_posix()),) if len(path.parts) > 1 else ()
    texts = PARTS.findall(path.stem)
    return folder + tuple(
        Part(DIGITS if text[0] in "0123456789" else LETTERS if text[0].isalpha() else text, text)
        for text in texts
    )


def _dated(name: str, parts: Sequence[Part]) -> list[bool]:
    """Return which parts of a name overlap a date or its time."""
    stem = PurePosixPath(name).stem
    spans = [match.span() for match in DATE.finditer(stem)]
    end, dated = 0, []
    for part in parts:
        if part.kind == FOLDER:
            dated.append(DATE.search(part.text) is not None)
            continue
        begin, end = end, end + len(part.text)
        dated.append(any(begin < last and first < end for first, last in spans))
    return dated


def _strength(rows: Sequence[tuple[Part, ...]], k: int) -> int:
    """Return how plainly a part stands for a camera: 2 for a word for it, 1 for others, 0 for numbers."""
    kind = rows[0][k].kind
    if kind == FOLDER:
        words = [re.findall(r"[^\W\d_]+", parts[k].text) for parts in rows]
    else:
        words = [[parts[k - 1].text if kind == DIGITS and k else parts[k].text] for parts in rows]
        if kind == DIGITS and len(set(map(tuple, words))) > 1:  # the word before the number is a part itself
            return 0
    if all(any(CAMERA_WORDS.fullmatch(word) for word in name_words) for name_words in words):
        return 2
    return 0 if kind == DIGITS else 1


def _proposal(names: Sequence[str], parts: Mapping[str, tuple[Part, ...]], k: int) -> NamedCameras | None:
    """Return the cameras if part k of the names stands for them; None if the names do not pair up."""
    with_text: dict[str, list[str]] = defaultdict(list)
    for name in names:
        with_text[parts[name][k].text].append(name)
    of = {text: members for text, members in with_text.items() if len(members) >= MIN_OF_CAMERA}
    if len(of) < 2 or 2 * sum(map(len, of.values())) <= len(names):
        return None
    if len(of) > 2 and _strength([parts[name] for name in names], k) == 0:
        serial = min(map(len, of)) >= MIN_SERIAL_DIGITS and len(of) ** 2 < len(names)
        if not serial:
            return None
    shape = [part.kind for part in parts[names[0]]]
    varying = [
        j
        for j, kind in enumerate(shape)
        if kind in (FOLDER, LETTERS, DIGITS)
        and any(len({parts[name][j].text for name in members}) > 1 for members in of.values())
    ]
    named = _by_shared_parts(of, parts, varying, k, len(names) / 2)
    if named is None and shape[k] == FOLDER and [shape[j] for j in varying] == [DIGITS]:
        clock = {name: int(parts[name][varying[0]].text) for members in of.values() for name in members}
        return _by_clock(of, clock)
    return named


def _by_shared_parts(
    of: Mapping[str, Sequence[str]],
    parts: Mapping[str, tuple[Part, ...]],
    varying: Sequence[int],
    k: int,
    fewest: float,
) -> NamedCameras | None:
    """Return cameras whose photographs of a moment share parts of their names; None if fewer do.

    The parts that may be the moment are runs on one side of the camera, short ones first, then all.

    Args:
        of: photographs of each camera.
        parts: parts of the name of each photograph.
        varying: parts that the photographs of a camera do not have in common.
        k: part that stands for the camera.
        fewest: photographs that must share their moment with those of most cameras.
    """
    camera = {name: text for text, members in of.items() for name in members}
    runs = [
        varying[first : first + length]
        for length in range(1, len(varying) + 1)
        for first in range(len(varying) - length + 1)
    ]
    for chosen in [run for run in runs if not run[0] < k < run[-1]] + [varying]:
        moment = {name: tuple(parts[name][j].text for j in chosen) for name in camera}
        if len({(camera[name], moment[name]) for name in camera}) < len(camera):
            continue  # it does not tell the photographs of a camera apart
        cameras_of = Counter(moment.values())
        if sum(cameras_of[moment[name]] > len(of) / 2 for name in camera) < fewest:
            continue
        pattern = _pattern([parts[name] for name in camera], chosen, k)
        orders = {tuple(moment[name] for name in sorted(members)) for members in of.values()}
        if not pattern and len(orders) == 1:  # of each camera, the names are of the same moments
            pattern = IN_ORDER
        return NamedCameras(camera, {name: "-".join(texts) for name, texts in moment.items()}, pattern)
    return None


def _by_clock(of: Mapping[str, Sequence[str]], clock: Mapping[str, int]) -> NamedCameras | None:
    """Return cameras whose photographs are numbered by a clock, if all take one moment after another."""
    ranked = [sorted(members) for members in of.values()]
    if len({len(members) for members in ranked}) > 1:
        return None
    taken = np.array([[clock[name] for name in members] for members in ranked], dtype=float)
    low, high = taken.min(axis=0), taken.max(axis=0)
    gap, spread = low[1:] - high[:-1], np.maximum(high[1:] - low[1:], high[:-1] - low[:-1])
    if (gap <= 0).any() or (spread > MAX_SPREAD * gap).any():
        return None
    camera = {name: value for value, members in of.items() for name in members}
    moment = {name: f"{rank + 1}" for members in ranked for rank, name in enumerate(members)}
    return NamedCameras(camera, moment, IN_ORDER)


def _pattern(rows: Sequence[tuple[Part, ...]], chosen: Sequence[int], k: int) -> str:
    """Return the expression that finds some parts in the names; empty if the camera is between them."""
    first, last = chosen[0], chosen[-1]
    if first < k < last:
        return ""

    def expression(j: int) -> str:
        texts = {parts[j].text for parts in rows}
        folder = "/" if rows[0][j].kind == FOLDER else ""
        if len(texts) == 1:
            return re.sub(r"\\([- ])", r"\1", re.escape(texts.pop())) + folder
        if rows[0][j].kind == DIGITS:
            return "[0-9]+"
        if folder:
            return ".+/"
        every = "".join(texts)
        return r"[^\W\d_]+" if not every.isascii() else "[a-z]+" if every.islower() else "[A-Za-z]+"

    before, group = map(expression, range(first)), map(expression, range(first, last + 1))
    return f"^{''.join(before)}({''.join(group).removesuffix('/')})"
