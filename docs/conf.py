"""Configuration of the documentation site, which `make docs` builds."""

from __future__ import annotations

import os
import sys
import tempfile
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

# the kernels of notebooks warn of unencrypted ports, which other computers cannot reach
profile = Path(tempfile.mkdtemp()) / "profile_default"
profile.mkdir()
(profile / "ipython_kernel_config.py").write_text("c.Application.log_level = 40\n", encoding="utf-8")
os.environ["IPYTHONDIR"] = str(profile.parent)

project = "Kolinear"
release = version = version_of("kolinear")
extensions = ["myst_nb", "generated", "functions", "drawings", "formulas", "links"]
html_title = f"Kolinear {release}"
html_theme = "pydata_sphinx_theme"
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
nb_execution_mode = "force"  # every notebook runs with the current program when the site is built
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_timeout = 600
nb_merge_streams = True
html_static_path = ["static"]
html_css_files = ["site.css"]
# single pages have no sidebar; pages of a section list its other pages there
ALONE = (
    "index",
    "install",
    "tutorial",
    "reading-the-report",
    "symptoms",
    "architecture",
    "search",
    "genindex",
)
html_sidebars = {page: [] for page in ALONE}
html_theme_options = {"header_links_before_dropdown": 9}
