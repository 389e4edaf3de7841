"""Pictures of how-to/mark.md: the page of `kolinear mark` with the photographs of the demo, in a browser.

python docs/mark_pictures.py            after `make demo`; writes docs/static/mark-pair.webp and mark-six.webp

A person's clicks are those of tests/marking.py.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from tests.browser import chromium  # noqa: E402
from tests.marking import (  # noqa: E402
    MORE,
    PAIR,
    Marking,
    Person,
    demo_survey,
    open_page,
    served,
    targets_of,
)

PHOTOGRAPHS = ROOT / "build" / "demo"
WIDTH_PX = 1100  # of a picture on the site


def main() -> None:
    """Write the pictures."""
    targets = targets_of(PHOTOGRAPHS)
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        survey = demo_survey(Path(folder), PHOTOGRAPHS)
        with served(survey, Path(folder) / "marks.csv") as server:
            marking = open_page(browser, server, width=1320, height=800)
            person = Person(marking, targets)
            person.mark_pair(PAIR)
            save(marking, "mark-pair")
            person.orient_others()
            person.mark_more(MORE[:2])
            marking.adjusted()
            marking.key("Shift+Enter")
            person.mark_more(MORE[2:4])
            save(marking, "mark-six")
            marking.close()


def save(marking: Marking, name: str) -> None:
    """Write what the page shows."""
    marking.page.wait_for_timeout(2000)  # for the adjustment and the tiles
    shot: Any = Image.open(io.BytesIO(marking.page.screenshot())).convert("RGB")
    small = shot.resize((WIDTH_PX, round(shot.height * WIDTH_PX / shot.width)), Image.Resampling.LANCZOS)
    small.save(ROOT / "docs" / "static" / f"{name}.webp", quality=70, method=6)


if __name__ == "__main__":
    main()
