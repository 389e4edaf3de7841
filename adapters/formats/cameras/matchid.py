"""Calibration files of MatchID (.caldat): two cameras, T in mm, R = Rz(Psi) Ry(Phi) Rx(Theta).

Source: pyvale 2026.10, its example calib.caldat, whose cameras converge by x_right = R x_left + T in axes x
right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Iterator

from scipy.spatial.transform import Rotation

from adapters.formats.cameras.lens_terms import Mounted, coefficients_of, matrix_of


def pair_lines(pair: list[Mounted]) -> Iterator[str]:
    """Yield the lines of two cameras in model opencv, lengths in mm."""
    for k, mounted in enumerate(pair):
        K, (k1, k2, p1, p2, k3) = matrix_of(mounted.camera), coefficients_of(mounted.camera)[:5]
        values = {"Fx [pixels]": K[0, 0], "Fy [pixels]": K[1, 1], "Fs [pixels]": 0.0}
        values |= {"Kappa 1": k1, "Kappa 2": k2, "Kappa 3": k3, "P1": p1, "P2": p2}
        values |= {"Cx [pixels]": K[0, 2], "Cy [pixels]": K[1, 2]}
        yield from (f"Cam{k}_{name};{float(value)!r}" for name, value in values.items())
    yield from (f"T{axis} [mm];{value!r}" for axis, value in zip("xyz", pair[1].T.tolist(), strict=True))
    angles = Rotation.from_matrix(pair[1].R).as_euler("xyz", degrees=True).tolist()
    names = ("Theta", "Phi", "Psi")
    yield from (f"{name} [deg];{value!r}" for name, value in zip(names, angles, strict=True))
