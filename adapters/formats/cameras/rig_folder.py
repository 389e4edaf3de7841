"""Calibrated rigs for other programs: a folder with the files of each program, including rectification.

    opencv-LEFT-RIGHT.yml        of each camera with the reference of its rig, for cv2.FileStorage: width,
                                 height (px), K1, D1, K2, D2, R, T, E, F, rectification R1, R2, P1, P2, Q
    dice-LEFT-RIGHT.xml          the same pairs, camera system of DICe
    matchid-LEFT-RIGHT.caldat    the same pairs for MatchID, in mm; if the unit of length is known
    rig_config.json              COLMAP's rig configuration, of all rigs
    kalibr-RIG.yaml              camera chain of Kalibr
    ros-CAMERA.yaml              camera_info of ROS; of a rig of two cameras with rectification
    mrcal-CAMERA.cameramodel     camera model of mrcal

Camera axes are x right, y down, z forward. Pixels count from the centre of the top-left pixel (COLMAP: from
its corner). Lengths are in the unit of the result; for Kalibr, ROS and mrcal in metres if the unit is known.
Each file is that of the module of its program in this folder.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from adapters.formats.cameras import dice, kalibr, matchid, mrcal, opencv, ros
from adapters.formats.cameras.colmap import prefixes_of, rig_entry
from adapters.formats.cameras.lens_terms import Mounted
from adapters.formats.content import Content
from sfm.files.open_folders import disk_errors
from sfm.model.conventions import METRES
from sfm.model.errors import OutputError


def write_rig_files(folder: Path, content: Content) -> None:
    """Write the rigs of a result, with cameras in model opencv, into a folder.

    Raises:
        OutputError: the result has no rigs, or two names give the same file name.
    """
    result = content.result
    network, mounts = result.network, result.estimate.mounts
    if mounts is None or not any(mounts.rig):
        raise OutputError(f"{folder}: the result has no rigs, which format rig requires; see [[rig]]")
    unit, metres = result.unit or "unknown units", METRES.get(result.unit)
    in_metres = "m" if metres else unit
    configs, files = [], {}

    def add(name: str, text: str) -> None:
        path = re.sub(r"[^\w.\-]+", "_", name)
        if path in files:
            raise OutputError(f"{folder}: two files would be {path}; rename cameras or rigs")
        files[path] = text

    for rig, on in mounts.by_rig().items():
        cameras = [Mounted.of(result.estimate.cameras[a], mounts, a) for a in on]
        if len(on) < 2:
            raise OutputError(f"{folder}: rig {rig} has one camera, needed at least 2")
        configs.append(
            rig_entry(cameras, prefixes_of(network, on, [mounted.camera.name for mounted in cameras]))
        )
        for second in cameras[1:]:
            pair = f"{cameras[0].camera.name}-{second.camera.name}"
            add(f"opencv-{pair}.yml", "\n".join(opencv.pair_lines(cameras[0], second, unit)) + "\n")
            add(f"dice-{pair}.xml", "\n".join(dice.pair_lines([cameras[0], second], unit)) + "\n")
            if metres:
                text = "\n".join(matchid.pair_lines([cameras[0], second.scaled(1000.0 * metres)]))
                add(f"matchid-{pair}.caldat", text + "\n")
        scaled = [mounted.scaled(metres or 1.0) for mounted in cameras]
        add(f"kalibr-{rig}.yaml", "\n".join(kalibr.chain_lines(scaled, in_metres)) + "\n")
        for k, mounted in enumerate(scaled):
            add(f"ros-{mounted.camera.name}.yaml", "\n".join(ros.rig_lines(scaled, k, in_metres)) + "\n")
            add(
                f"mrcal-{mounted.camera.name}.cameramodel",
                "\n".join(mrcal.model_lines(mounted, in_metres)) + "\n",
            )
    add("rig_config.json", json.dumps(configs, indent=1) + "\n")
    with disk_errors(f"{folder}: the files of the rig cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8", newline="")
