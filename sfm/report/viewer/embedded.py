"""The viewer as a page holds it: script, styles, data, pictures, and the policy that allows them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from markupsafe import Markup

from sfm.report.viewer.container import packed_scene
from sfm.report.viewer.pictures import Pictures
from sfm.report.viewer.scene import ViewerScene


@dataclass(frozen=True)
class Viewer:
    """What the template `viewer.html` asks for."""

    script: Markup  # to the letter, since the policy allows it by its hash
    style: Markup
    data: str  # base64
    pictures: str  # base64
    notes: tuple[str, ...]  # what the page leaves out


def viewer_of(scene: ViewerScene, pictures: Pictures) -> Viewer:
    """Return the viewer of a scene."""
    script, style = sources()
    notes = (*scene.notes, *pictures.notes)
    return Viewer(Markup(script), Markup(style), packed_scene(scene, pictures), pictures.base64, notes)


@cache
def sources() -> tuple[str, str]:
    """Return script and style sheet of the viewer."""
    folder = files("sfm.report.viewer")
    script = folder.joinpath("viewer.js").read_text(encoding="utf-8")
    return script, folder.joinpath("viewer.css").read_text(encoding="utf-8")
