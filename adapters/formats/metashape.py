"""Agisoft Metashape camera and marker XML (File > Export > Export Cameras / Markers), read and written.

    document/chunk/sensors/sensor            resolution, pixel size, calibration
    document/chunk/cameras/camera            sensor_id, label, transform (16 numbers, by rows)
    document/chunk/markers/marker            label, reference x y z [sx sy sz] enabled
    document/chunk/frames/frame/markers      location camera_id x y per marker
    document/chunk/transform                 rotation, translation, scale: object from chunk

A camera's transform takes camera axes (x right, y down, z forward) into the chunk, so
R = (its rotation) diag(1, -1, -1). Image points count from the corner of the top-left pixel, 0.5 px more
than Kolinear's. With x = X/Z, y = Y/Z in camera axes and r2 = x2 + y2

    x' = x (1 + k1 r2 + k2 r4 + k3 r6 + k4 r8) + p1 (r2 + 2 x2) + 2 p2 x y,   y' with p1, p2 exchanged
    u = w/2 + cx + x' f + x' b1 + y' b2,   v = h/2 + cy + y' f

This is exactly `opencv` (k3 = k4 = b2 = 0) or `full_opencv` (k4 = b2 = 0) with p1 and p2 exchanged; with k4
or b2 it is exactly `brown_forward_affine`.

Source: Agisoft Metashape Professional user manual 2.x, app. D "Camera models"; structure of the file as
exported by versions 1.5 to 2.1.
"""

from __future__ import annotations

from array import array
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from adapters.formats.cameras.metashape import (
    calibration_lines,
    calibration_values,
    camera_of_values,
    values_of,
)
from adapters.reading.text_lines import MAX_IMAGE_POINTS, MAX_PHOTOGRAPHS, MAX_POINTS, write_lines
from adapters.reading.xml_lines import Node, Taken, read_xml
from sfm.files.plain_text import MAX_PIXEL_MM, shorten
from sfm.model.camera import Camera
from sfm.model.conventions import VISION_AXES, FloatArray
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints, rows_of
from sfm.model.similarity import Similarity

HALF_PIXEL = 0.5  # Metashape's pixel coordinates minus Kolinear's, px
MARKER_SIGMA_PX = 0.1  # Metashape's default for markers placed by hand
MARKER = ["markers", "marker"]  # path of elements below the chunk
LOCATION = ["frames", "frame", "markers", "marker", "location"]


def read_metashape(path: Path) -> tuple[Network, Estimate]:
    """Read an export as a network and its solution: the cameras of one chunk, with markers as object points.

    A marker with an enabled reference is a control point; the reference of any marker is its start value.
    Cameras without a transform have no orientation.

    Raises:
        SurveyFileError: with file and line number.
    """
    markers = Markers(path)
    root = read_xml(path, markers.taken())
    chunk = root if root.tag == "chunk" else root.one("chunk")
    sensors = chunk.one("sensors").all("sensor")
    cameras = tuple(_camera(sensor) for sensor in sensors)
    sensor_index = {sensor.name("id"): k for k, sensor in enumerate(sensors)}
    object_from_chunk = _chunk_transform(chunk)
    nodes = [
        node
        for group in (chunk.one("cameras"), *chunk.one("cameras").all("group"))
        for node in group.all("camera")
    ]
    if nodes and not sensors:
        raise chunk.error("no sensors")
    images = {node.name("id"): i for i, node in enumerate(nodes)}
    m = len(nodes)
    position, rotation = np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan)
    camera_index = np.empty(m, dtype=np.int64)
    for i, node in enumerate(nodes):
        sensor = node.name("sensor_id")
        if sensor not in sensor_index:
            raise node.error(f"sensor_id {sensor}, there is no such sensor")
        camera_index[i] = sensor_index[sensor]
        transform = node.maybe("transform")
        if transform is not None:
            T = transform.numbers(16).reshape(4, 4)
            position[i] = object_from_chunk.apply(T[:3, 3])
            rotation[i] = object_from_chunk.rotation @ T[:3, :3] @ VISION_AXES
    control = markers.control()
    network = Network(
        tuple(node.name("label") for node in nodes),
        camera_index,
        tuple(markers.labels),
        markers.image_points(images),
        observations=(control,),
    )
    return network, Estimate(cameras, position, rotation, markers.coordinates())


