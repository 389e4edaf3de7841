"""Camera systems of DICe: two cameras, the second relative to the first.

Source: DICe, DICe_CameraSystem.cpp and its tests/component/cal.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import quoteattr

from adapters.formats.cameras.lens_terms import Mounted, coefficients_of, matrix_of, numbers_text

SYSTEM = (
    ("xml_file_format", "string", "DICe_xml_camera_system_file"),
    ("system_type_3D", "string", "OPENCV"),
    ("extrinsics_relative_camera_to_camera", "bool", "true"),
)
COEFFICIENTS = ("K1", "K2", "P1", "P2", "K3", "K4", "K5", "K6")


def pair_lines(pair: list[Mounted], unit: str) -> Iterator[str]:
    """Yield the lines of a system of two cameras in models of OpenCV, lengths in a unit."""

    def entry(name: str, kind: str, value: object) -> str:
        return f'<Parameter name="{name}" type="{kind}" value={quoteattr(str(value))} />'

    yield from ("<ParameterList>", f"  <!-- TX, TY, TZ are in {unit} -->")
    yield from ("  " + entry(*row) for row in SYSTEM)
    for k, mounted in enumerate(pair):
        K, size = matrix_of(mounted.camera), mounted.camera.size_px
        values = dict(zip(("CX", "CY", "FX", "FY"), (K[0, 2], K[1, 2], K[0, 0], K[1, 1]), strict=True))
        values |= zip(COEFFICIENTS, coefficients_of(mounted.camera, fewest=4), strict=False)
        values |= zip(("TX", "TY", "TZ"), mounted.T.tolist(), strict=True)
        yield f'  <ParameterList name="CAMERA {k}">'
        yield "    " + entry("CAMERA_ID", "string", mounted.camera.name)
        yield from ("    " + entry(name, "double", repr(float(value))) for name, value in values.items())
        yield "    " + entry("LENS_DISTORTION_MODEL", "string", "OPENCV_LENS_DISTORTION")
        yield "    " + entry("IMAGE_HEIGHT_WIDTH", "string", f"{{ {size[1]}, {size[0]} }}")
        yield '    <ParameterList name="rotation_3x3_matrix">'
        for r, row in enumerate(mounted.R):
            yield "      " + entry(f"ROW {r}", "string", f"{{ {numbers_text(row)} }}")
        yield from ("    </ParameterList>", "  </ParameterList>")
    yield "</ParameterList>"
