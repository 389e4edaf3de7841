"""Kolinear: close-range photogrammetry from photographs to coordinates with their covariance.

    >>> import sfm
    >>> "adjust" in dir(sfm)
    True

Every public name is listed in `__init__.pyi` and is imported when it is first asked for.
"""

from __future__ import annotations

from sfm.runtime.installation import refuse_mixed_installation

refuse_mixed_installation()

_MODULES = {
    "sfm.adjustment.covariance": ("change_datum",),
    "sfm.adjustment.datum": ("Datum",),
    "sfm.adjustment.result": ("Adjustment",),
    "sfm.adjustment.solve": ("adjust",),
    "sfm.api": (
        "compare",
        "distance",
        "fit_shape",
        "measure",
        "network_from_colmap",
        "read_result",
        "run_survey",
        "write_result",
    ),
    "sfm.camera": ("Camera", "camera_from_values", "project"),
    "sfm.errors": ("KolinearError",),
    "sfm.network": ("Estimate", "Network", "empty_estimate"),
    "sfm.orientation.incremental.sequence": ("orient",),
    "sfm.photographs.reading": ("read_photograph",),
    "sfm.result": ("SurveyResult",),
    "sfm.similarity": ("Similarity", "fit_similarity"),
    "sfm.solution": ("Solution",),
    "sfm.survey.inputs.exterior_table": ("ObservedExterior",),
    "sfm.survey.inputs.given": ("KnownPoints", "Observations", "ScaleBar"),
    "sfm.survey.inputs.survey": ("CameraSetup", "Survey", "read_survey"),
    "sfm.targets.detect": ("Targets", "find_targets"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> object:
    """Import a public name when it is first asked for."""
    from importlib import import_module

    if name == "__version__":
        from importlib.metadata import version

        return version("kolinear")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'sfm' has no attribute '{name}'")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