def write_metashape(path: Path, network: Network, estimate: Estimate) -> None:
    """Write a network and its solution as an export of one chunk, with points as markers.

    Raises:
        OutputError: Metashape has no equivalent of a camera model, or the file cannot be written.
    """
    sensors = [line for k, camera in enumerate(estimate.cameras) for line in _sensor_lines(k, camera)]
    cameras = []
    for i, name in enumerate(network.images):
        head = f'      <camera id="{i}" sensor_id="{network.camera[i]}" label={quoteattr(name)}'
        if not estimate.oriented[i]:
            cameras.append(head + "/>")
            continue
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = estimate.rotation[i] @ VISION_AXES, estimate.position[i]
        cameras += [
            head + ">",
            f"        <transform>{' '.join(repr(float(v)) for v in T.ravel())}</transform>",
            "      </camera>",
        ]
    control = network.control.complete
    known = {
        int(j): (xyz, np.sqrt(np.diagonal(C)))
        for j, xyz, C in zip(control.point, control.xyz, control.covariance, strict=True)
    }
    markers, locations = [], []
    rows = rows_of(network.image_points.point, len(network.points))
    for j, name in enumerate(network.points):
        reference = _reference(*known.get(j, (estimate.points[j], None)))
        markers.append(f'      <marker id="{j}" label={quoteattr(name)}>{reference}</marker>')
        locations.append(f'          <marker marker_id="{j}">')
        for row in rows[j]:
            x, y = (repr(float(v)) for v in network.image_points.xy[row] + HALF_PIXEL)
            camera = network.image_points.image[row]
            locations.append(f'            <location camera_id="{camera}" pinned="true" x="{x}" y="{y}"/>')
        locations.append("          </marker>")
    write_lines(
        path,
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            '<document version="2.0.0">',
            '  <chunk label="Kolinear" enabled="true">',
            f'    <sensors next_id="{len(estimate.cameras)}">',
            *sensors,
            "    </sensors>",
            f'    <cameras next_id="{len(network.images)}" next_group_id="0">',
            *cameras,
            "    </cameras>",
            f'    <markers next_id="{len(network.points)}" next_group_id="0">',
            *markers,
            "    </markers>",
            '    <frames next_id="1">',
            '      <frame id="0">',
            "        <markers>",
            *locations,
            "        </markers>",
            "      </frame>",
            "    </frames>",
            "  </chunk>",
            "</document>",
        ],
    )


def _camera(sensor: Node) -> Camera:
    """Return the camera of a sensor in the equivalent model."""
    if sensor.attributes.get("type", "frame") != "frame":
        raise sensor.error(
            f"sensor of type {shorten(sensor.attributes['type'])}, only frame sensors can be read"
        )
    resolution = sensor.one("resolution")
    size = (resolution.side_px("width"), resolution.side_px("height"))
    given = {node.attribute("name"): node for node in sensor.all("property")}
    pixel = tuple(
        given[name].number("value") if name in given else 1.0 for name in ("pixel_width", "pixel_height")
    )
    if not all(0 < side <= MAX_PIXEL_MM for side in pixel):
        raise sensor.error(f"pixels of {pixel[0]:g} x {pixel[1]:g} mm, needed 0 to {MAX_PIXEL_MM:g}")
    calibrations = sensor.all("calibration")
    if not calibrations:
        raise sensor.error("sensor without calibration")
    adjusted = [node for node in calibrations if node.attributes.get("class") == "adjusted"]
    p, stated = calibration_values((adjusted or calibrations)[0])
    name = sensor.name("label" if "label" in sensor.attributes else "id")
    return camera_of_values(name, size, (float(pixel[0]), float(pixel[1])), p, stated)


def _sensor_lines(number: int, camera: Camera) -> list[str]:
    """Return the lines of a sensor; refuse a camera without an equivalent in Metashape."""
    width, height = camera.size_px
    resolution = f'<resolution width="{width}" height="{height}"/>'
    calibration = [f"          {line}" for line in calibration_lines(values_of(camera))]
    return [
        f'      <sensor id="{number}" label={quoteattr(camera.name)} type="frame">',
        f"        {resolution}",
        f'        <property name="pixel_width" value="{float(camera.pixel_mm[0])!r}"/>',
        f'        <property name="pixel_height" value="{float(camera.pixel_mm[1])!r}"/>',
        '        <calibration type="frame" class="adjusted">',
        f"          {resolution}",
        *calibration,
        "        </calibration>",
        "      </sensor>",
    ]


