"""Cameras, rigs and observed orientations of an audit: a model's, and those that a survey file states.

A camera of the survey file takes the photographs that its globs match. If it states its interior orientation,
it takes the place of the model's camera; else it names the model's camera of the same photographs, so that
rigs of the file can be used. Rigs of the model are kept where the file has none for their cameras.
"""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sfm.files.result_tables import MOMENTS
from sfm.model.camera import Camera
from sfm.model.conventions import METRES, BoolArray, IntArray, angles_from_rotation
from sfm.model.display import counted, listed
from sfm.model.estimate import Mounts
from sfm.model.network import rows_of
from sfm.model.solution import Solution
from sfm.survey.inputs.cameras import cameras_of_images
from sfm.survey.inputs.exterior_table import MIN_COS_PHI, ObservedExterior
from sfm.survey.inputs.settings import CameraSettings, CompareSettings, RigSettings, TargetSettings
from sfm.survey.inputs.sources import ROWS as SOURCES
from sfm.survey.inputs.survey import CameraSetup, Survey

# what a survey file may have besides, by the fields of a survey
OTHER_SECTIONS = {
    **{row.table: row.section for row in SOURCES},
    "plates": "[[plate]]",
    "start_orientations": "[approximate] images",
    "start_points": "[approximate] points",
    "start_cameras": "[approximate] cameras",
    "exif_sigma_m": "[exterior] exif_sigma_m",
    "diameters": "[targets] diameters",
    "masks": "masks",
    "compare": "[compare]",
}


@dataclass
class Carried:
    """What an audit adjusts of a model and a survey file besides points and given values."""

    cameras: list[CameraSettings] = field(default_factory=list)
    rigs: list[RigSettings] = field(default_factory=list)
    mounts: list[ObservedExterior] = field(default_factory=list)
    moments: dict[str, str] = field(default_factory=dict)
    exterior: ObservedExterior | None = None
    of_model: list[str] = field(default_factory=list)  # what of the model is not used
    of_survey: list[str] = field(default_factory=list)  # what of the survey file is not used


def carried_of(
    model: Solution, used: IntArray, free: Sequence[Camera], fixed: Sequence[str], given: Survey | None
) -> Carried:
    """Return cameras, rigs and observed orientations of a model and of a survey file.

    Args:
        model: the model.
        used: its photographs that are adjusted, in order, (m,).
        free: its cameras with the parameters to estimate free.
        fixed: names of interior parameters to hold.
        given: the survey file, or None.
    """
    network = model.network
    images, camera = [network.images[i] for i in used], network.camera[used]
    carried, owner = Carried(), camera.copy()  # from len(free) on, cameras of the survey file
    names = [of.name for of in free]
    if given is not None:
        owner, own_names = _owners(carried, given, images, camera, free)
        taken = {given.cameras[g].name for g in np.unique(owner[owner >= len(free)]) - len(free)}
        taken |= set(own_names.values())
        names = [
            own_names.get(k) or (f"{name} of the model" if name in taken else name)
            for k, name in enumerate(names)
        ]
    owners = np.unique(owner).tolist()
    photographs = rows_of(owner, len(free) + (0 if given is None else len(given.cameras)))
    for k in owners:
        own = [images[i] for i in photographs[k]]
        globs = None if len(owners) == 1 else tuple(glob.escape(name) for name in own)
        if k < len(free):
            carried.cameras.append(_setup(replace(free[k], name=names[k]), globs))
        elif given is not None:
            first = free[camera[photographs[k][0]]]
            carried.cameras.append(_stated_setup(given.cameras[k - len(free)], first, globs, fixed))
    if given is not None:
        _add_given(carried, given, images)
    _add_rigs_of_model(carried, model, used, names, np.asarray(owner == camera), given)
    return carried


