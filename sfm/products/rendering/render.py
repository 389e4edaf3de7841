"""Render: photographs of scenes with circular targets by area sampling, together with their truth.

    python -m sfm.products.rendering.render datasets/demo/scene.toml build/demo

The ray of every point of the photograph is intersected with the plane of the face. A circle is therefore seen
in true perspective and distortion, and is not just an ellipse drawn around its centre. A cell of the
photograph that is crossed by an edge receives the area inside. The blur is applied on a raster finer than the
pixels. Each pixel is then the mean over its area.

The painting order decides which face of a scene hides which, as seen from a camera. The truth of a rendered
photograph is the position of each target in it, and whether the target is whole.
"""

from __future__ import annotations

import argparse
import math
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from sfm.files.open_folders import refuse_foreign_files
from sfm.files.plain_text import csv_text
from sfm.files.whole_files import whole_files
from sfm.model.camera import Camera, project, tangents_from_pixel
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray, angles_from_rotation
from sfm.model.display import counted
from sfm.model.errors import GeometryError, OutputError
from sfm.products.rendering.area import Lamp, cover_with, fill_face, paint_mark
from sfm.products.rendering.scene import ARC, DISC, UNCODED, Optics, Scene
from sfm.products.rendering.scene_file import Staging, read_scene
from sfm.runtime.faults import ending_of
from sfm.runtime.installation import refuse_folder_settings

# Number of points of the rim that are tested to find out whether a target is hidden.
RIM = 16
# Corners of the polygon whose centre of area is the centre of the image of a circle.
OUTLINE = 256

# Faces that intersect each other by less than this fraction of the largest one only touch.
TOUCHING_FRACTION = 1e-6

TRUTH = ("truth_points.csv", "truth_images.csv", "truth_image_points.csv")


def render_photograph(
    scene: Scene,
    camera: Camera,
    position: FloatArray,
    rotation: FloatArray,
    *,
    optics: Optics,
    rng: np.random.Generator,
    rays: FloatArray | None = None,
) -> tuple[AnyArray, ProjectedTargets]:
    """Photograph a scene.

    Args:
        scene: the scene.
        camera: interior orientation, any distortion model.
        position: projection centre, object unit, (3,).
        rotation: R, image to object axes, (3, 3).
        optics: blur, vignetting, exposure, noise and depth of the photograph.
        rng: source of the noise.
        rays: result of `corner_rays(camera)`, to share it between photographs.

    Returns:
        Intensities, uint8 or uint16, shape (height, width), and the positions of the targets.

    Raises:
        GeometryError: neither 8 nor 16 bit.
    """
    if optics.bits not in (8, 16):
        raise GeometryError(f"render: {optics.bits} bits asked for, photographs have 8 or 16")
    rays = corner_rays(camera) if rays is None else rays
    width, height = camera.size_px
    n = optics.oversampling
    fine = np.full((height * n, width * n), scene.background, dtype=np.float32)
    scratch = np.empty((2, fine.size), dtype=np.float32)  # allocated once for all faces: new memory is slow
    view = _View(camera, position, rotation, rays)
    for face in painting_order(scene, position):
        _paint_face(fine, scene, int(face), view, n, scratch)
    blur = optics.blur_px * n
    if blur > 0:
        reach = 2 * math.ceil(5 * blur) + 1
        cv2.GaussianBlur(fine, (reach, reach), blur, dst=fine, borderType=cv2.BORDER_REPLICATE)
    light = np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA))  # means of cells
    y, x = np.ogrid[:height, :width]
    corner = (width / 2) ** 2 + (height / 2) ** 2
    r2 = ((x - (width - 1) / 2) ** 2 + (y - (height - 1) / 2) ** 2) / corner
    signal = light * (optics.exposure * (1 - optics.vignetting * r2)).astype(np.float32)
    sigma = np.sqrt(optics.noise**2 + optics.shot_noise**2 * np.clip(signal, 0, None))
    signal += sigma * rng.standard_normal(signal.shape, dtype=np.float32)
    full = 2**optics.bits - 1
    intensities = np.clip(np.rint(signal * full), 0, full)
    photograph = np.asarray(intensities.astype(np.uint8 if optics.bits == 8 else np.uint16))
    return photograph, project_targets(scene, camera, position, rotation)