def _chunk_transform(chunk: Node) -> Similarity:
    """Return object from chunk, of the chunk or its only component; the identity if there is none."""
    node = chunk.maybe("transform")
    if node is None:
        components = chunk.maybe("components")
        inner = [] if components is None else components.all("component")
        node = inner[0].maybe("transform") if len(inner) == 1 else None
    if node is None or not node.children:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    return Similarity(
        float(node.one("scale").numbers(1)[0]),
        node.one("rotation").numbers(9).reshape(3, 3),
        node.one("translation").numbers(3),
    )


def _reference(xyz: FloatArray, sigma: FloatArray | None) -> str:
    if not np.isfinite(xyz).all():
        return ""
    named = " ".join(f'{axis}="{float(v)!r}"' for axis, v in zip("xyz", xyz, strict=True))
    if sigma is None:
        return f'<reference {named} enabled="false"/>'
    named += " " + " ".join(f's{axis}="{float(s)!r}"' for axis, s in zip("xyz", sigma, strict=True))
    return f'<reference {named} enabled="true"/>'


class Markers:
    """Markers of the first chunk with image points of its first frame, collected while the file is read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.labels: list[str] = []
        self._index: dict[str, int] = {}  # index of each marker by its id
        self._xyz = array("d")
        self._control, self._sigma = array("q"), array("d")
        self._seen = array("q")  # camera, marker and line of each image point, by the numbers below
        self._xy = array("d")
        self._cameras: dict[str, int] = {}  # numbers of the ids in image points
        self._markers: dict[str, int] = {}
        self._chunk: Node | None = None
        self._frames: Node | None = None
        self._frame: Node | None = None  # the first frame

    def taken(self) -> Taken:
        """Return the functions that receive the elements of a file."""
        return {("markers", "marker"): self._add_marker, ("marker", "location"): self._add_location}

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
            SurveyFileError: an image point of an unknown camera or marker, or two of a marker in one camera.
        """
        seen = np.array(self._seen, dtype=np.int64).reshape(-1, 3)
        indices = []
        for column, what, numbers, known in (
            (1, "marker", self._markers, self._index),
            (0, "camera", self._cameras, images),
        ):
            table = np.array([known.get(name, -1) for name in numbers], dtype=np.int64)
            indices.append(table[seen[:, column]])
            for k in np.flatnonzero(indices[-1] < 0)[:1]:
                name = list(numbers)[seen[k, column]]
                raise SurveyFileError(
                    f"{self.path}, line {seen[k, 2]}: {what}_id {name}, there is no such {what}"
                )
        point, image = indices
        if len(np.unique(image * len(self.labels) + point)) < len(point):
            raise SurveyFileError(f"{self.path}: a marker is a duplicate in one camera")
        covariance = np.tile(MARKER_SIGMA_PX**2 * np.eye(2), (len(seen), 1, 1))
        xy, stated = np.array(self._xy).reshape(-1, 2) - HALF_PIXEL, np.zeros(len(seen), dtype=bool)
        return ImagePoints(image, point, xy, covariance, stated)

    def _add_marker(self, nodes: list[Node]) -> None:
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

    def _add_location(self, nodes: list[Node]) -> None:
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
        """Return the tags below the first chunk; empty outside of it."""
        at = 0 if nodes[0].tag == "chunk" else 1
        if self._chunk is None:
            self._chunk = nodes[0] if at == 0 else nodes[0].maybe("chunk")
        return [node.tag for node in nodes[at + 1 :]] if nodes[at] is self._chunk else []


def _number_of(node: Node, attribute: str, numbers: dict[str, int], most: int) -> int:
    """Return the number of an id, assigning a new number to a new id."""
    identifier = node.name(attribute)
    number = numbers.setdefault(identifier, len(numbers))
    if number == most:
        raise node.error(f"more than {most} different {attribute}, no more are read")
    return number