def _owners(
    carried: Carried, given: Survey, images: Sequence[str], camera: IntArray, free: Sequence[Camera]
) -> tuple[IntArray, dict[int, str]]:
    """Return the camera of each photograph, (m,), and the names of model cameras that the file names."""
    owner, names = camera.copy(), dict[int, str]()
    matches = cameras_of_images(given.cameras, images)
    of_given = np.array([match[0] if len(match) == 1 else -1 for match in matches], dtype=np.int64)
    for g, stated in enumerate(given.cameras):
        rows = np.flatnonzero(of_given == g)
        of_model = np.unique(camera[rows])
        if not len(rows):
            carried.of_survey.append(f"camera {stated.name} (no photograph of the model is its own)")
        elif stated.states_free:
            why = _why_not_stated(stated, free[of_model[0]])
            if why:
                carried.of_survey.append(f"camera {stated.name} ({why})")
            else:
                owner[rows] = len(free) + g
        elif len(of_model) == 1 and (camera == of_model[0]).sum() == len(rows):
            names[int(of_model[0])] = stated.name
        else:
            several = counted(len(of_model), "camera")
            carried.of_survey.append(f"camera {stated.name} (its photographs are of {several} of the model)")
    return owner, names


def _why_not_stated(stated: CameraSettings, camera: Camera) -> str:
    """Return why a camera of a survey file cannot take the place of a model's; an empty text if it can."""
    no_pixel = stated.pixel_mm is None and stated.sensor_mm is None
    if no_pixel and stated.c_mm is not None and (camera.pixel_mm == 1.0).all():
        return "neither it nor the model states the size of a pixel"
    if stated.size_px is not None and tuple(stated.size_px) != tuple(camera.size_px):
        size, other = stated.size_px, camera.size_px
        return f"{size[0]} x {size[1]} px, the model {other[0]} x {other[1]} px"
    return ""


def _setup(camera: Camera, images: tuple[str, ...] | None) -> CameraSetup:
    """Return the settings of a camera of a model; its only camera takes all photographs."""
    values = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
    is_free = dict(zip(camera.names, camera.free.tolist(), strict=True))
    c_mm = values.pop("c", None)
    return CameraSetup(
        name=camera.name,
        images=images,
        size_px=camera.size_px,
        pixel_mm=tuple(camera.pixel_mm.tolist()),
        c_mm=c_mm,
        model=camera.model,
        free=tuple(name for name in camera.names if is_free[name]),
        fixed={name: value for name, value in values.items() if not is_free[name]},
        start={name: value for name, value in values.items() if is_free[name]},
    )


def _stated_setup(
    stated: CameraSettings, camera: Camera, images: tuple[str, ...] | None, fixed: Sequence[str]
) -> CameraSettings:
    """Return the settings of a camera of a survey file; what it does not state starts from the model's."""
    pixel = stated.pixel_mm
    if pixel is None and stated.sensor_mm is None:
        pixel = (float(camera.pixel_mm[0]), float(camera.pixel_mm[1]))
    known = {**dict(stated.fixed), **dict(stated.weighted), **dict(stated.balanced), **dict(stated.start)}
    start, held = dict(stated.start), dict(stated.fixed)
    c_mm = stated.c_mm
    of_model = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
    if stated.model == camera.model and pixel is not None and np.allclose(pixel, camera.pixel_mm):
        start = {name: of_model[name] for name in stated.free if name != "c"} | start
        if "c" in stated.free and "c" not in known:
            c_mm = of_model["c"]
    if c_mm is None and not {"c", "f", "fx"} & known.keys():
        c_mm = camera.c_px * float(pixel[0] if pixel is not None else camera.pixel_mm[0])
    free = tuple(name for name in stated.free if name not in fixed)
    held |= {name: start.pop(name) for name in fixed if name in start}
    return stated.model_copy(
        update={
            "images": images,
            "size_px": tuple(camera.size_px),
            "pixel_mm": pixel,
            "c_mm": c_mm,
            "free": free,
            "fixed": tuple(held.items()),
            "start": tuple(start.items()),
        }
    )


