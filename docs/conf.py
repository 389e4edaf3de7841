"""The documentation site: `make docs`."""

from __future__ import annotations

import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "Kolinear"
release = version = version_of("kolinear")
extensions = ["myst_parser", "generated", "functions", "drawings", "formulas"]
html_theme = "pydata_sphinx_theme"
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_static_path = ["static"]
html_css_files = ["site.css"]
html_sidebars = {"**": ["globaltoc.html"]}  # every page shows all pages by their groups
html_theme_options = {"header_links_before_dropdown": 4}
