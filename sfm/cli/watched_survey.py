"""What `kolinear run --watch` says of a survey while its photographs are taken."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sfm.cli.console import print_page, print_verdict
from sfm.cli.watching import WatchedSurvey
from sfm.model.errors import GeometryError

if TYPE_CHECKING:
    from sfm.judgement.survey_result import SurveyResult
    from sfm.products.planning.plan import Further


@dataclass
class SurveySoFar(WatchedSurvey):
    """The precision of the points of a survey, and the photographs that improve it most."""

    further: Further | None = None  # None where nothing can be planned yet

    def revise(self, _: Path, __: SurveyResult) -> bool:
        """Return False: nothing in the survey file depends on a result."""
        return False

    def write(self, result: SurveyResult, _: Path, __: Path) -> None:
        """Take the result, and plan the next photographs."""
        from sfm.products.planning.plan import further_photographs, with_image_sigma

        self.result, sigma, solution = result, result.adjustment.sigma0_px, result.solution
        try:
            self.further = further_photographs(
                with_image_sigma(solution.network, sigma), solution.estimate, sigma_px=sigma
            )
        except GeometryError:
            self.further = None

    def show(self, folder: Path, *, pdf: bool = False) -> bool:
        """Print the verdict."""
        assert self.result is not None
        verdict = self.result.verdict
        print_verdict(verdict)
        print_page("Report", folder / "report.html", pdf=pdf)
        self.is_dependable = verdict.level != "bad"
        return self.is_dependable

    def uncertainty(self) -> float:
        """Return the standard deviation of a coordinate of the worst point, RMS of its three, object unit."""
        if self.further is None:
            return math.nan
        return max(filter(math.isfinite, self.further.before.tolist()), default=math.nan)

    def so_far(self) -> Iterator[str]:
        """Yield the weakest points, and the next photographs."""
        import numpy as np

        from sfm.products.planning.further_page import headline, weakest
        from sfm.report.phrases import length_of

        further, result = self.further, self.result
        if further is None or result is None:
            yield "No station from which a further photograph helps is known yet"
            return
        unit = result.solution.unit
        wanted = f", wanted {length_of(self.until, unit)}" if self.until else ""
        points = ", ".join(f"{name} {before}" for name, before, _ in weakest(further, result.solution)[:3])
        yield f"weakest points: {points}{wanted}"
        yield f"next {headline(further, result.solution)}"
        network, position = result.solution.network, result.solution.estimate.position
        for shot in further.shots:
            away = [float(v) for v in np.linalg.norm(position - shot.position, axis=1)]
            near = min(range(len(away)), key=away.__getitem__)
            rolled = f", camera rolled by {shot.roll_deg:.0f} deg" if shot.roll_deg else ""
            yield (
                f"  {length_of(away[near], unit)} from where {network.images[near]} was taken, at a distance "
                f"of {length_of(shot.distance, unit)}: azimuth {shot.azimuth_deg:.0f} deg, elevation "
                f"{shot.elevation_deg:.0f} deg{rolled}"
            )
