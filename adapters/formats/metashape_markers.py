"""The markers of a Metashape export and their image points, taken one by one while the file is read."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np

from adapters.reading.text_lines import MAX_IMAGE_POINTS, MAX_PHOTOGRAPHS, MAX_POINTS
from adapters.reading.xml_lines import Node, Taken
from sfm.conventions import FloatArray
from sfm.errors import SurveyFileError
from sfm.network import ImagePoints, ObjectPoints

HALF_PIXEL = 0.5  # Metashape's pixel coordinates minus ours, px
MARKER_SIGMA_PX = 0.1  # Metashape's own default for markers placed by hand
MARKER = ["markers", "marker"]  # elements below the chunk
LOCATION = ["frames", "frame", "markers", "marker", "location"]


class Markers:
    """Markers of the first chunk of a file, with image points of its first frame."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.labels: list[str] = []
        self._index: dict[str, int] = {}  # of each marker by its id
        self._xyz = array("d")
        self._control, self._sigma = array("q"), array("d")
        self._seen = array("q")  # camera, marker and line of each image point, by the numbers below
        self._xy = array("d")
        self._cameras: dict[str, int] = {}  # numbers of the ids that image points name
        self._markers: dict[str, int] = {}
        self._chunk: Node | None = None
        self._frames: Node | None = None
        self._frame: Node | None = None  # the first of them

    def taken(self) -> Taken:
        """Return what is taken of a file."""
        return {("markers", "marker"): self._take_marker, ("marker", "location"): self._take_location}

    def control(self) -> ObjectPoints:
        """Return the markers whose reference is enabled."""
        chosen = np.array(self._control, dtype=np.int64)
        covariance = np.eye(3) * np.array(self._sigma).reshape(-1, 1, 3) ** 2
        return ObjectPoints(chosen, self.coordinates()[chosen], covariance)

    def coordinates(self) -> FloatArray:
        """Return the coordinates of the references, NaN without one, (n, 3)."""
        return np.array(self._xyz).reshape(-1, 3)

    def image_points(self, images: dict[str, int]) -> ImagePoints:
        """Return the image points.

        Args:
            images: index of each photograph by its id.

        Raises:
            SurveyFileError: one of an unknown camera or marker, or two of a marker in a camera.
        """
        seen = np.array(self._seen, dtype=np.int64).reshape(-1, 3)
        found = []
        for column, what, numbers, known in (
            (1, "marker", self._markers, self._index),
            (0, "camera", self._cameras, images),
        ):
            table = np.array([known.get(name, -1) for name in numbers], dtype=np.int64)
            found.append(table[seen[:, column]])
            for k in np.flatnonzero(found[-1] < 0)[:1]:
                name = list(numbers)[seen[k, column]]
                raise SurveyFileError(
                    f"{self.path}, line {seen[k, 2]}: {what}_id {name}, there is no such {what}"
                )
        point, image = found
        if len(np.unique(image * len(self.labels) + point)) < len(point):
            raise SurveyFileError(f"{self.path}: a marker is a duplicate in one camera")
        covariance = np.tile(MARKER_SIGMA_PX**2 * np.eye(2), (len(seen), 1, 1))
        xy, stated = np.array(self._xy).reshape(-1, 2) - HALF_PIXEL, np.zeros(len(seen), dtype=bool)
        return ImagePoints(image, point, xy, covariance, stated)

    def _take_marker(self, nodes: list[Node]) -> None:
        if self._below_chunk(nodes) != MARKER:
            return
        node, j = nodes[-1], len(self.labels)
        identifier = node.name("id")
        if identifier in self._index:
            raise node.error(f"marker id {identifier} is a duplicate")
        if j == MAX_POINTS:
            raise node.error(f"more than {MAX_POINTS} markers, no more are read")
        self._index[identifier] = j
        self.labels.append(node.name("label"))
        reference = node.maybe("reference")
        if reference is None or "x" not in reference.attributes:
            self._xyz.extend((np.nan, np.nan, np.nan))
            return
        self._xyz.extend(reference.number(axis) for axis in "xyz")
        if reference.attributes.get("enabled") in ("true", "1"):
            self._control.append(j)
            named = [f"s{axis}" for axis in "xyz"]
            self._sigma.extend(reference.number(n) if n in reference.attributes else 0.0 for n in named)

    def _take_location(self, nodes: list[Node]) -> None:
        if self._below_chunk(nodes) != LOCATION:
            return
        frames, frame, _, marker, node = nodes[-5:]
        if frames is not self._frames:
            self._frames, self._frame = frames, frames.maybe("frame")
        if frame is not self._frame:
            return
        self._seen.append(_number_of(node, "camera_id", self._cameras, MAX_PHOTOGRAPHS))
        self._seen.append(_number_of(marker, "marker_id", self._markers, MAX_POINTS))
        self._seen.append(node.line)
        self._xy.append(node.number("x"))
        self._xy.append(node.number("y"))
        if len(self._xy) > 2 * MAX_IMAGE_POINTS:
            raise node.error(f"more than {MAX_IMAGE_POINTS} image points, no more are read")

    def _below_chunk(self, nodes: list[Node]) -> list[str]:
        """Return the tags below the first chunk, none outside of it."""
        at = 0 if nodes[0].tag == "chunk" else 1
        if self._chunk is None:
            self._chunk = nodes[0] if at == 0 else nodes[0].maybe("chunk")
        return [node.tag for node in nodes[at + 1 :]] if nodes[at] is self._chunk else []


def _number_of(node: Node, attribute: str, numbers: dict[str, int], most: int) -> int:
    """Return the number of an id, a new one if it is new."""
    identifier = node.name(attribute)
    number = numbers.setdefault(identifier, len(numbers))
    if number == most:
        raise node.error(f"more than {most} different {attribute}, no more are read")
    return number
