"""Photographs of concentric circle tags with the image of their centre as truth.

    python -m tests.targets.concentric_tags [cctag3 | cctag4]

prints for each radius, tilt, blur and noise which share is read, how many wrongly, and the RMS of the errors
of the centres in px and in stated standard deviations (1 where these are true).
"""

from __future__ import annotations

import math
import sys
from typing import NamedTuple

import cv2
import numpy as np

from sfm.model.conventions import AnyArray, FloatArray
from sfm.targets.codes.concentric import ConcentricFamily, concentric_family
from sfm.targets.detect import find_targets
from tests.synthetic import seed_of
from tests.targets.shapes import INK, PAPER, SUPER, polygon_coverage

CORNERS = 720
C_PX = 1500.0  # principal distance: a tag of 120 px at 60 deg is eccentric by up to 5 px


class Tag(NamedTuple):
    """A photograph of one tag."""

    image: AnyArray
    truth: FloatArray
    """image of the common centre, px, (2,)"""
    number: int


def draw_tag(
    family: ConcentricFamily,
    number: int,
    radius: float,
    *,
    tilt_deg: float,
    blur: float,
    noise: float,
    rng: np.random.Generator,
    spread: float = 0.0,
    slope: float = 0.0,
    paper: float = PAPER,
    ink: float = INK,
) -> Tag:
    """Draw a tag in perspective: every edge is the projected circle, its coverage exact.

    Args:
        family: the number of rings.
        number: id.
        radius: of the outer edge seen square, px.
        tilt_deg: angle between the normal of the tag and the ray, deg; the direction is random.
        blur: standard deviation of the point spread, px.
        noise: standard deviation of the intensities.
        rng: random numbers.
        spread: of the ink, in outer radii.
        slope: relative change of the light over the photograph.
        paper: intensity of the paper.
        ink: intensity of the ink.
    """
    side = 2 * math.ceil(1.45 * radius + 4 * blur + 6)
    turn, tilt = rng.uniform(0, 2 * math.pi), math.radians(tilt_deg)
    a = np.array([math.cos(turn), math.sin(turn), 0.0])
    b = np.array([-math.sin(turn) * math.cos(tilt), math.cos(turn) * math.cos(tilt), math.sin(tilt)])
    centre = side / 2 - 0.5 + rng.uniform(-0.5, 0.5, 2)
    distance = C_PX / radius  # in outer radii
    phi = np.linspace(0, 2 * math.pi, CORNERS, endpoint=False)[:, None]
    covered = np.zeros((side * SUPER, side * SUPER))
    for i, r in enumerate(family.radii(number)):
        sign = 1 - 2 * (i % 2)
        space = (r + sign * spread) * (np.cos(phi) * a + np.sin(phi) * b)
        seen = centre + C_PX * space[:, :2] / (distance + space[:, 2:])
        covered += sign * polygon_coverage(SUPER * (seen + 0.5), side * SUPER, side * SUPER)
    light = 1 + slope * (np.arange(side * SUPER) / (side * SUPER) - 0.5)
    soft = cv2.GaussianBlur((paper + (ink - paper) * covered) * light, (0, 0), blur * SUPER)
    picture = cv2.resize(soft, (side, side), interpolation=cv2.INTER_AREA)
    picture += noise * rng.standard_normal(picture.shape)
    return Tag(np.rint(picture).clip(0, 255).astype(np.uint8), centre, number)


class Read(NamedTuple):
    """What was read of some tags."""

    right: int
    wrong: int
    error: FloatArray
    """of those read right, px, (k, 2)"""
    normalised: FloatArray
    """the same in standard deviations, (k, 2)"""


def read_tags(tags: list[Tag], codes: str) -> Read:
    """Read photographs of one tag each."""
    right, wrong, error, normalised = 0, 0, [], []
    for tag in tags:
        found = find_targets(tag.image, codes=codes)
        for k in np.flatnonzero(found.code >= 0):
            if found.code[k] != tag.number:
                wrong += 1
                continue
            right += 1
            error.append(found.xy[k] - tag.truth)
            normalised.append(np.linalg.solve(np.linalg.cholesky(found.covariance[k]), error[-1]))
    return Read(right, wrong, np.array(error).reshape(-1, 2), np.array(normalised).reshape(-1, 2))


def main() -> None:
    """Print the table."""
    print(f"{'family':8} {'radius':>6} {'tilt':>5} {'blur':>5} {'noise':>5}", end=" ")
    print(f"{'read':>6} {'wrong':>6} {'RMS px':>8} {'over stated':>11}")
    for name in sys.argv[1:] or ("cctag3", "cctag4"):
        family, rng = concentric_family(name), seed_of(f"concentric {name}")
        for radius, count in ((15.0, 40), (25.0, 30), (40.0, 20), (60.0, 15)):
            for tilt in (0.0, 30.0, 45.0, 60.0):
                for blur, noise in ((0.7, 2.0), (1.0, 3.0), (1.5, 5.0)):
                    tags = [
                        draw_tag(
                            family,
                            int(rng.integers(family.count)),
                            radius,
                            tilt_deg=tilt,
                            blur=blur,
                            noise=noise,
                            rng=rng,
                        )
                        for _ in range(count)
                    ]
                    read = read_tags(tags, name)
                    rms = np.sqrt(np.mean(read.error**2)) if read.right else math.nan
                    over = np.sqrt(np.mean(read.normalised**2)) if read.right else math.nan
                    print(
                        f"{name:8} {radius:6.0f} {tilt:5.0f} {blur:5.1f} {noise:5.0f} "
                        f"{100 * read.right / count:5.0f}% {read.wrong:6} {rms:8.4f} {over:11.2f}",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
