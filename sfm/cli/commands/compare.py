"""The command `compare`: two results of one object, or two calibrated cameras."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Pdf, names_in
from sfm.cli.process import loading
from sfm.model.display import counted
from sfm.runtime.faults import working_on


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Result, or a file of cameras.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Result to compare with A.")],
    align: Annotated[
        str | None,
        typer.Option(
            "--align",
            help="Align B to A by points, cameras, control or none.  [default: points; none where one "
            "has no points]",
        ),
    ] = None,
    control: Annotated[
        str, typer.Option("--control", metavar="P,Q,R", help="Names of the points for --align control.")
    ] = "",
    a_format: Annotated[
        str | None, typer.Option("--from-a", metavar="F", help="Format of A.  [default: by its content]")
    ] = None,
    b_format: Annotated[
        str | None, typer.Option("--from-b", metavar="F", help="Format of B.  [default: by its content]")
    ] = None,
    cameras: Annotated[
        bool, typer.Option("--cameras", help="Compare the cameras of two results, not their points.")
    ] = False,
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera",
            metavar="NAME",
            help="Camera of both; A=B if it has another name in B.  [default: the only]",
        ),
    ] = None,
    distance: Annotated[
        float,
        typer.Option(
            "--distance",
            metavar="D",
            help="Compare the images of points at this distance, not of directions.",
        ),
    ] = math.inf,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the table, JSON and page.")
    ] = Path("out/comparison"),
    pdf: Pdf = False,
) -> None:
    """Compare two results, or two calibrated cameras.

    Of results, reports differences, their standard deviations, and which differences are significant; without
    common points, those of the exterior orientations, as of two files of resect --json. If A or
    B is a file of cameras, or with --cameras, reports where both image the same directions: the difference in
    px over the photograph after the rotation that it implies, in standard deviations where they are known.
    """
    with loading():
        from adapters.formats.registry import read_comparable
        from sfm.cli.compared_cameras import compared_as_cameras, difference_of_files
        from sfm.cli.console import exit_by, print_page, print_verdict
        from sfm.comparison.comparison_remarks import verdict_of_comparison
        from sfm.comparison.significance import compare_results
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.report.camera_differences import verdict_of_difference, write_picture
        from sfm.report.differences import (
            describe_pairing,
            describe_scale,
            elements_table,
            largest_difference,
            largest_pose_difference,
        )
        from sfm.report.pages import write_page

    refuse_foreign_folder(out)
    if cameras or camera or compared_as_cameras(a, a_format) or compared_as_cameras(b, b_format):
        with working_on(f"{a} and {b}"):
            difference = difference_of_files(a, b, a_format, b_format, camera=camera, distance=distance)
        page = write_page(difference, out, also=lambda folder: write_picture(difference, folder))
        print_verdict(verdict_of_difference(difference))
        print_page("Report", page, pdf=pdf)
        return
    with working_on(str(a)):
        first = read_comparable(a, a_format)
    with working_on(str(b)):
        second = read_comparable(b, b_format)
    if first.name == second.name:
        first, second = replace(first, name=str(a)), replace(second, name=str(b))
    comparison = compare_results(first, second, align=align, control=names_in(control))
    place = {name: j for j, name in enumerate(first.network.points)}
    xyz = first.estimate.points[[place[name] for name in comparison.points]]
    page = write_page(comparison, out, xyz=xyz)
    print(
        f"{describe_pairing(comparison)}, {counted(len(comparison.images), 'common photograph')}; "
        f"{describe_scale(comparison)}"
    )
    verdict = verdict_of_comparison(comparison)
    print_verdict(verdict)
    if comparison.points:
        print(f"largest difference of a point: {largest_difference(comparison)}")
    elif comparison.images:
        print(f"largest difference of a photograph: {largest_pose_difference(comparison)}")
        if comparison.poses is not None:
            print(elements_table(comparison).text)
    print_page("Report", page, pdf=pdf)
    exit_by(verdict)
