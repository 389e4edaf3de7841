"""A session of marking: the marks of one survey, what follows from them, and the state that the page shows.

Every change is saved before it is answered. The orientation and the proposals for the point follow at once,
the adjustment in a thread of its own; each new result has a version, for which pages wait.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from sfm.files.plain_text import is_name, or_none
from sfm.model.display import counted
from sfm.model.errors import GeometryError, KolinearError, PhotographError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.products.marking.automatic import AutomaticRun, Run
from sfm.products.marking.clicks import Measured, measure_click
from sfm.products.marking.evidence import PictureEvidence
from sfm.products.marking.fit_picture import picture_of_mark
from sfm.products.marking.following import (
    Following,
    Proposal,
    automatic_image_points,
    bars_of,
    follow,
    marks_needed,
    match_single,
    propose,
    sentence_of,
    stated_points,
    template_of,
    without_moved,
)
from sfm.products.marking.guidance import SAME_PX, Guide
from sfm.products.marking.marks import Change, SavedMarks
from sfm.products.marking.pixels import PhotographPixels
from sfm.products.marking.project import MarkedProject
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.marks_file import KINDS, Kind, Mark, Marking, StatedPoint, now
from sfm.survey.measuring.measured_store import content_hash

HAND_SIGMA_PX = 1.0  # of a place that a person states without measuring
WAIT_S = 25.0  # for which a page waits for a newer state
MOST_WAITING = 3  # pages that wait at a time: a browser opens six connections, and clicks need some


LATER = "what is proposed there came later than what the page shows: look at it, then decide"


class MarkError(KolinearError):
    """A request of the page that cannot be done; the message says why."""


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
        self._turns, self._waiting = count(), list[int]()  # requests that wait for a newer state
        self._fits: dict[tuple[str, float, float], Measured | None] = {}  # by photograph and place
        self._new: set[Mark] = set()  # marks of this session
        self._hashes: dict[str, str] = {}  # of photographs, as they are now
        self._run: Run | None = None
        self._running: AutomaticRun | None = None
        self._evidence = PictureEvidence(
            self.pixels.grey, [project.cameras[k] for k in project.photographs.camera]
        )
        self._automatic = {(row.photograph, row.point): row for row in automatic_image_points(project)}
        self._following: Following | None = None
        self._proposals: dict[tuple[str, str], Proposal] = {}
        self._since: dict[tuple[str, str], int] = {}  # version of the state that showed a proposal first
        self._changes = 1  # of the marks, since the beginning
        self._followed = 0  # changes that the orientation follows
        self._failed = ""  # why the orientation failed
        self._latest = ""  # point of the last click
        self._worker = threading.Thread(target=self._follow_changes, name="marks", daemon=True)
        self._worker.start()

    # --- what the page asks for --------------------------------------------------------------------

    def state(self, after: int | None = None, *, wait_s: float = WAIT_S) -> dict[str, Any]:
        """Return the state; with `after`, wait for a newer one.

        Where many requests wait, the oldest is answered.

        Args:
            after: a version; None not to wait.
            wait_s: longest time to wait, s.
        """
        with self._changed:
            if after is not None:
                turn = next(self._turns)
                self._waiting.append(turn)
                self._changed.notify_all()
                self._changed.wait_for(
                    lambda: (
                        self._version > after or self._closed or turn not in self._waiting[-MOST_WAITING:]
                    ),
                    wait_s,
                )
                self._waiting.remove(turn)
            return self._state()

    def fit_picture(self, image: int, point: str) -> bytes | None:
        """Return the picture of the fit of a mark, PNG; None without the mark."""
        name = self._photograph(image)
        with self._changed:
            mark = self._marking.marks.get((name, point))
            if mark is None and (name, point) in self._automatic:
                mark = self._mark_of_automatic((name, point))
        if mark is None:
            return None
        fit = self._fit(mark)
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
        page: str = "",
    ) -> dict[str, Any]:
        """Measure at a click and save the mark.

        Args:
            image: number of the photograph.
            x: column of the click, px.
            y: row of the click, px.
            point: name of the point; None for a new one.
            kind: what to measure; None for what fits; "hand" for the click itself.
            sigma_px: standard deviation of a click that is not measured, px.
            page: the page that asks, as in all changes.

        Raises:
            KolinearError: nothing can be measured there, it is another ring than at the other marks of the
                point, or the point cannot have that name.
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
            self._refuse_other_ring(name, point, measured)
        with self._changed:
            marking = self._marking
            if point is None:
                point = self._new_name(marking, name, measured)
            elif not is_name(point):
                raise MarkError("a name of plain text is needed for the point")
            mark = self._mark_of(name, point, measured)
            self._latest = point
            again = " again" if mark.key in marking.marks else ""
            self._change(
                self._with_marks(marking, [(mark, measured)]), f"{point} marked in {name}{again}", page
            )
            note, code = measured.note, measured.code
            if code is not None and point.isdecimal() and point != str(code):
                note = f"its code is {code}"
            return {"mark": self._shown_mark(mark), "note": note, "state": self._state()}

    def accept(
        self, image: int | None = None, point: str | None = None, *, seen: int | None = None, page: str = ""
    ) -> dict[str, Any]:
        """Turn measured proposals into marks: one, all of a point, or all.

        Args:
            image: number of the photograph; None for all.
            point: name of the point; None for all.
            seen: version of the state that the page shows; what is proposed since then stays proposed.
            page: the page that asks.

        Returns:
            The number of new marks, and the state.
        """
        with self._changed:
            chosen, later = self._chosen(image, point, seen)
            new = [
                (self._mark_of(*key, proposal.measured), proposal.measured)
                for key, proposal in chosen.items()
                if proposal.measured is not None
            ]
            if not new:
                raise MarkError(LATER if later else "nothing was measured there: click it")
            self._change(
                self._with_marks(self._marking, new), f"{_told([mark for mark, _ in new])} accepted", page
            )
            return {"count": len(new), "state": self._state()}

    def refuse(
        self, image: int | None = None, point: str | None = None, *, seen: int | None = None, page: str = ""
    ) -> dict[str, Any]:
        """Refuse proposals: one, all of a point, or all; they are not proposed again.

        An image point that was measured automatically is refused too, by its photograph and point.

        Args: as of `accept`.

        Returns:
            The number of refused places, and the state.
        """
        with self._changed:
            refused: list[Mark] = []
            if image is not None and point is not None:
                key = self._photograph(image), point
                if key in self._automatic and key not in self._marking.marks:
                    refused.append(self._mark_of_automatic(key))
            if not refused:
                chosen, later = self._chosen(image, point, seen)
                for key, proposal in chosen.items():
                    x, y = proposal.xy.tolist()
                    place = proposal.measured or Measured(x, y, np.eye(2), "hand", np.zeros((0, 2)))
                    refused.append(self._mark_of(*key, place))
                if not refused:
                    raise MarkError(LATER if later else "nothing is proposed there")
            marking = self._marking
            for mark in refused:
                marking = marking.with_refused(mark)
            self._change(marking, f"{_told(refused)} refused", page)
            return {"count": len(refused), "state": self._state()}

    def _chosen(
        self, image: int | None, point: str | None, seen: int | None
    ) -> tuple[dict[tuple[str, str], Proposal], int]:
        """Return the proposals of a photograph and point, of a point, or all, and how many came later."""
        photograph = None if image is None else self._photograph(image)
        meant = [key for key in self._proposals if photograph in (None, key[0]) and point in (None, key[1])]
        shown = [key for key in meant if seen is None or self._since[key] <= seen]
        return {key: self._proposals[key] for key in shown}, len(meant) - len(shown)

    def sight(self, image: int, x: float, y: float) -> list[dict[str, Any]]:
        """Return the ray of sight through a place of a photograph, in all other oriented photographs."""
        self._photograph(image)
        with self._changed:
            guide = self._guide()
        if guide is None:
            return []
        lines = guide.lines(image, np.array([x, y]))
        return [{"image": j, "xy": np.round(path, 2).tolist()} for j, path in lines]

    def _guide(self) -> Guide | None:
        return None if self._following is None else self._following.guide

    def delete(self, point: str, image: int | None = None, *, page: str = "") -> dict[str, Any]:
        """Delete the mark of a point in a photograph, or all of the point."""
        with self._changed:
            name = None if image is None else self._photograph(image)
            marking = self._marking
            found = marking.marks.keys() | marking.refused.keys()
            if name is None:  # what was measured automatically does not come back
                found = (found | self._automatic.keys()) - (marking.refused.keys() & self._automatic.keys())
            keys = {key for key in found if key[1] == point and (name is None or key[0] == name)}
            if not keys:
                raise MarkError(f"point '{point}' has no mark {'there' if name else 'in any photograph'}")
            marking = marking.without(keys)
            for key in self._automatic if name is None else ():
                if key in keys:
                    marking = marking.with_refused(self._mark_of_automatic(key))
            self._change(marking, f"{point} deleted{f' in {name}' if name else ''}", page)
            return self._state()

    def rename(self, point: str, name: str, *, page: str = "") -> dict[str, Any]:
        """Rename a point; with the name of another point, both become one."""
        with self._changed:
            marking = self._marking
            if not is_name(name) or name != name.strip():
                raise MarkError("a name of plain text is needed for the point")
            automatic = [key for key in self._automatic if key[1] == point and key not in marking.refused]
            if point not in marking.points and point not in marking.control and not automatic:
                raise MarkError(f"there is no point '{point}'")
            if name == point:
                return self._state()
            shown = marking.marks.keys() | (self._automatic.keys() - marking.refused.keys())
            both = sorted(
                photograph for photograph, of in shown if of == point and (photograph, name) in shown
            )
            if both:
                raise MarkError(f"'{name}' has a mark in {both[0]} already, a point has one there")
            if point in marking.control and name in marking.control:
                raise MarkError(f"'{name}' has stated coordinates already")
            if any({bar.start, bar.end} == {point, name} for bar in marking.bars.values()):
                raise MarkError(f"a scale bar is between '{point}' and '{name}', which are two points")
            # of what was measured automatically the new name is a mark, and the old one is left out
            new = [self._mark_of_automatic(key) for key in automatic if key not in marking.marks]
            marking = self._with_marks(marking, [(mark, None) for mark in new])
            renamed = marking.renamed(point, name, self._automatic.keys())
            for key in automatic:
                old = marking.marks[key]
                renamed = replace(renamed, refused={**renamed.refused, key: replace(old, state="refused")})
            self._change(renamed, f"{point} renamed {name}", page)
            return self._state()

    def set_control(self, point: str, stated: StatedPoint | None, *, page: str = "") -> dict[str, Any]:
        """State the coordinates of a point, or no longer state them."""
        with self._changed:
            if not is_name(point):
                raise MarkError("a name of plain text is needed for the point")
            if stated is None and point not in self._marking.control:
                raise MarkError(f"the page states no coordinates of '{point}'; those of the survey stay")
            control = {name: known for name, known in self._marking.control.items() if name != point}
            if stated is not None:
                control[point] = stated
            marking = replace(self._marking, control=control)
            marking.known_points()  # refuses what cannot be
            self._change(
                marking, f"coordinates of {point} {'stated' if stated else 'no longer stated'}", page
            )
            return self._state()

    def set_bar(self, start: str, end: str, bar: ScaleBar | None, *, page: str = "") -> dict[str, Any]:
        """State the distance of two points, or no longer state it."""
        with self._changed:
            if start == end or not (is_name(start) and is_name(end)):
                raise MarkError("a scale bar needs two points")
            own = self._marking.bars
            kept = {key: old for key, old in own.items() if set(key) != {start, end}}
            if bar is None and len(kept) == len(own):
                raise MarkError(f"the page states no bar {start} - {end}; one of the survey stays")
            self._change(
                replace(self._marking, bars=kept if bar is None else {**kept, (start, end): bar}),
                f"bar {start} - {end} {'deleted' if bar is None else 'stated'}",
                page,
            )
            return self._state()

    def undo(self, number: int | None = None, *, page: str = "", anyway: bool = False) -> dict[str, Any]:
        """Undo the last change.

        Args:
            number: number of the change that the page shows as the last one; None for whatever is the last.
            page: the page that asks.
            anyway: whether it may be a change that another page made.

        Raises:
            MarkError: it is another change, or one of another page; or there is none.
        """
        return self._step(lambda: self._saved.last, self._saved.undo, number, None if anyway else page)

    def redo(self, number: int | None = None, *, page: str = "", anyway: bool = False) -> dict[str, Any]:
        """Make the change again that was undone last, as `undo`."""
        return self._step(lambda: self._saved.last_undone, self._saved.redo, number, None if anyway else page)

    def _step(
        self,
        last: Callable[[], Change | None],
        step: Callable[[], None],
        number: int | None,
        page: str | None,
    ) -> dict[str, Any]:
        with self._changed:
            before, change = self._marking, last()
            if change is None:
                raise MarkError("there is no such change any more")
            if number not in (None, change.number):
                raise MarkError(f"in between something else was changed: {change.what}; look at it first")
            if page is not None and change.page not in ("", page):
                raise MarkError(f"another page made this change: {change.what}")
            step()
            self._follow(before)
            return self._state()

    def add(self, other: Marking) -> int:
        """Add marks and control of another program; own ones stay.

        Returns:
            Number of marks that are added.
        """
        with self._changed:
            marking = self._marking
            new = [(mark, None) for key, mark in other.marks.items() if key not in marking.marks]
            marking = self._with_marks(marking, new)
            control = {**other.control, **marking.control}
            self._change(replace(marking, control=control), f"{counted(len(new), 'mark')} added", "")
            return len(new)

    def exported(self) -> tuple[Network, Estimate]:
        """Return all marks as a network, with what is oriented by them."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._followed >= self._changes)
            following = self._following
        if following is None:
            raise MarkError(f"{self._saved.path}: no mark can be written")
        return following.marked.network, following.estimate

    def automatic(self) -> dict[str, Any]:
        """Run the survey with its marks and everything that can be found automatically, to a report."""
        with self._changed:
            if self._run is not None and self._run.state == "running":
                raise MarkError("the survey is running already")
            if not self._marking.marks:
                raise MarkError("there is no mark yet")
            project, control = self.project, len(stated_points(self.project, self._marking)) >= 3
            self._running = AutomaticRun(
                project.survey_file, project.photographs.folder, self._saved.path, project.survey.name
            )
            self._run = Run("running", "starting")
            work = self._running
            threading.Thread(
                target=lambda: work.run(self._tell, control=control), name="run", daemon=True
            ).start()
            self._version += 1
            self._changed.notify_all()
            return self._state()

    def report_file(self, name: str) -> Path | None:
        """Return the path of a file of the last report, named as in its folder; None without it."""
        with self._changed:
            report = None if self._run is None else self._run.report
        if report is None or "\0" in name:
            return None
        folder = Path(report).parent.resolve()
        path = (folder / name).resolve()
        return path if path.is_relative_to(folder) and path.is_file() else None

    def _tell(self, run: Run) -> None:
        """Take news of a run."""
        with self._changed:
            self._run = run
            self._version += 1
            self._changed.notify_all()

    def close(self) -> None:
        """End the session: pages that wait are answered, and the marks file is free."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._running is not None:
            self._running.stop()
        self._worker.join()
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
        family, name = self.project.survey.family, self._photograph(image)
        if kind == "ring" and family is None:
            raise MarkError(
                "the survey names no family of codes: mark the ring as target, and name the point"
            )
        pixels = self.pixels.grey(image)
        with self._changed:
            marks = [
                mark
                for mark in self._marking.marks.values()
                if mark.point == point and mark.by == "measured" and mark.photograph != name
            ]
        kinds: list[Kind] = [mark.kind for mark in marks]
        usual = Counter(kinds).most_common(1)[0][0] if kinds else None
        if usual == "window" and kind in (None, "window"):
            first = next(mark for mark in marks if mark.kind == "window")
            template = template_of(first, self.pixels.grey, self.project)
            if template is None:
                raise MarkError(f"{first.photograph}, which shows the window of '{point}', cannot be read")
            return measure_click(pixels, x, y, "window", template=template)
        if marks and kind == "window":
            raise MarkError(f"'{point}' is a {usual} in {marks[0].photograph}, not a window")
        if kind is None and usual == "ring":  # its code may be unreadable here
            usual = "target"
        return measure_click(pixels, x, y, kind or usual, family=family)

    def _refuse_other_ring(self, photograph: str, point: str | None, measured: Measured) -> None:
        """Raise MarkError if a ring has another code than at the other marks of its point."""
        with self._changed:
            marks = [m for m in self._marking.marks.values() if m.point == point and m.kind == "ring"]
        for mark in marks if measured.code is not None else ():
            fit = self._fit(mark) if mark.photograph != photograph else None
            if fit is not None and fit.code not in (None, measured.code):
                raise MarkError(
                    f"this is ring {measured.code}, but '{point}' is ring {fit.code} in {mark.photograph}"
                )

    def _fit(self, mark: Mark) -> Measured | None:
        """Return what was measured at a mark, or is measured there again; None where that is not possible."""
        place = mark.photograph, mark.x, mark.y
        if place not in self._fits:
            measured = None
            if mark.photograph in self._index and mark.kind not in ("window", "hand"):
                kind: Kind = "target" if mark.kind == "ring" else mark.kind
                family = self.project.survey.family
                with suppress(GeometryError, PhotographError):
                    pixels = self.pixels.grey(self._index[mark.photograph])
                    fit = measure_click(pixels, mark.x, mark.y, kind, family=family)
                    measured = fit if np.hypot(fit.x - mark.x, fit.y - mark.y) <= SAME_PX else None
            self._fits[place] = measured
        return self._fits[place]

    def _new_name(self, marking: Marking, photograph: str, measured: Measured) -> str:
        """Return the code of a ring, or the next free name."""
        if measured.code is not None and (photograph, str(measured.code)) not in marking.marks:
            return str(measured.code)
        control, solution = self.project.control, self.project.solution
        taken = {*marking.points, *marking.control, *(() if control is None else control.names)}
        taken |= set(() if solution is None else solution.network.points)
        taken |= {point for _, point in (*marking.refused, *self._automatic)}
        taken |= {end for bar in bars_of(self.project, marking) for end in (bar.start, bar.end)}
        taken |= {named.name for named in self.project.survey.marks}
        number = 1
        while f"P{number}" in taken:
            number += 1
        return f"P{number}"

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

    def _mark_of_automatic(self, key: tuple[str, str]) -> Mark:
        row = self._automatic[key]
        return self._mark_of(*key, Measured(*row.xy, row.covariance, "target", np.zeros((0, 2))))

    def _with_marks(self, marking: Marking, new: Iterable[tuple[Mark, Measured | None]]) -> Marking:
        """Return the marking with new marks and what was measured there, and the hashes of their photographs.

        A hash stays that of the file in which older marks of the photograph were measured.
        """
        changed = dict[str, None]()
        for mark, measured in new:
            if measured is not None:
                self._fits[mark.photograph, mark.x, mark.y] = measured
            marking = marking.with_mark(mark)
            self._new.add(mark)
            changed[mark.photograph] = None
        older = {mark.photograph for mark in marking.marks.values() if mark not in self._new}
        hashes = {name: self._hash(name) for name in changed if name not in older & marking.hashes.keys()}
        return replace(marking, hashes={**marking.hashes, **hashes})

    def _hash(self, photograph: str) -> str:
        """Return the hash of a photograph, as it was when the session first asked for it."""
        if photograph not in self._hashes:
            self._hashes[photograph] = content_hash(self.project.photographs.paths[self._index[photograph]])
        return self._hashes[photograph]

    def _change(self, marking: Marking, what: str, page: str) -> None:
        if self._closed:
            raise MarkError("the page has been ended; nothing was saved")
        before = self._marking
        self._saved.change(marking, what, page)
        self._follow(before)

    def _show(self, proposals: dict[tuple[str, str], Proposal]) -> None:
        """Show proposals in the state of this version; those that are where they were keep theirs."""
        shown = self._proposals
        self._since = {
            key: self._since[key] if key in shown and proposal.is_as(shown[key]) else self._version
            for key, proposal in proposals.items()
        }
        self._proposals = proposals

    def _follow(self, before: Marking) -> None:
        """Let what is known at once follow from a change, and the rest in the background.

        The points that changed get new proposals from the orientation so far.
        """
        marking = self._marking
        self._version += 1
        self._changes += 1
        gone = marking.marks.keys() | marking.refused.keys()
        self._show({key: old for key, old in self._proposals.items() if key not in gone})
        changed = {
            key[1]
            for new, old in ((marking.marks, before.marks), (marking.refused, before.refused))
            for key in new.keys() | old.keys()
            if new.get(key) is not old.get(key)
        }
        last = self._following
        now_following = None if last is None else without_moved(last, marking, self.project)
        try:
            if now_following is not None and len(changed) == 1:
                self._propose_again(now_following, changed)
        except Exception as error:  # what is saved is saved; all proposals follow in the background
            self._failed = f"No proposals yet ({type(error).__name__}: {error})."
        finally:
            self._changed.notify_all()

    def _propose_again(self, following: Following, changed: set[str]) -> None:
        """Propose the places of points from their rays and the orientation so far."""
        points, guide, number = following.estimate.points.copy(), following.guide, following.marked.point
        adjustment = following.adjustment
        for name in changed & number.keys():
            j = number[name]
            is_adjusted = adjustment is not None and j < len(adjustment.points) and adjustment.points[j]
            if not is_adjusted and name not in following.marked.control:
                points[j] = guide.with_rays(j)
        following = replace(following, estimate=replace(following.estimate, points=points))
        kept = {key: old for key, old in self._proposals.items() if key[1] not in changed}
        with suppress(KolinearError):
            new = propose(following, self._marking, self.pixels.grey, self.project, self._fit, changed)
            self._show({**kept, **new})

    def _follow_changes(self) -> None:
        """Compute what follows from the marks whenever they changed, until the session ends."""
        for name in self._saved.now.hashes.keys() & self._index.keys():  # did their files change?
            with suppress(PhotographError, OSError):
                self._hash(name)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._followed < self._changes)
                if self._closed:
                    return
                changes, marking, last = self._changes, self._marking, self._following
                known, latest = dict(self._proposals), self._latest
            following: Following | None
            try:
                following = follow(self.project, marking, self._evidence, last)
                read, fit = self.pixels.grey, self._fit
                proposals = propose(following, marking, read, self.project, fit, known=known)
                proposals |= match_single(following, latest, marking, read, self.project, fit)
                # proposals of points with one mark stay until a person decides
                rays = Counter(point for _, point in marking.marks)
                gone = marking.marks.keys() | marking.refused.keys()
                stay = {key: known[key] for key in known if rays[key[1]] == 1 and key not in gone}
                proposals = {**stay, **proposals}
                failed = ""
            except KolinearError as error:
                following, proposals, failed = last, {}, str(error)
            except Exception as error:  # a fault is said; the next change is followed again
                fault = f"{type(error).__name__}: {error}"
                following, proposals, failed = (
                    last,
                    {},
                    f"Nothing follows from the marks, which are saved ({fault}).",
                )
            with self._changed:
                self._followed, self._failed = changes, failed
                self._version += 1
                if changes == self._changes:
                    self._following = following
                    self._show(proposals)
                elif following is not None:
                    self._following = following  # the next round continues it
                self._changed.notify_all()
            self._read_ahead()

    def _read_ahead(self) -> None:
        """Decode the oriented photographs for the next proposals, as long as nothing else is to be done."""
        following = self._following
        if following is None:
            return
        for i in np.flatnonzero(following.estimate.oriented).tolist():
            with self._changed:
                if self._closed or self._followed < self._changes:
                    return
            if self.pixels.is_full or self.pixels.is_decoded(i):
                continue
            with suppress(Exception):  # told when it is needed
                self.pixels.grey(i)

    # --- the state ---------------------------------------------------------------------------------

    def _state(self) -> dict[str, Any]:
        marking, project = self._marking, self.project
        marks = [self._shown_mark(mark) for mark in marking.marks.values() if mark.photograph in self._index]
        marks += [
            self._shown_automatic(key)
            for key in self._automatic
            if key[0] in self._index and key not in marking.marks and key not in marking.refused
        ]
        return {
            "version": self._version,
            "name": project.survey.name,
            "unit": project.survey.unit,
            "scaled": self._following is not None and self._following.orientation.frame != "model",
            "codes": project.survey.family is not None,
            "photographs": self._shown_photographs(marks),
            "points": self._shown_points(marks),
            "marks": marks,
            "proposals": [self._shown_proposal(key, proposal) for key, proposal in self._proposals.items()],
            "lines": self._shown_lines(marks),
            "bars": [self._shown_bar(bar) for bar in bars_of(project, marking)],
            "adjustment": self._shown_adjustment(),
            "next": self._next_sentence(),
            "undo": _shown_change(self._saved.last),
            "redo": _shown_change(self._saved.last_undone),
            "saved": str(self._saved.path),
            "run": None if self._run is None else vars(self._run),
        }

    def _next_sentence(self) -> str:
        if self._failed:
            return self._failed
        missing = sorted({name for name, _ in self._marking.marks} - self._index.keys())
        if missing:
            return f"{missing[0]} has marks, but is not among the photographs; its marks are kept."
        if self._following is None:
            return "Click a point that several photographs show; the click is measured."
        return sentence_of(self._following, self._proposals)

    def _shown_photographs(self, marks: list[dict[str, Any]]) -> list[dict[str, Any]]:
        project, following = self.project, self._following
        number = np.bincount([mark["image"] for mark in marks], minlength=len(project.sizes))
        oriented = np.zeros(len(project.sizes), dtype=bool)
        needs = np.maximum(3 - number, 1)
        if following is not None:
            oriented, needs = following.estimate.oriented, marks_needed(following)[0]
        hashes, now = self._marking.hashes, self._hashes
        changed = {
            name: "changed since it was marked: measure its marks again"
            for name, hashed in hashes.items()
            if hashed and now.get(name, hashed) != hashed
        }
        return [
            {
                "index": i,
                "name": name,
                "width": project.sizes[i][0],
                "height": project.sizes[i][1],
                "oriented": bool(oriented[i]),
                "marks": int(number[i]),
                "needs": int(needs[i]),
                "changed": changed.get(name),
            }
            for i, name in enumerate(project.photographs.names)
        ]

    def _shown_points(self, marks: list[dict[str, Any]]) -> list[dict[str, Any]]:
        following, control = self._following, stated_points(self.project, self._marking)
        rays: dict[str, int] = {}
        by_hand = dict.fromkeys((*control, *self._marking.points), True)
        for mark in marks:
            rays[mark["point"]] = rays.get(mark["point"], 0) + 1
        names = tuple(dict.fromkeys((*by_hand, *rays)))
        number = {} if following is None else following.marked.point
        shown = []
        for name in names:
            X = sigma = None
            if following is not None and name in number:
                j, adjustment = number[name], following.adjustment
                if np.isfinite(following.estimate.points[j]).all():
                    X = following.estimate.points[j].tolist()
                if adjustment is not None and adjustment.points[j]:
                    k = int(np.count_nonzero(adjustment.points[:j]))
                    variance = np.diagonal(adjustment.adjustment.covariance.points[k])
                    if np.isfinite(variance).all():
                        sigma = np.sqrt(np.maximum(variance, 0.0)).tolist()
            stated = control.get(name)
            shown.append(
                {
                    "name": name,
                    "X": X,
                    "sigma": sigma,
                    "rays": rays.get(name, 0),
                    "control": (
                        None
                        if stated is None
                        else {
                            "X": list(stated.xyz),
                            "sigma": list(stated.sigma),
                            "given": name not in self._marking.control,
                        }
                    ),
                    "automatic": name not in by_hand,
                }
            )
        return shown

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
            **self._fit_of(mark.key, mark.x, mark.y),
            "automatic": False,
        }

    def _shown_automatic(self, key: tuple[str, str]) -> dict[str, Any]:
        row = self._automatic[key]
        (x, y), C = row.xy, row.covariance
        return {
            "image": self._index[key[0]],
            "point": key[1],
            "x": x,
            "y": y,
            "sigma": np.sqrt(np.diagonal(C)).tolist(),
            "kind": "target",
            "by": "measured",
            "when": "",
            **self._fit_of(key, x, y),
            "automatic": True,
        }

    def _fit_of(self, key: tuple[str, str], x: float, y: float) -> dict[str, Any]:
        """Return residual and test of a mark, None as long as it is not adjusted where it is."""
        fits = {} if self._following is None else self._following.residuals
        if key not in fits or fits[key].place != (x, y):
            return {"residual": None, "test": None}
        fit = fits[key]
        return {"residual": [or_none(v) for v in fit.residual], "test": or_none(fit.test)}

    def _shown_proposal(self, key: tuple[str, str], proposal: Proposal) -> dict[str, Any]:
        ellipse, measured = proposal.predicted.ellipse, proposal.measured
        x, y = proposal.xy.tolist()
        sigma = None if measured is None else np.sqrt(np.diagonal(measured.covariance)).tolist()
        return {
            "image": self._index[key[0]],
            "point": key[1],
            "x": x,
            "y": y,
            "ellipse": {"a": ellipse.a, "b": ellipse.b, "angle_deg": ellipse.angle_deg},
            "measured": measured is not None,
            "kind": None if measured is None else measured.kind,
            "sigma": sigma,
        }

    def _shown_lines(self, marks: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return the epipolar lines of the points with one mark and without coordinates."""
        guide = self._guide()
        if guide is None or self._following is None:
            return []
        of_point: dict[str, list[dict[str, Any]]] = {}
        for mark in marks:
            of_point.setdefault(mark["point"], []).append(mark)
        control, lines = stated_points(self.project, self._marking), []
        for name, own in of_point.items():
            if len(own) == 1 and name not in control and not own[0]["automatic"]:
                at = np.array([own[0]["x"], own[0]["y"]])
                for j, path in guide.lines(own[0]["image"], at):
                    lines.append({"image": j, "point": name, "xy": np.round(path, 2).tolist()})
        return lines

    def _shown_bar(self, bar: ScaleBar) -> dict[str, Any]:
        residual, following = None, self._following
        if following is not None and {bar.start, bar.end} <= following.marked.point.keys():
            a, b = (following.estimate.points[following.marked.point[name]] for name in (bar.start, bar.end))
            residual = or_none(float(np.linalg.norm(b - a)) - bar.length)
        given = (bar.start, bar.end) not in self._marking.bars
        shown: dict[str, Any] = {"start": bar.start, "end": bar.end, "given": given}
        return {**shown, "length": bar.length, "sigma": bar.sigma, "residual": residual}

    def _shown_adjustment(self) -> dict[str, Any]:
        following = self._following
        marks = None if following is None else following.adjustment
        running = self._followed < self._changes
        state = "running" if running else "none" if marks is None else "done"
        shown: dict[str, Any] = {
            "state": state,
            "sigma0_px": None,
            "redundancy": 0,
            "worst": None,
            "sentence": "",
        }
        if marks is None:
            return shown
        a, worst = marks.adjustment, marks.worst
        shown["sigma0_px"] = or_none(a.sigma0_px) if a.redundancy > 0 else None
        shown["redundancy"] = a.redundancy
        if worst is not None:
            shown["worst"] = {
                "image": self._index[worst.photograph],
                "point": worst.point,
                "test": worst.test,
                "flagged": worst.flagged,
            }
            fits = "does not fit" if worst.flagged else "fits least"
            shown["sentence"] = (
                f"{worst.point} in {worst.photograph} {fits} (|w| = {worst.test:.1f}); sigma0 "
                f"{a.sigma0_px:.2f} px, redundancy {a.redundancy}."
            )
        return shown


def _told(marks: list[Mark]) -> str:
    """Return which places were accepted or refused, for the history."""
    if len(marks) == 1:
        return f"{marks[0].point} in {marks[0].photograph}"
    points = {mark.point for mark in marks}
    return f"{counted(len(marks), 'place')}{f' of {marks[0].point}' if len(points) == 1 else ''}"


def _shown_change(change: Change | None) -> dict[str, Any] | None:
    return None if change is None else vars(change)
