"""Writes the table of formats of a page from their registry: read, written, round trip, what was read.

python docs/format_table.py docs/how-to/other-programs.md
"""

from __future__ import annotations

import sys
from pathlib import Path

from adapters.formats.registry import FORMATS

BEGIN, END = "<!-- formats -->\n", "<!-- end of formats -->"
# kinds of content in the words of the table
WORDS = {
    "cameras": "cameras",
    "exterior orientations": "poses",
    "object points": "points",
    "image points": "image points",
    "point names": "names of points",
    "image names": "names of photographs",
    "control": "control",
    "checks": "check points",
    "scale bars": "scale bars",
    "exterior": "observed poses",
    "rigs": "rigs",
    "image sigmas": "sigmas of image points",
    "point sigmas": "sigmas of points",
    "rejected": "rejected image points",
    "unit": "unit",
    "crs": "coordinate system",
}
OF_ITSELF = ("tables", "points-csv", "resection")  # formats of Kolinear
# formats that a file of their program was read of: in the tests, or once for its formulas
IN_TESTS = {
    "colmap": "its models, and its own adjuster",
    "colmap-text": "its models",
    "colmap-database": "its library",
    "photomodeler": "DBAT's camcal",
    "sba": "sba's problems",
    "opensfm": "its berlin",
    "nerfstudio": "instant-ngp's fox",
    "bundler": "its kermit, RMS to 1e-6 px",
    "nvm": "a castle of VisualSFM",
    "laz": "laspy",
    "e57": "pye57",
    "micmac": "MicMac's test data by hand, to 1e-11 px; its shape in the tests",
    "aicon": "JAiCov's example by hand, to 5e-6 mm; its shape in the tests",
}


def table() -> str:
    """Return the table in Markdown."""
    lines = ["| format | read | written | a round trip keeps | tried on |", "|---|---|---|---|---|"]
    for form in FORMATS:
        read = form.read is not None or form.read_all is not None
        kept = [words for kind, words in WORDS.items() if kind in form.keeps and read]
        if form.name == "agisoft-reference":
            kept.append("observed poses without correlations")
        tried = IN_TESTS.get(form.name, "" if form.name in OF_ITSELF else "its shape, made here")
        cells = (
            form.name,
            "yes" if read else "",
            "yes" if form.writable else "",
            ", ".join(kept) or "not read",
            tried,
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def with_table(page: str) -> str:
    """Return a page with its table written again."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}\n{table()}\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_table(path.read_text(encoding="utf-8")), encoding="utf-8")
