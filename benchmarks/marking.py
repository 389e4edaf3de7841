"""Times marking in the browser: from a click to its proposals, to new residuals, and to the first page.

    python -m benchmarks.marking [--demo build/demo] [--photographs 60] [--clicks 12]

The photographs are those of the demo, enlarged and repeated. Eight targets are marked in all of them, so that
all are oriented; then further targets are clicked in one photograph. Proposals are part of the answer to a
click; residuals come from the adjustment in the background. The first page is opened in Chromium with
photographs of 24 megapixels, until every pane shows its photograph; the memory is that of the scripts.

Use an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import cv2

from benchmarks.table import WORK
from sfm.products.marking.project import project_of_survey
from sfm.products.marking.session import MarkingSession
from sfm.survey.inputs.marks_file import Mark, Marking
from sfm.survey.inputs.survey import read_survey
from tests.browser import chromium
from tests.marking import Targets, demo_survey, open_page, served, targets_of

SIGMA_PX = 0.1  # of marks, in photographs that were enlarged
MARKED = 8
WIDTH, HEIGHT = 1600, 1200  # of a photograph of the demo, px


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--demo", type=Path, default=WORK / "demo")
    parser.add_argument("--photographs", type=int, default=60)
    parser.add_argument("--clicks", type=int, default=12)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        survey, targets = enlarged(options.demo, Path(folder) / "a", options.photographs, 1.875)
        time_clicks(survey, targets, options.clicks)
    with tempfile.TemporaryDirectory() as folder:
        survey, targets = enlarged(options.demo, Path(folder) / "b", options.photographs, 3.535)
        time_page(survey)


def enlarged(demo: Path, folder: Path, photographs: int, factor: float) -> tuple[Path, Targets]:
    """Write a survey of enlarged photographs of the demo, repeated; returns its file and its targets."""
    folder.mkdir()
    survey, truth, places = demo_survey(folder, demo), targets_of(demo), {}
    size = (round(WIDTH * factor), round(HEIGHT * factor))
    of_demo = sorted(folder.glob("part_*.jpg"))
    originals = [(path.name, cv2.imread(str(path))) for path in of_demo]
    for path in of_demo:
        path.unlink()
    for k in range(photographs):
        name, pixels = originals[k % len(originals)]
        cv2.imwrite(
            str(folder / f"part_{k:03d}.jpg"), cv2.resize(pixels, size, interpolation=cv2.INTER_CUBIC)
        )
        at = {
            target: ((x + 0.5) * size[0] / WIDTH - 0.5, (y + 0.5) * size[1] / HEIGHT - 0.5)
            for target, (x, y) in truth.places[name].items()
        }
        places[f"part_{k:03d}.jpg"] = at
    text = survey.read_text(encoding="utf-8")
    text = text.replace(f"[{WIDTH}, {HEIGHT}]", f"[{size[0]}, {size[1]}]")
    pixel = [0.005 * WIDTH / size[0], 0.005 * HEIGHT / size[1]]
    text = text.replace("[0.005, 0.005]", f"{pixel}").replace("sigma_px = 0.02", f"sigma_px = {SIGMA_PX}")
    survey.write_text(text, encoding="utf-8")
    return survey, Targets(places, truth.xyz)


def time_clicks(survey: Path, targets: Targets, clicks: int) -> None:
    """Print the times from clicks to proposals and to residuals."""
    shared = targets.seen_everywhere()
    apart = shared[:: len(shared) // MARKED][:MARKED]
    further = [name for name in shared if name not in apart][:clicks]
    marks = {
        (photograph, name): Mark(photograph, name, *places[name], SIGMA_PX**2, 0.0, SIGMA_PX**2, "target")
        for photograph, places in targets.places.items()
        for name in apart
    }
    session = MarkingSession(
        project_of_survey(read_survey(survey), survey_file=survey), survey.parent / "m.csv"
    )
    try:
        begun = time.perf_counter()
        session.add(Marking(marks=marks))
        state = _adjusted(session)
        oriented = sum(photograph["oriented"] for photograph in state["photographs"])
        seconds = time.perf_counter() - begun
        print(f"{oriented} of {len(targets.places)} photographs oriented after {seconds:.1f} s")
        answered, followed, proposed = [], [], []
        for name in further:
            session.click(0, *targets.places["part_000.jpg"][name], point=name)
            _adjusted(session)
            begun = time.perf_counter()
            answer = session.click(4, *targets.places["part_004.jpg"][name], point=name)
            answered.append(time.perf_counter() - begun)
            proposed.append(sum(one["point"] == name for one in answer["state"]["proposals"]))
            _adjusted(session)
            followed.append(time.perf_counter() - begun)
        print(f"click to {statistics.median(proposed):.0f} proposals: {_told(answered)}")
        print(f"click to new residuals: {_told(followed)}")
    finally:
        session.close()


def time_page(survey: Path) -> None:
    """Print the time to the first page, and the memory of its scripts."""
    with served(survey, survey.parent / "m.csv") as server, chromium() as browser:
        browser.new_page().close()
        begun = time.perf_counter()
        page = open_page(browser, server)
        print(
            f"first page of {len(page.state['photographs'])} photographs: {time.perf_counter() - begun:.2f} s"
        )
        used = page.page.evaluate("() => performance.memory.usedJSHeapSize")
        print(f"memory of its scripts: {used / 1e6:.0f} MB")
        page.close()


def _adjusted(session: MarkingSession) -> dict[str, object]:
    """Return the state after the adjustment that follows from the marks."""
    state = session.state()
    while state["adjustment"]["state"] == "running":
        state = session.state(state["version"])
    return state


def _told(seconds: list[float]) -> str:
    return f"{statistics.median(seconds):.2f} s, {max(seconds):.2f} s at most"


if __name__ == "__main__":
    main()