def render_photographs(
    scene: Scene,
    camera: Camera,
    positions: FloatArray,
    rotations: FloatArray,
    *,
    optics: Optics,
    seed: int,
    threads: int = 2,
) -> tuple[list[AnyArray], list[ProjectedTargets]]:
    """Photograph a scene from several stations in parallel; the seed gives each photograph different noise.

    Args:
        scene: the scene.
        camera: interior orientation, any distortion model.
        positions: projection centres, (m, 3), object unit.
        rotations: R of each photograph, (m, 3, 3).
        optics: blur, vignetting, exposure, noise and depth of the photographs.
        seed: seed of the noise.
        threads: number of photographs rendered at the same time.

    Returns:
        The photographs and the positions of the targets in each.
    """
    rays = corner_rays(camera)
    sources = np.random.default_rng(seed).spawn(len(positions))

    def render_station(i: int) -> tuple[AnyArray, ProjectedTargets]:
        return render_photograph(
            scene, camera, positions[i], rotations[i], optics=optics, rng=sources[i], rays=rays
        )

    with ThreadPoolExecutor(max_workers=threads) as pool:
        rendered = list(pool.map(render_station, range(len(positions))))
    return [photograph for photograph, _ in rendered], [truth for _, truth in rendered]


def corner_rays(camera: Camera) -> FloatArray:
    """Return the tangents (u, v) at the corners of all pixels, (height + 1, width + 1, 2).

    Between the corners of a pixel they are linear to 1e-4 px, even if the distortion reaches 100 px.

    Raises:
        GeometryError: the distortion cannot be inverted everywhere in the photograph.
    """
    width, height = camera.size_px
    x, y = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    uv = tangents_from_pixel(camera, np.column_stack([x.ravel(), y.ravel()]))
    if not np.isfinite(uv).all():
        raise GeometryError(
            f"camera {camera.name}: its distortion cannot be inverted everywhere in the photograph"
        )
    return uv.reshape(height + 1, width + 1, 2)


class _View(NamedTuple):
    """A camera at a station."""

    camera: Camera
    position: FloatArray  # projection centre, object unit, (3,)
    rotation: FloatArray  # R, (3, 3)
    rays: FloatArray  # tangents at the corners of the pixels, (height + 1, width + 1, 2)


def _paint_face(fine: AnyArray, scene: Scene, face: int, view: _View, n: int, scratch: AnyArray) -> None:
    """Paint one face with its marks and its light over the existing image, n cells along a pixel."""
    faces, marks = scene.faces, scene.marks
    # H (u, v, -1) is (a w, b w, w) with plane coordinates a, b; w < 0 in front
    away = view.position - faces.centre[face]
    normal = faces.normals()[face]
    by_ray = normal @ view.rotation
    height = normal @ away
    a, b = (axis @ away * by_ray - height * (axis @ view.rotation) for axis in faces.axes[face])
    H = np.stack([a, b, by_ray])

    def windows(centre: FloatArray, half: FloatArray) -> IntArray:
        """Return first and last row and column of the cells around squares, in whole pixels, (k, 4)."""
        around = (centre[:, None] + half[:, None] * SQUARE).reshape(-1, 2)
        points = faces.place(np.full(len(around), face), around)
        xy = project(view.camera, view.position, view.rotation, points).reshape(len(centre), len(SQUARE), 2)
        in_front = np.asarray(np.isfinite(xy).all(axis=(1, 2)))
        seen = np.where(in_front[:, None, None], xy, 0.0)
        low = np.clip(np.floor(seen.min(axis=1) - 1).astype(np.int64) * n, 0, fine.shape[::-1])
        high = np.clip(np.ceil(seen.max(axis=1) + 2).astype(np.int64) * n, 0, fine.shape[::-1])
        cells = np.column_stack([low[:, 1], high[:, 1], low[:, 0], high[:, 0]])
        everywhere = (0, fine.shape[0], 0, fine.shape[1])  # of a square partly behind the camera
        return np.where(in_front[:, None], cells, everywhere)

    box = windows(np.zeros((1, 2)), faces.half[face][None])[0]
    if box[0] >= box[1] or box[2] >= box[3]:
        return
    shape_of_box = (box[1] - box[0], box[3] - box[2])
    value, cover = (cells[: shape_of_box[0] * shape_of_box[1]].reshape(shape_of_box) for cells in scratch)
    rectangle = np.array([*faces.half[face], 0.0, 0.0])
    lamp = Lamp(0.0, 0.0, 1.0, 0.0, 1.0)
    if scene.light is not None:
        to_light = scene.light.position - faces.centre[face]
        along, up = faces.axes[face] @ to_light, normal @ to_light
        reach2, ambient = float(scene.light.reach) ** 2, float(scene.light.ambient)
        lamp = Lamp(float(along[0]), float(along[1]), float(up), reach2, ambient)
    surface = faces.value[face], faces.texture[face], faces.grain[face]
    fill_face(value, cover, box, view.rays, H, rectangle, *surface, face, lamp, n)
    on_face = np.flatnonzero(marks.face == face)
    kinds = (marks.kind[on_face] == DISC, marks.kind[on_face] == ARC)
    reach = np.select(kinds, marks.shape[on_face, :2].T, np.hypot(*marks.shape[on_face, :2].T))
    parts = windows(marks.centre[on_face], np.column_stack([reach, reach]))
    parts[:, ::2] = np.maximum(parts[:, ::2], box[::2])
    parts[:, 1::2] = np.minimum(parts[:, 1::2], box[1::2])
    for k, part in zip(on_face, parts, strict=True):
        mark = int(marks.kind[k]), marks.centre[k], marks.shape[k], marks.value[k]
        paint_mark(value, box, part, view.rays, H, *mark, lamp, n)
    cover_with(fine, box, value, cover)


