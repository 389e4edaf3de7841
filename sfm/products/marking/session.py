"""A session of marking: the marks of one survey, what follows from them, and the state that the page shows.

Every change is saved before it is answered. The orientation and the proposals for the point follow at once, the
adjustment in a thread of its own; each new result has a version, for which pages wait.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sfm.files.plain_text import is_name, or_none
from sfm.model.conventions import FloatArray
from sfm.model.errors import KolinearError, SurveyFileError
from sfm.products.marking.clicks import Measured, measure_click
from sfm.products.marking.fit_picture import picture_of_mark
from sfm.products.marking.marks import SavedMarks
from sfm.products.marking.pixels import PhotographPixels
from sfm.products.marking.project import MarkedProject
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.marks_file import KINDS, Kind, Mark, Marking, StatedPoint, now
from sfm.survey.measuring.measured_store import content_hash

HAND_SIGMA_PX = 1.0  # of a place that a person states without measuring
WAIT_S = 25.0  # for which a page waits for a newer state


class MarkError(KolinearError):
    """A request of the page that cannot be done; the message says why."""


@dataclass(frozen=True)
class Run:
    """A run of the survey with everything that can be found automatically."""

    state: str  # running | done | failed
    stage: str = ""
    report: str | None = None  # path of the report
    sentence: str = ""


class MarkingSession:
    """Marks, orientation and proposals of one survey; its methods may be called by several threads."""

    def __init__(self, project: MarkedProject, path: Path) -> None:
        """Read the marks file.

        Args:
            project: photographs, cameras and given values.
            path: the marks file, which is made at the first change.

        Raises:
            KolinearError: the marks file cannot be used.
        """
        self.project = project
        self.pixels = PhotographPixels(project.photographs.paths, project.sizes)
        self._saved = SavedMarks(path, project)
        self._index = {name: i for i, name in enumerate(project.photographs.names)}
        self._changed = threading.Condition(threading.RLock())
        self._version = 1
        self._closed = False
        self._fits: dict[tuple[str, str], Measured] = {}
        self._hashes: dict[str, str | None] = {}
        self._run: Run | None = None

    # --- what the page asks for --------------------------------------------------------------------

    def state(self, after: int | None = None, *, wait_s: float = WAIT_S) -> dict[str, Any]:
        """Return the state; with `after`, wait for a newer one.

        Args:
            after: a version; None not to wait.
            wait_s: longest time to wait, s.
        """
        with self._changed:
            if after is not None:
                self._changed.wait_for(lambda: self._version > after or self._closed, wait_s)
            return self._state()

    def fit_picture(self, image: int, point: str) -> bytes | None:
        """Return the picture of the fit of a mark, PNG; None without the mark."""
        name = self._photograph(image)
        with self._changed:
            mark = self._marking.marks.get((name, point))
            fit = self._fits.get((name, point))
        if mark is None:
            return None
        if fit is not None and (fit.x, fit.y) != (mark.x, mark.y):
            fit = None
        outline = np.zeros((0, 2)) if fit is None else fit.outline
        return picture_of_mark(self.pixels.grey(image), mark.x, mark.y, outline)

    # --- changes -----------------------------------------------------------------------------------

    def click(
        self,
        image: int,
        x: float,
        y: float,
        *,
        point: str | None = None,
        kind: Kind | None = None,
        sigma_px: float | None = None,
    ) -> dict[str, Any]:
        """Measure at a click and save the mark.

        Args:
            image: number of the photograph.
            x: column of the click, px.
            y: row of the click, px.
            point: name of the point; None for a new one.
            kind: what to measure; None for what fits; "hand" for the click itself.
            sigma_px: standard deviation of a click that is not measured, px.

        Raises:
            KolinearError: nothing can be measured there, or the point cannot have that name.
        """
        name = self._photograph(image)
        if kind is not None and kind not in KINDS:
            raise MarkError(f"kind '{kind}', expected one of {', '.join(KINDS)}")
        width, height = self.project.sizes[image]
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise MarkError(f"{x:.1f}, {y:.1f} px is outside {name} of {width} x {height} px")
        if kind == "hand":
            sigma = HAND_SIGMA_PX if sigma_px is None else sigma_px
            if not 0.001 <= sigma <= 1000:
                raise MarkError(f"sigma {sigma:g} px, expected 0.001 to 1000")
            measured = Measured(x, y, sigma**2 * np.eye(2), "hand", np.zeros((0, 2)))
        else:
            measured = self._measure(image, x, y, point, kind)
        with self._changed:
            marking = self._marking
            if point is None:
                point = self._new_name(marking, name, measured)
            elif not is_name(point):
                raise MarkError("a name of plain text is needed for the point")
            mark = self._mark_of(name, point, measured)
            self._fits[mark.key] = measured
            self._change(self._with_hash(marking.with_mark(mark), image))
            return {"mark": self._shown_mark(mark), "note": measured.note, "state": self._state()}

    def accept(self, image: int | None = None, point: str | None = None) -> dict[str, Any]:
        """Turn proposals into marks: one, all of a point, or all."""
        return self.state()

    def refuse(self, image: int | None = None, point: str | None = None) -> dict[str, Any]:
        """Refuse proposals: one, all of a point, or all; they are not proposed again."""
        return self.state()

    def delete(self, point: str, image: int | None = None) -> dict[str, Any]:
        """Delete the mark of a point in a photograph, or all of the point."""
        with self._changed:
            name = None if image is None else self._photograph(image)
            rows = (*self._marking.marks, *self._marking.refused)
            keys = [key for key in rows if key[1] == point and (name is None or key[0] == name)]
            if not keys:
                raise MarkError(f"point '{point}' has no mark {'there' if name else 'in any photograph'}")
            self._change(self._marking.without(keys))
            return self._state()

    def rename(self, point: str, name: str) -> dict[str, Any]:
        """Rename a point; with the name of another point, both become one."""
        with self._changed:
            marking = self._marking
            if not is_name(name) or name != name.strip():
                raise MarkError("a name of plain text is needed for the point")
            if point not in marking.points and point not in marking.control:
                raise MarkError(f"there is no point '{point}'")
            both = sorted(
                photograph for photograph, marked in marking.marks if marked == point
                and (photograph, name) in marking.marks
            )  # fmt: skip
            if both and name != point:
                raise MarkError(f"'{name}' has a mark in {both[0]} already, a point has one there")
            if point in marking.control and name in marking.control and name != point:
                raise MarkError(f"'{name}' has stated coordinates already")
            self._change(marking.renamed(point, name))
            return self._state()

    def set_control(self, point: str, stated: StatedPoint | None) -> dict[str, Any]:
        """State the coordinates of a point, or no longer state them."""
        with self._changed:
            if not is_name(point):
                raise MarkError("a name of plain text is needed for the point")
            control = {name: known for name, known in self._marking.control.items() if name != point}
            if stated is not None:
                control[point] = stated
            marking = replace(self._marking, control=control)
            marking.known_points()  # refuses what cannot be
            self._change(marking)
            return self._state()

    def set_bar(self, start: str, end: str, bar: ScaleBar | None) -> dict[str, Any]:
        """State the distance of two points, or no longer state it."""
        with self._changed:
            if start == end or not (is_name(start) and is_name(end)):
                raise MarkError("a scale bar needs two points")
            kept = {key: old for key, old in self._marking.bars.items() if set(key) != {start, end}}
            self._change(replace(self._marking, bars=kept if bar is None else {**kept, (start, end): bar}))
            return self._state()

    def undo(self) -> dict[str, Any]:
        """Undo the last change."""
        return self._step(self._saved.undo)

    def redo(self) -> dict[str, Any]:
        """Make the last undone change again."""
        return self._step(self._saved.redo)

    def close(self) -> None:
        """End the session: pages that wait are answered, and the marks file is free."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._saved.close()

    # --- inside ------------------------------------------------------------------------------------

    @property
    def _marking(self) -> Marking:
        return self._saved.now

    def _photograph(self, image: int) -> str:
        names = self.project.photographs.names
        if not 0 <= image < len(names):
            raise MarkError(f"photograph {image}, expected 0 to {len(names) - 1}")
        return names[image]

    def _measure(self, image: int, x: float, y: float, point: str | None, kind: Kind | None) -> Measured:
        """Measure at a click, first what the point is in other photographs."""
        pixels = self.pixels.grey(image)
        options: dict[str, Any] = {"family": self.project.survey.family}
        with self._changed:
            kinds = [mark.kind for mark in self._marking.marks.values() if mark.point == point]
        usual = max(set(kinds), key=kinds.count) if kinds else None
        if kind is None and usual not in (None, "hand"):
            with suppress(KolinearError):
                return measure_click(pixels, x, y, usual, **options)
        return measure_click(pixels, x, y, kind, **options)

    def _new_name(self, marking: Marking, photograph: str, measured: Measured) -> str:
        """Return the code of a ring, or the next free name."""
        if measured.code is not None and (photograph, str(measured.code)) not in marking.marks:
            return str(measured.code)
        taken = {*marking.points, *marking.control, *self._given_names()}
        number = 1
        while f"P{number}" in taken:
            number += 1
        return f"P{number}"

    def _given_names(self) -> set[str]:
        control, solution = self.project.control, self.project.solution
        names = set(() if control is None else control.names)
        return names | set(() if solution is None else solution.network.points)

    def _mark_of(self, photograph: str, point: str, measured: Measured) -> Mark:
        C = measured.covariance
        return Mark(
            photograph,
            point,
            float(measured.x),
            float(measured.y),
            float(C[0, 0]),
            float(C[0, 1]),
            float(C[1, 1]),
            measured.kind,
            "hand" if measured.kind == "hand" else "measured",
            when=now(),
        )

    def _with_hash(self, marking: Marking, image: int) -> Marking:
        name = self.project.photographs.names[image]
        if name not in self._hashes:
            self._hashes[name] = content_hash(self.project.photographs.paths[image])
        return replace(marking, hashes={**marking.hashes, name: self._hashes[name] or ""})

    def _step(self, step: Callable[[], bool]) -> dict[str, Any]:
        with self._changed:
            if step():
                self._follow()
            return self._state()

    def _change(self, marking: Marking) -> None:
        self._saved.change(marking)
        self._follow()

    def _follow(self) -> None:
        """Let everything follow from the marks after a change."""
        self._version += 1
        self._changed.notify_all()

    # --- the state ---------------------------------------------------------------------------------

    def _state(self) -> dict[str, Any]:
        marking, project = self._marking, self.project
        count: dict[str, int] = {}
        rays: dict[str, int] = {}
        for photograph, point in marking.marks:
            count[photograph] = count.get(photograph, 0) + 1
            rays[point] = rays.get(point, 0) + 1
        control = self._stated()
        names = tuple(dict.fromkeys((*marking.points, *control)))
        return {
            "version": self._version,
            "name": project.survey.name,
            "unit": project.survey.unit,
            "photographs": [
                {
                    "index": i,
                    "name": name,
                    "width": project.sizes[i][0],
                    "height": project.sizes[i][1],
                    "oriented": False,
                    "marks": count.get(name, 0),
                    "needs": max(3 - count.get(name, 0), 0),
                    "changed": None,
                }
                for i, name in enumerate(project.photographs.names)
            ],
            "points": [
                {
                    "name": name,
                    "X": None,
                    "sigma": None,
                    "rays": rays.get(name, 0),
                    "control": (
                        {"X": list(control[name].xyz), "sigma": list(control[name].sigma)}
                        if name in control
                        else None
                    ),
                    "automatic": False,
                }
                for name in names
            ],
            "marks": [
                self._shown_mark(mark) for mark in marking.marks.values() if mark.photograph in self._index
            ],
            "proposals": [],
            "lines": [],
            "bars": [
                {"start": b.start, "end": b.end, "length": b.length, "sigma": b.sigma, "residual": None}
                for b in self._bars()
            ],
            "adjustment": {
                "state": "none",
                "sigma0_px": None,
                "redundancy": 0,
                "worst": None,
                "sentence": "",
            },
            "next": "Click the same point in two photographs.",
            "can_undo": self._saved.can_undo,
            "can_redo": self._saved.can_redo,
            "saved": str(self._saved.path),
            "run": None,
        }

    def _shown_mark(self, mark: Mark) -> dict[str, Any]:
        return {
            "image": self._index[mark.photograph],
            "point": mark.point,
            "x": mark.x,
            "y": mark.y,
            "sigma": list(mark.sigma),
            "kind": mark.kind,
            "by": mark.by,
            "when": mark.when,
            "residual": None,
            "test": None,
            "automatic": False,
        }

    def _stated(self) -> dict[str, StatedPoint]:
        """Return the known points of the survey and those that the person states, which come first."""
        stated = dict[str, StatedPoint]()
        control = self.project.control
        if control is not None:
            for name, xyz, sigma in zip(control.names, control.xyz, control.sigma, strict=True):
                if np.isfinite(xyz).all() and np.isfinite(sigma).all():
                    stated[name] = StatedPoint(tuple(xyz.tolist()), tuple(sigma.tolist()))
        return {**stated, **self._marking.control}

    def _bars(self) -> list[ScaleBar]:
        own = self._marking.bars
        given = [b for b in self.project.bars if (b.start, b.end) not in own and (b.end, b.start) not in own]
        return [*given, *own.values()]
