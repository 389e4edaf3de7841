"""The page for marking as a person uses it: with its server, by clicks and keys in a browser."""

from __future__ import annotations

import csv
import shutil
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfm.products.marking.project import MarkedProject, project_of_survey
from sfm.products.marking.server import MarkingServer
from sfm.products.marking.session import MarkingSession
from sfm.survey.inputs.survey import read_survey
from tests.browser import Tab
from tests.places import ROOT

NO_DEFECT = (
    "status of 422",  # the browser reports what the server refuses, as the page does
    "loaded before reset",  # OpenSeadragon, of tiles of a photograph that was left meanwhile
)

PLACE = """([pane, x, y]) => {
  const shown = document.getElementById('marking').page.panes[pane]
  const box = shown.view.getBoundingClientRect()
  const [left, top] = shown.frame().at([x, y])
  return [box.left + left, box.top + top]
}"""
STATE = "() => document.getElementById('marking').page.model.state"
PAGE = "document.getElementById('marking').page"


@contextmanager
def served(project: MarkedProject | Path, marks: Path) -> Iterator[MarkingServer]:
    """Serve the page of a project or of a survey file, in a thread."""
    if isinstance(project, Path):
        project = project_of_survey(read_survey(project), survey_file=project)
    session = MarkingSession(project, marks)
    server = MarkingServer(session)
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        session.close()
        server.stop()
        thread.join(20)


@dataclass
class Marking:
    """An open page, with what a person does there."""

    tab: Tab
    pressed: int = 0  # clicks and keys

    @property
    def page(self) -> Any:
        return self.tab.page

    @property
    def state(self) -> Any:
        return self.page.evaluate(STATE)

    def ready(self) -> Marking:
        self.page.wait_for_selector(".m-view[data-ready]")
        self.tab.until("() => !document.querySelector('.m-view:not([data-ready])')")
        self.adjusted()
        return self

    def click(self, pane: int, place: Sequence[float], **options: Any) -> None:
        self.pressed += 1
        self.page.mouse.click(*self.page.evaluate(PLACE, [pane, *map(float, place)]), **options)
        self.settled()

    def key(self, key: str) -> None:
        self.pressed += 1
        self.page.keyboard.press(key)
        self.settled()

    def settled(self) -> None:
        """Wait until the program has answered what was asked."""
        self.tab.until(f"() => {PAGE}.server.idle")

    def adjusted(self) -> Any:
        """Wait until everything that follows from the marks is there; returns the state."""
        self.settled()
        self.tab.until(f"() => {PAGE}.model.state.adjustment.state !== 'running'")
        return self.state

    @property
    def images(self) -> list[int]:
        """The photographs in the panes."""
        return list(self.page.evaluate(f"() => {PAGE}.panes.map((pane) => pane.image)"))

    @property
    def chosen(self) -> str:
        """The chosen point; "None" where the next click makes a new one."""
        return str(self.page.evaluate(f"() => {PAGE}.model.chosen"))

    def next_point(self, pane: int) -> Any:
        """Return the point that a click in a pane measures, as told beside the pointer; None: a new one."""
        return self.page.evaluate(f"(pane) => {PAGE}.model.pointFor({PAGE}.panes[pane].image)", pane)

    def proposals_of(self, point: str) -> list[Any]:
        return [proposal for proposal in self.state["proposals"] if proposal["point"] == point]

    def said(self) -> str:
        return str(self.page.locator("#m-said").inner_text())

    def close(self) -> None:
        complaints = [text for text in self.tab.complaints if not any(known in text for known in NO_DEFECT)]
        assert not complaints, complaints
        self.tab.close()


def open_page(browser: Any, server: MarkingServer, **options: Any) -> Marking:
    return Marking(Tab(browser, server.address.url, **options)).ready()


PAIR = ("t017", "t026", "t076", "t067", "t049", "t018")  # in the middle of the part of the demo
MORE = ("t005", "t074", "t058", "t020", "t071", "t023")


def demo_survey(folder: Path, photographs: Path) -> Path:
    """Write the survey file of the demo without codes, bars and a second adjustment; returns its path."""
    camera = (ROOT / "datasets" / "demo" / "survey.toml").read_text(encoding="utf-8")
    camera = camera[camera.index("[[camera]]") : camera.index("[targets]")]
    head = '[survey]\nname = "by hand"\nunit = "mm"\n'
    end = '[targets]\npolarity = "auto"\ncodes = "none"\nmin_diameter_px = 5\n[adjust]\nsigma_px = 0.02\n'
    for path in photographs.glob("part_*.jpg"):
        shutil.copy(path, folder)
    survey = folder / "survey.toml"
    survey.write_text(f"{head}{camera}{end}", encoding="utf-8")
    return survey


@dataclass(frozen=True)
class Targets:
    """The targets of a rendered scene."""

    places: Mapping[str, Mapping[str, tuple[float, float]]]  # of each photograph: target to place, px
    xyz: Mapping[str, tuple[float, float, float]]  # object unit

    def seen_everywhere(self) -> list[str]:
        """Return the uncoded targets that every photograph shows."""
        shown = [set(places) for places in self.places.values()]
        return sorted(name for name in set.intersection(*shown) if name.startswith("t"))


def targets_of(folder: Path) -> Targets:
    """Read the truth beside rendered photographs."""
    places: dict[str, dict[str, tuple[float, float]]] = {}
    with (folder / "truth_image_points.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            places.setdefault(row["image"], {})[row["target"]] = (float(row["x_px"]), float(row["y_px"]))
    with (folder / "truth_points.csv").open(encoding="utf-8") as file:
        xyz = {
            row["target"]: (float(row["X"]), float(row["Y"]), float(row["Z"])) for row in csv.DictReader(file)
        }
    return Targets(places, xyz)


class Person:
    """Someone who sees the targets and marks them from nothing."""

    def __init__(self, marking: Marking, targets: Targets) -> None:
        self.marking = marking
        self.targets = targets
        self.names = [photograph["name"] for photograph in marking.state["photographs"]]
        self.target_of: dict[str, str] = {}  # of each point

    def click(self, pane: int, target: str) -> None:
        photograph = self.names[self.marking.images[pane]]
        self.marking.click(pane, self.targets.places[photograph][target])
        said = self.marking.said()
        assert f" in {photograph}: target" in said, f"clicked {target} in {photograph}: {said}"
        self.target_of.setdefault(self.marking.chosen, target)

    def mark_pair(self, targets: Sequence[str]) -> None:
        """Mark targets in the two photographs that the page shows."""
        for target in targets:
            for pane in (0, 1):
                self.click(pane, target)
        self.marking.adjusted()

    def orient_others(self) -> None:
        """Orient all photographs, six side by side."""
        for _ in range(2):  # 4, then 6 side by side
            self.marking.key("l")
        for k in range(0, len(self.names), 6):
            if k:
                self.marking.key("PageDown")
            self.marking.ready()
            for _ in range(3):  # a photograph may need more marks than it says at first
                for pane in range(6):
                    self.orient(pane)
                self.marking.adjusted()

    def orient(self, pane: int) -> None:
        """Click in a photograph as often as it needs, always on the point that the page names."""
        photograph = self.marking.state["photographs"][self.marking.images[pane]]
        for _ in range(0 if photograph["oriented"] else photograph["needs"]):
            self.click(pane, self.target_of[self.marking.next_point(pane)])

    def mark_more(self, targets: Sequence[str]) -> None:
        """Mark further targets, in as many photographs as it takes until the others are proposed."""
        for target in targets:
            for pane in range(6):
                self.click(pane, target)
                if self.marking.proposals_of(self.marking.chosen):
                    break