# A square of half length 1, with points along its sides so that its image is bounded even with distortion.
_SIDE = np.linspace(-1, 1, 9)[:-1]
SQUARE = np.concatenate(
    [
        np.column_stack([_SIDE, np.full(8, -1.0)]),
        np.column_stack([np.full(8, 1.0), _SIDE]),
        np.column_stack([-_SIDE, np.full(8, 1.0)]),
        np.column_stack([np.full(8, -1.0), -_SIDE]),
    ]
)


def write_photographs(staging: Staging, folder: Path) -> None:
    """Render the photographs of a scene file and write them with the truth; all files appear, or none.

    Args:
        staging: result of `read_scene`.
        folder: folder of the photographs, with truth_points.csv (targets on the object), truth_images.csv
            (exterior orientation) and truth_image_points.csv. The latter contains, for each target that is
            wholly visible, the images of the circle's centre and the centre of its outline.

    Raises:
        OutputError: a file cannot be written.
    """
    refuse_foreign_files(folder, (*staging.names, *TRUTH))
    scene = staging.scene
    photographs, projected = render_photographs(
        scene, staging.camera, staging.positions, staging.rotations, optics=staging.optics, seed=staging.seed
    )
    points = scene.faces.place(scene.targets.face, scene.targets.centre)
    code = scene.targets.code
    names = [f"t{k + 1:03d}" if code[k] == UNCODED else str(code[k]) for k in range(len(code))]
    angles = np.degrees(angles_from_rotation(staging.rotations))
    with whole_files(folder, "the photographs") as part:
        for name, photograph in zip(staging.names, photographs, strict=True):
            if not cv2.imwrite(str(part / name), photograph, [cv2.IMWRITE_JPEG_QUALITY, staging.quality]):
                raise OutputError(f"{folder / name}: the photograph could not be written")
        _write_table(
            part / TRUTH[0],
            ("target", "code", "X", "Y", "Z", "radius"),
            [(n, c, *X, r) for n, c, X, r in zip(names, code, points, scene.targets.radius, strict=True)],
        )
        _write_table(
            part / TRUTH[1],
            ("image", "X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg"),
            [(n, *X0, *a) for n, X0, a in zip(staging.names, staging.positions, angles, strict=True)],
        )
        _write_table(
            part / TRUTH[2],
            ("image", "target", "x_px", "y_px", "outline_x_px", "outline_y_px", "diameter_px"),
            [
                (image, names[k], *targets.centre[k], *targets.outline_centre[k], targets.diameter[k])
                for image, targets in zip(staging.names, projected, strict=True)
                for k in np.flatnonzero(targets.visible)
            ],
        )


def _write_table(path: Path, header: tuple[str, ...], rows: list[tuple[object, ...]]) -> None:
    cells = ([f"{v:.9g}" if isinstance(v, float) else v for v in row] for row in rows)
    path.write_text(csv_text(header, cells), encoding="utf-8", newline="")


