"""Models of MicMac: a folder Ori-NAME with cameras, orientations and measures, or one of its files.

    AutoCal*.xml          F, PP, SzIm, and the distortion: ModNoDist, ModRad or ModPhgrStd (Fraser)
    Orientation-*.xml     of the photograph *: Centre, rows L1 to L3 of R, and FileInterne, its camera
    MesuresAppuis.xml     control: Pt, NamePt, Incertitude (standard deviations)
    MesuresIm.xml         image points: NamePt, PtIm of each NameIm

R turns camera axes (x right, y down, z forward) into object axes. An ideal point F (x, y) / z + PP is
distorted from CDist, in px, with the coefficients R3, R5 ... of CoeffDist:

    x + x (R3 r2 + R5 r4 + ...) + P1 (r2 + 2 x2) + 2 P2 x y + b1 x + b2 y
    y + y (R3 r2 + R5 r4 + ...) + P2 (r2 + 2 y2) + 2 P1 x y

This is `brown_forward` where CDist is PP, up to R9. Otherwise the best `brown_forward` on a grid over the
photograph is read, and its misfit noted. Pixels are taken to count from the centre of the first. Tie points
(Homol) and MicMac v2 are not read.

Source: MicMac (CeCILL-B) and the reader of its cameras in iTowns (photogrammetric-camera, MIT). The points
that its orientations state for verification agree with these formulas to 1e-11 px.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from xml.sax.saxutils import escape

import numpy as np

from adapters.formats.cameras.lens_terms import forward_camera
from adapters.formats.content import Content, flat_names
from adapters.formats.stated_model import StatedModel, content_of, from_vision_axes, to_vision_axes
from adapters.reading.text_lines import write_lines
from adapters.reading.xml_lines import Node, read_xml
from sfm.files.plain_text import MAX_SIDE_PX, shorten
from sfm.model.camera import Camera
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.model.errors import SurveyFileError
from sfm.model.network import rows_of

CAMERA, POSE = "AutoCal*.xml", "Orientation-*.xml"
CONTROL, MEASURED = "MesuresAppuis.xml", "MesuresIm.xml"
PLACES = (POSE, CAMERA, CONTROL, MEASURED)
ROOTS = (
    "<ExportAPERO>",
    "<DicoAppuisFlottant",
    "<SetOfMesureAppuisFlottants",
)  # by which a file is recognised
HELD = "eConvApero_DistM2C"  # distortion from the ideal to the measured point
MAX_COEFFICIENTS = 20
GRID = 15  # ideal points along each side, for a fit


def read_micmac(path: Path) -> Content:
    """Read a folder of MicMac, or one of its files; others are those of the measures.

    Args:
        path: a folder Ori-NAME, whose measures may also lie one folder above, or a file.

    Raises:
        SurveyFileError: with file and line number.
    """
    stated = StatedModel(path, points_named=True)
    files = [path] if path.is_file() else _files(path)
    roots = [read_xml(file) for file in files]
    cameras: dict[str, int] = {}
    for file, root in zip(files, roots, strict=True):
        if (node := root.maybe("CalibrationInternConique")) is not None:
            cameras[file.name] = len(cameras)
            stated.cameras.append(_camera(file.stem, node, stated))
    images: dict[str, int] = {}
    for file, root in zip(files, roots, strict=True):
        if (node := root.maybe("OrientationConique")) is not None:
            name = file.name.removeprefix("Orientation-").removesuffix(".xml")
            images[name] = len(images)
            _add_pose(name, node, cameras, stated)
    points: dict[str, int] = {}
    for root in (root for root in roots if root.tag == "DicoAppuisFlottant"):
        for node in root.all("OneAppuisDAF"):
            xyz, name = node.one("Pt").numbers(3), _name(node, "NamePt")
            if name in points:
                raise node.error(f"point '{shorten(name)}' is a duplicate")
            points[name] = stated.add_point(name, xyz)
            sigma = node.maybe("Incertitude")
            s = np.ones(3) if sigma is None else sigma.numbers(3)
            if not (s >= 0).all():
                raise node.error(f"Incertitude {s.min():g} of point '{shorten(name)}', needed 0 or more")
            stated.control[points[name]] = (xyz, np.diag(s**2))
    alone = without = 0
    for root in (root for root in roots if root.tag == "SetOfMesureAppuisFlottants"):
        for of_image in root.all("MesureAppuiFlottant1Im"):
            image = _name(of_image, "NameIm")
            if image not in images and not cameras:
                alone += 1
                continue
            if image not in images:
                images[image] = len(images)
                stated.add_image(image, 0)
                without += 1
            for node in of_image.all("OneMesureAF1I"):
                name = _name(node, "NamePt")
                if name not in points:
                    points[name] = stated.add_point(name, np.full(3, np.nan))
                stated.add_image_point(images[image], points[name], *node.one("PtIm").numbers(2).tolist())
    if without and len(cameras) > 1:
        stated.notes.append(
            f"{counted(without, 'photograph')} without orientation read with the first camera"
        )
    if alone:
        stated.notes.append(f"measures in {counted(alone, 'photograph')} without a camera left out")
    return content_of(stated)


def write_micmac(folder: Path, content: Content) -> None:
    """Write cameras, orientations, control and image points.

    Args:
        folder: new or empty.
        content: cameras in model brown_forward with square pixels.

    Raises:
        OutputError: the folder cannot be written.
    """
    result = content.result
    network, estimate = result.network, result.estimate
    folder.mkdir(parents=True, exist_ok=True)
    files = [f"AutoCal-{k}.xml" for k in range(len(estimate.cameras))]
    for file, camera in zip(files, estimate.cameras, strict=True):
        _write(folder / file, "ExportAPERO", _camera_lines(camera))
    images = flat_names(network.images)
    matrices = np.swapaxes(to_vision_axes(estimate.rotation), 1, 2)
    for i in np.flatnonzero(estimate.oriented).tolist():
        lines = ["<OrientationConique>", "<TypeProj>eProjStenope</TypeProj>"]
        lines += ["<ZoneUtileInPixel>true</ZoneUtileInPixel>"]
        lines += [
            f"<FileInterne>{files[network.camera[i]]}</FileInterne>",
            "<RelativeNameFI>true</RelativeNameFI>",
        ]
        lines += [
            "<Externe>",
            f"<KnownConv>{HELD}</KnownConv>",
            f"<Centre>{_text(estimate.position[i])}</Centre>",
        ]
        rows = [f"<L{k + 1}>{_text(row)}</L{k + 1}>" for k, row in enumerate(matrices[i])]
        lines += ["<ParamRotation>", "<CodageMatr>", *rows, "</CodageMatr>", "</ParamRotation>", "</Externe>"]
        lines += ["<ConvOri>", f"<KnownConv>{HELD}</KnownConv>", "</ConvOri>", "</OrientationConique>"]
        _write(folder / f"Orientation-{images[i]}.xml", "ExportAPERO", lines)
    control = network.control.complete
    if len(control):
        lines = []
        for j, xyz, C in zip(control.point.tolist(), control.xyz, control.covariance, strict=True):
            lines += [
                "<OneAppuisDAF>",
                f"<Pt>{_text(xyz)}</Pt>",
                f"<NamePt>{escape(network.points[j])}</NamePt>",
            ]
            lines += [f"<Incertitude>{_text(np.sqrt(np.diagonal(C)))}</Incertitude>", "</OneAppuisDAF>"]
        _write(folder / CONTROL, "DicoAppuisFlottant", lines)
    seen = network.image_points
    lines = []
    for image, of_image in zip(images, rows_of(seen.image, len(network.images)), strict=True):
        lines += ["<MesureAppuiFlottant1Im>", f"<NameIm>{escape(image)}</NameIm>"]
        for row in of_image.tolist():
            point = escape(network.points[seen.point[row]])
            lines.append(
                f"<OneMesureAF1I><NamePt>{point}</NamePt><PtIm>{_text(seen.xy[row])}</PtIm></OneMesureAF1I>"
            )
        lines.append("</MesureAppuiFlottant1Im>")
    if images:
        _write(folder / MEASURED, "SetOfMesureAppuisFlottants", lines)


def _files(folder: Path) -> list[Path]:
    """Return the files of a folder of MicMac in their order, and measures beside it.

    Raises:
        SurveyFileError: one is a link that leaves its folder.
    """
    names = [file for place in PLACES for file in sorted(folder.glob(place))]
    above = [folder.parent / name for name in (CONTROL, MEASURED)] if folder.name.startswith("Ori-") else []
    names += [file for file in above if file.is_file() and not (folder / file.name).is_file()]
    for file in names:
        if not file.resolve().is_relative_to(folder.parent.resolve()):
            raise SurveyFileError(f"{file}: a link that leaves its folder; the file itself is needed there")
    return names


def _add_pose(name: str, node: Node, cameras: dict[str, int], stated: StatedModel) -> None:
    """Add a photograph with its orientation.

    Raises:
        SurveyFileError: the file of its camera is not there, or its coding is not read.
    """
    file = PurePosixPath(_name(node, "FileInterne")).name
    if file not in cameras:
        raise node.error(f"its camera {shorten(file)} is not beside it")
    affine = node.maybe("OrIntImaM2C")
    if affine is not None:
        given = np.concatenate([affine.one(tag).numbers(2) for tag in ("I00", "V10", "V01")])
        if not np.array_equal(given, [0, 0, 1, 0, 0, 1]):
            raise affine.error("an affine transformation of the photograph is not read")
    outside = node.one("Externe")
    rows = outside.one("ParamRotation").one("CodageMatr")
    R = np.array([rows.one(f"L{k}").numbers(3) for k in (1, 2, 3)])
    stated.add_image(name, cameras[file], outside.one("Centre").numbers(3), from_vision_axes(R.T))


def _camera(name: str, node: Node, stated: StatedModel) -> Camera:
    """Return a camera; a pixel is 1 mm, as the file does not state its size.

    Raises:
        SurveyFileError: a distortion that no model here has.
    """
    convention = node.maybe("KnownConv")
    if convention is not None and convention.text.strip() != HELD:
        raise convention.error(f"distortion as {shorten(convention.text.strip())} is not read, {HELD} is")
    f, size = float(node.one("F").numbers(1)[0]), node.one("SzIm").numbers(2)
    if not f > 0:
        raise node.error(f"F {f:g} px, it must be positive")
    if not ((size >= 1) & (size <= MAX_SIDE_PX) & (size == size.round())).all():
        raise node.error(f"SzIm {size[0]:g} x {size[1]:g}, needed whole numbers from 1 to {MAX_SIDE_PX}")
    width, height = int(size[0]), int(size[1])
    principal = node.one("PP").numbers(2)
    kinds = [child for part in node.all("CalibDistortion") for child in part.children]
    if len(kinds) > 1 or any(kind.tag not in ("ModNoDist", "ModRad", "ModPhgrStd") for kind in kinds):
        raise node.error(
            f"distortion {', '.join(shorten(kind.tag) for kind in kinds)}, needed ModRad, ModPhgrStd or "
            "ModNoDist"
        )
    centre, radial, plane = principal, np.zeros(0), np.zeros(4)
    if kinds and kinds[0].tag != "ModNoDist":
        part = kinds[0].one("RadialePart") if kinds[0].tag == "ModPhgrStd" else kinds[0]
        coefficients = part.all("CoeffDist")
        if len(coefficients) > MAX_COEFFICIENTS:
            raise part.error(f"{len(coefficients)} of CoeffDist, needed {MAX_COEFFICIENTS} at most")
        centre = part.one("CDist").numbers(2)
        radial = np.array([float(value.numbers(1)[0]) for value in coefficients])
        found = [kinds[0].maybe(tag) for tag in ("P1", "P2", "b1", "b2")]
        plane = np.array([0.0 if value is None else float(value.numbers(1)[0]) for value in found])
    x0, y0 = (principal - [(width - 1) / 2, (height - 1) / 2]) * (1, -1)
    scale, shift = 1.0, np.zeros(2)
    if np.array_equal(centre, principal) and not radial[4:].any():
        terms = np.concatenate([radial[:4], np.zeros(4 - len(radial[:4])), plane * (1, -1, 1, -1)])
    else:
        steps = np.linspace(0, 1, GRID)
        xy = np.stack(np.meshgrid(steps * (width - 1), steps * (height - 1)), -1).reshape(-1, 2) - principal
        terms, misfit = _fitted(xy * (1, -1), (centre - principal) * (1, -1), radial, plane * (1, -1, 1, -1))
        shift, scale, terms = terms[:2], 1.0 + float(terms[2]), terms[3:]
        if not scale > 0:
            raise node.error("its distortion folds the photograph")
        stated.notes.append(
            f"camera {name}: distortion about {_text(centre)} px read with misfit {misfit:.4f} px RMS"
        )
    place = (f, float(x0 + shift[0]), float(y0 + shift[1]))
    return forward_camera(name, (width, height), (1.0, 1.0), place, tuple(terms.tolist()), scale=scale)


def _fitted(xy: FloatArray, e: FloatArray, radial: FloatArray, plane: FloatArray) -> tuple[FloatArray, float]:
    """Return shift, linear term, K1 to K4, P1, P2, b1, b2 nearest to a distortion about another point.

    Args:
        xy: ideal points from the principal point, px, y up, (k, 2).
        e: the other point, px, (2,).
        radial: R3, R5 ... about it.
        plane: P1, P2, b1, b2 about it, (4,).

    Returns:
        The terms, (11,), and the RMS of the misfit of a point, px.
    """

    def columns(p: FloatArray, count: int) -> FloatArray:
        (x, y), r2 = p.T, (p * p).sum(axis=1)
        powers = [p * (r2**k)[:, None] for k in range(count + 1)]
        decentring = [np.stack([r2 + 2 * x * x, 2 * x * y], -1), np.stack([2 * x * y, r2 + 2 * y * y], -1)]
        affine = [np.stack([x, 0 * x], -1), np.stack([y, 0 * y], -1)]
        return np.stack([*powers, *decentring, *affine], -1)

    distortion = columns(xy - e, len(radial)) @ np.concatenate([[0.0], radial, plane])
    ones = np.tile(np.eye(2), (len(xy), 1, 1))
    A = np.concatenate([ones, columns(xy, 4)], axis=2).reshape(2 * len(xy), -1)
    size = np.abs(A).max(axis=0)
    terms = np.linalg.lstsq(A / size, distortion.ravel(), rcond=None)[0] / size
    misfit = distortion.ravel() - A @ terms
    return terms, float(np.sqrt(2 * np.mean(misfit**2)))


def _camera_lines(camera: Camera) -> list[str]:
    """Return the lines of a camera in model brown_forward."""
    p = camera.pixel_mm[0]
    centre = _text(camera.principal_point_px - 0.5)
    radial = [camera.value(f"K{k}") * p ** (2 * k) for k in (1, 2, 3, 4)]
    plane = {"P1": camera.value("P1") * p, "P2": -camera.value("P2") * p}
    plane |= {"b1": camera.value("b1"), "b2": -camera.value("b2")}
    lines = ["<CalibrationInternConique>", f"<KnownConv>{HELD}</KnownConv>", f"<PP>{centre}</PP>"]
    lines += [
        f"<F>{_text(camera.value('c') / p)}</F>",
        f"<SzIm>{camera.size_px[0]} {camera.size_px[1]}</SzIm>",
    ]
    body = [f"<CDist>{centre}</CDist>", *(f"<CoeffDist>{_text(value)}</CoeffDist>" for value in radial)]
    body.append("<PPaEqPPs>true</PPaEqPPs>")
    if any(plane.values()):
        terms = [f"<{tag}>{_text(value)}</{tag}>" for tag, value in plane.items()]
        body = ["<ModPhgrStd>", "<RadialePart>", *body, "</RadialePart>", *terms, "</ModPhgrStd>"]
    else:
        body = ["<ModRad>", *body, "</ModRad>"]
    return [*lines, "<CalibDistortion>", *body, "</CalibDistortion>", "</CalibrationInternConique>"]


def _name(node: Node, tag: str) -> str:
    """Return the text of a child that is a name."""
    child = node.one(tag)
    return Node(child.path, child.line, tag, {tag: child.text.strip()}).name(tag)


def _text(values: FloatArray | float) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def _write(path: Path, root: str, lines: list[str]) -> None:
    write_lines(path, ['<?xml version="1.0" ?>', f"<{root}>", *lines, f"</{root}>"])