def _add_given(carried: Carried, given: Survey, images: Sequence[str]) -> None:
    """Add the rigs and observed orientations of a survey file, and name what is not used."""
    used = {camera.name for camera in carried.cameras}
    for rig in given.rigs:
        missing = [name for name in rig.cameras if name not in used]
        if missing:
            carried.of_survey.append(f"rig {rig.name} (no photographs of camera {listed(missing)} alone)")
        elif rig.moment == "exif":
            carried.of_survey.append(f"rig {rig.name} (its moments are in EXIF data of photographs)")
        else:
            carried.rigs.append(rig)
            carried.moments |= given.moments
    on_rigs = {name for rig in carried.rigs for name in rig.cameras}
    carried.mounts += [table for table in given.mounts if on_rigs.issuperset(table.names)]
    seen, known = given.exterior, set(images)
    if seen is not None:
        rows = np.array([name in known for name in seen.names], dtype=bool)
        if not rows.all():
            lost = int((~rows).sum())
            carried.of_survey.append(f"{counted(lost, 'row')} of [exterior] (no photograph of the model)")
        if rows.any():
            table = seen.table.select(rows)
            kept = table.texts[table.names.index("image")]
            carried.exterior = ObservedExterior(kept, seen.value[rows], seen.sigma[rows], table)
    for name, section in OTHER_SECTIONS.items():
        value = getattr(given, name)
        if value not in (None, ()) and value not in (TargetSettings(), CompareSettings()):
            carried.of_survey.append(section)


def _add_rigs_of_model(
    carried: Carried,
    model: Solution,
    used: IntArray,
    names: Sequence[str],
    kept: BoolArray,
    given: Survey | None,
) -> None:
    """Add the rigs of a model whose cameras are adjusted and on no rig of the survey file.

    Args:
        carried: has the cameras, and the rigs of the survey file.
        model: the model.
        used: its photographs that are adjusted, in order, (m,).
        names: names of the cameras of the model.
        kept: whether each of these photographs stays with its camera of the model, (m,).
        given: the survey file, or None; its lengths are of another scale than those of a model without unit.
    """
    network, mounts = model.network, model.estimate.mounts
    if mounts is None or network.moment is None:
        return
    camera, moment = network.camera[used], network.moment[used]
    on_rigs = {name for rig in carried.rigs for name in rig.cameras}
    taken = {rig.name for rig in carried.rigs}
    for rig, cameras in mounts.by_rig().items():
        rows = np.flatnonzero(np.isin(camera, cameras))
        on = [a for a in cameras if (camera == a).any()]
        together = np.unique(moment[rows], return_counts=True)[1]
        if on_rigs & {names[a] for a in on}:
            continue  # the survey file states the rig of these cameras
        if not (kept[rows].all() and on[:1] == cameras[:1] and len(on) > 1 and together.max() > 1):
            carried.of_model.append(f"rig {rig}")
            continue
        while rig in taken:
            rig += " of the model"
        taken.add(rig)
        carried.rigs.append(RigSettings(name=rig, cameras=tuple(names[a] for a in on), moment=MOMENTS))
        carried.moments |= {network.images[used[i]]: f"{moment[i]}" for i in rows}
        held = [a for a in on[1:] if not mounts.free[a].any()]
        table = _held_mounts(mounts, held, names) if given is None or model.unit in METRES else None
        if table is not None:
            carried.mounts.append(table)
        elif held:
            carried.of_model.append(f"that mounts of rig {rig} are held")


def _held_mounts(mounts: Mounts, held: Sequence[int], names: Sequence[str]) -> ObservedExterior | None:
    """Return mounts that are held fixed; None for none, or if omega and kappa of one cannot be told apart."""
    angles = np.array([angles_from_rotation(mounts.rotation[a]) for a in held]).reshape(-1, 3)
    if not held or (np.abs(np.cos(angles[:, 1])) < MIN_COS_PHI).any():
        return None
    position, held_names = mounts.position[list(held)], [names[a] for a in held]
    return ObservedExterior.from_arrays(held_names, position, 0.0, np.degrees(angles), 0.0)