def main() -> int:
    """Render the photographs of a scene file from the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sfm.products.rendering.render", description=__doc__.splitlines()[0]
    )
    parser.add_argument("scene", type=Path, help="scene file (TOML)")
    parser.add_argument("folder", type=Path, help="folder for the photographs and the truth")
    given = parser.parse_args()
    try:
        refuse_folder_settings()
        staging = read_scene(given.scene)
        write_photographs(staging, given.folder)
    except Exception as error:
        message, code = ending_of(error)
        print(f"error: {message}", file=sys.stderr)
        return code
    print(
        f"{counted(len(staging.names), 'photograph')} of {len(staging.scene.targets)} "
        f"targets in {given.folder}"
    )
    return 0


def painting_order(scene: Scene, position: FloatArray) -> IntArray:
    """Return the faces turned towards the camera, from back to front (painter's algorithm).

    If the images of two faces overlap, one is painted first if it lies on the far side of the plane of the
    other, or if the other lies on the near side of its plane.

    Source: Newell, Newell and Sancha (1972), Proc. ACM National Conference, p. 443 (tests 2 to 4).
    """
    faces = scene.faces
    normal = faces.normals()
    turned = np.flatnonzero(np.einsum("fi,fi->f", normal, position - faces.centre) > 0)
    corners = faces.corners()
    # height of the corners of face g above the plane of face f
    above = np.einsum("fi,fgci->fgc", normal, corners[None] - faces.centre[:, None, None])
    slack = TOUCHING_FRACTION * np.abs(faces.half).max(initial=0.0)
    far = (above <= slack).all(axis=2).T  # [g, f]: g is on the far side of f
    near = (above >= -slack).all(axis=2).T
    may_precede = far | near.T  # [g, f]: g may be painted before f
    must_precede = may_precede & ~may_precede.T
    distance = np.linalg.norm(faces.centre - position, axis=1)
    rest = list(turned[np.argsort(-distance[turned], kind="stable")])
    # Two convex images are disjoint if a plane through the camera and an edge of one has the other outside.
    from_camera = corners - position
    sight = np.cross(from_camera, np.roll(from_camera, -1, axis=1))  # normals of these planes
    sight /= np.linalg.norm(sight, axis=2, keepdims=True)
    side = np.einsum("fei,gci->fegc", sight, from_camera)
    inner = np.einsum("fei,fi->fe", sight, from_camera.mean(axis=1))
    outside = (side * -np.sign(inner)[:, :, None, None] >= -slack).all(axis=3).any(axis=1)
    must_precede &= ~(outside | outside.T)
    order: list[int] = []
    while rest:
        ready = [g for g in rest if not any(must_precede[f, g] for f in rest)]
        # Faces that hide each other in a cycle have no order; the farthest is then painted first.
        order.append(int((ready or rest)[0]))
        rest.remove(order[-1])
    return np.array(order, dtype=np.int64)


@dataclass(frozen=True)
class ProjectedTargets:
    """Positions of the targets of a scene in a photograph."""

    centre: FloatArray  # image of the centre of the circle, px, NaN behind the camera, (n, 2)
    outline_centre: FloatArray  # centre of area of the image of the circle, px, (n, 2)
    diameter: FloatArray  # largest diameter of the image, px, (n,)
    visible: BoolArray  # whole in the photograph, seen from the front and not hidden, (n,)


def project_targets(
    scene: Scene, camera: Camera, position: FloatArray, rotation: FloatArray
) -> ProjectedTargets:
    """Return the positions of the targets of a scene in a photograph, and which are wholly visible."""
    faces, targets = scene.faces, scene.targets
    n = len(targets)
    angle = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rim = targets.centre[:, None] + targets.radius[:, None, None] * circle
    outline = faces.place(np.repeat(targets.face, OUTLINE), rim.reshape(-1, 2))
    centre = project(camera, position, rotation, faces.place(targets.face, targets.centre))
    outline_px = project(camera, position, rotation, outline).reshape(n, OUTLINE, 2)
    width, height = camera.size_px
    inside = ((outline_px > 0) & (outline_px < (width - 1, height - 1))).all(axis=(1, 2))
    normal = faces.normals()
    front = np.einsum("fi,fi->f", normal, position - faces.centre)[targets.face] > 0
    seen = outline.reshape(n, OUTLINE, 3)[:, :: OUTLINE // RIM]
    hidden = np.array(
        [_hidden(scene, position, points, face) for points, face in zip(seen, targets.face, strict=True)],
        dtype=bool,
    )
    across = np.linalg.norm(outline_px - np.roll(outline_px, OUTLINE // 2, axis=1), axis=2)
    diameter = across.max(axis=1, initial=0.0)
    p = outline_px - outline_px[:, :1]  # the centre of area is computed about the first corner
    q = np.roll(p, -1, axis=1)
    cross = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    moment = ((p + q) * cross[..., None]).sum(axis=1)
    centre_of_area = outline_px[:, 0] + moment / (3 * cross.sum(axis=1))[:, None]
    return ProjectedTargets(centre, centre_of_area, diameter, inside & front & ~hidden)


def _hidden(scene: Scene, position: FloatArray, points: FloatArray, face: int) -> bool:
    """Return whether any other face is between the camera and any of the points of one face."""
    faces = scene.faces
    direction = points - position
    for f, normal in enumerate(faces.normals()):
        height = float(normal @ (position - faces.centre[f]))
        if f == face or height <= 0:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            part = -height / (direction @ normal)
            hit = position + part[:, None] * direction - faces.centre[f]
        within = (np.abs(hit @ faces.axes[f].T) < faces.half[f]).all(axis=1)
        if (within & (part > 0) & (part < 1 - 1e-9)).any():
            return True
    return False


if __name__ == "__main__":
    sys.exit(main())
