"""The settings that a survey was run with, as its report tells them."""

from __future__ import annotations

from typing import Any

from sfm.survey.inputs.settings import Section
from sfm.survey.inputs.survey import Survey


def told_settings(survey: Survey) -> tuple[tuple[str, str], ...]:
    """Return (table of the survey file, its keys and values) of all that was stated or has a default.

    Args:
        survey: as it was run.
    """
    sections: list[tuple[str, Section]] = [(f"camera {one.name}", one) for one in survey.cameras]
    if survey.observations is None:
        sections.append(("targets", survey.targets))
        sections += [(f"plate {k}", one) for k, one in enumerate(survey.plates, 2)]
    if survey.tie_points is not None:
        sections.append(("tie_points", survey.tie_points))
    sections += [("datum", survey.datum), ("adjust", survey.adjust), ("compare", survey.compare)]
    rows = [(name, _words(section.model_dump())) for name, section in sections]
    given = [
        (one, len(values.names))
        for one, values in (
            ("control points", survey.control),
            ("photographs of [exterior]", survey.exterior),
        )
        if values is not None
    ]
    if survey.scale_bars:
        given.append(("scale bars", len(survey.scale_bars)))
    if survey.observations is not None:
        given.append(("image points", len(survey.observations.xy)))
    if given:
        rows.append(("given", ", ".join(f"{count} {name}" for name, count in given)))
    return tuple(rows)


def _words(values: dict[str, Any]) -> str:
    """Return keys with values that say something."""
    return "; ".join(
        f"{key} = {_word(value)}"
        for key, value in values.items()
        if key != "name" and value is not None and value != ()
    )


def _word(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_word(one) for one in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
