"""Which targets photographs show, by trying a few of them with every family of codes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.display import listed
from sfm.errors import GeometryError, PhotographError
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.settings import TargetSettings
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.measuring.targets import measure_photograph
from sfm.targets.codes.families import code_family
from sfm.targets.codes.rings import RINGS
from sfm.targets.codes.tags import DICTIONARIES, TagFamily, corner_name
from sfm.targets.detect import Targets

TRIED = 3  # photographs, spread over the folder
MIN_READABLE = 2
MIN_REPEATED = 4  # codes that two photographs must have in common; four orient a photograph
MIN_PROMISING = 3  # codes in the first photograph for which a family is tried on the others
MANY_TARGETS = 12  # circles in a photograph that are no chance finds


@dataclass(frozen=True)
class TargetTrial:
    """What a few photographs show."""

    codes: str  # family of codes, "none" without
    polarity: str  # dark, bright or auto
    repeated: tuple[str, ...]  # names of coded targets that two photographs have, the most frequent first
    counts: tuple[tuple[str, int], ...]  # family and codes that two photographs had in common, best first
    circles: float  # median number of circular targets in a photograph
    blur_px: float  # median standard deviation of their edges, px; NaN without
    photographs: tuple[str, ...]  # that were tried
    unreadable: tuple[tuple[str, str], ...] = ()  # photographs that could not be decoded, and why


def try_targets(
    paths: Sequence[Path], *, store: MeasuredStore | None = None, progress: Progress = SILENT
) -> TargetTrial:
    """Return which targets photographs show.

    Rings are tried first, then square tags. A family is believed for codes that two photographs have in
    common: a wrong family reads a code now and then, but not the same one twice.

    Args:
        paths: photographs in their order; those that cannot be decoded are passed over.
        store: keeps what is measured, so that the survey need not measure it again.
        progress: told of every photograph and family.

    Raises:
        GeometryError: fewer than two of them can be decoded.
    """
    tried, unreadable = _readable(paths, store)
    progress.stage("trial", 2 * len(RINGS))
    rings = {}
    for family in RINGS:
        rings[family] = [_measure(tried[0], family, store)]
        progress.advance(family)
    promising = [family for family in RINGS if _coded(rings[family][0]) >= MIN_PROMISING] or list(RINGS)
    for family in promising:
        rings[family] += [_measure(path, family, store) for path in tried[1:]]
        progress.advance(family)
    plain = rings[promising[0]]
    counts = {family: _repeated(found) for family, found in rings.items()}
    best = max(counts, key=lambda family: len(counts[family]))
    found = rings[best]
    if len(counts[best]) < MIN_REPEATED:
        progress.stage("trial of tags", len(DICTIONARIES))
        tags = {}
        for family in DICTIONARIES:
            first = _measure(tried[0], family, store)
            if _coded(first) >= MIN_REPEATED:
                tags[family] = [first, *(_measure(path, family, store) for path in tried[1:])]
            progress.advance(family)
        counts |= {family: _repeated(measured) for family, measured in tags.items()}
        best = max(counts, key=lambda family: len(counts[family]))
        found = tags.get(best, rings.get(best, plain))
    coded = len(counts[best]) >= MIN_REPEATED
    measured = found if coded else plain
    return TargetTrial(
        best if coded else "none",
        _polarity(measured) if coded else "auto",
        tuple(_name(code, best) for code in counts[best]) if coded else (),
        tuple(sorted(((family, len(codes)) for family, codes in counts.items()), key=lambda one: -one[1])),
        float(np.median([np.isfinite(one.axes_covariance[:, 0, 0]).sum() for one in measured])),
        _blur(measured),
        tuple(path.name for path in tried),
        unreadable,
    )


def _readable(
    paths: Sequence[Path], store: MeasuredStore | None
) -> tuple[list[Path], tuple[tuple[str, str], ...]]:
    """Return photographs that can be decoded, spread over the folder, and which cannot and why."""
    tried: set[int] = set()
    refused: dict[int, tuple[str, str]] = {}
    for place in (round(i * (len(paths) - 1) / (TRIED - 1)) for i in range(TRIED)):
        for k in sorted(range(len(paths)), key=lambda k: abs(k - place)):
            if k in tried or k in refused:
                continue
            try:
                _measure(paths[k], next(iter(RINGS)), store)
            except PhotographError as error:
                refused[k] = paths[k].name, str(error).removeprefix(f"{paths[k].name}: ")
                continue
            tried.add(k)
            break
    if len(tried) < MIN_READABLE:
        why = listed((f"{name}: {reason}" for name, reason in refused.values()), separator="; ")
        raise GeometryError(f"{len(tried)} readable photographs, at least {MIN_READABLE} are needed ({why})")
    return [paths[k] for k in sorted(tried)], tuple(refused.values())


def _measure(path: Path, family: str, store: MeasuredStore | None) -> Targets:
    return measure_photograph(path, TargetSettings(), code_family(family), store)[0]


def _coded(targets: Targets) -> int:
    return len(np.unique(targets.code[targets.code >= 0]))


def _repeated(photographs: Sequence[Targets]) -> tuple[int, ...]:
    """Codes that two photographs have, each once in both, the most frequent first."""
    seen = Counter[int]()
    for targets in photographs:
        codes, times = np.unique(targets.code[targets.code >= 0], return_counts=True)
        seen.update(codes[times == 1].tolist())
    return tuple(code for code, times in seen.most_common() if times > 1)


def _polarity(photographs: Sequence[Targets]) -> str:
    """Polarity of the coded targets, auto where there are both."""
    found = {int(p) for targets in photographs for p in targets.polarity[targets.code >= 0]}
    return {-1: "dark", 1: "bright"}[found.pop()] if len(found) == 1 else "auto"


def _blur(photographs: Sequence[Targets]) -> float:
    blur = np.concatenate([targets.blur for targets in photographs])
    return float(np.median(blur)) if len(blur) else float("nan")


def _name(code: int, family: str) -> str:
    return corner_name(code) if isinstance(code_family(family), TagFamily) else str(code)
