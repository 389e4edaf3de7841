"""Command about surveys without a survey file: one is drafted from photographs."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.starting import loading
from sfm.cli.first_use import compile_first
from sfm.errors import KolinearError, OutputError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.remarks.remark import Remark
    from sfm.survey.drafting.draft import Draft

PHOTOGRAPHS = "# Photographs: "  # the comment that states their folder, from that of the file, as in JSON

Pitch = Annotated[
    float | None,
    typer.Option(
        "--pitch",
        metavar="MM",
        min=1e-6,
        help="Squares of a board, or distance of the dots of a plate, mm, for a drafted survey file.  "
        "[default: assumed]",
    ),
]


def init(
    photographs: Annotated[
        Path, typer.Argument(metavar="PHOTOS", help="Folder of the photographs, directly in it.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.toml",
            help="File to write; no other is replaced.  [default: PHOTOS/survey.toml]",
        ),
    ] = None,
    pitch: Pitch = None,
) -> None:
    """Draft a survey file from a folder of photographs.

    Cameras are recognised by the metadata of the files, targets by trying a few photographs; a comment
    says where each value comes from.  Nothing is measured or adjusted: kolinear run does that.
    """
    from sfm.files.whole_files import refuse_existing

    file = photographs / "survey.toml" if out is None else out
    refuse_existing(file)
    draft = _draft(photographs, pitch)
    _write(draft, photographs, file)
    beside = file.parent.resolve() == photographs.resolve()
    print(f"Run it: kolinear run {file}{'' if beside else f' --images {photographs}'}")


def drafted_beside(
    photographs: Path, out: Path | None, pitch: float | None, *, overwrite: bool = False
) -> tuple[Path, Path]:
    """Draft the survey of a folder of photographs, unless a file beside the result has it already.

    Args:
        photographs: the folder.
        out: folder of the result, None for out/NAME OF THE FOLDER.
        pitch: of a plate, mm; None to assume it.
        overwrite: whether a result of other photographs is replaced; the survey file never is.

    Returns:
        The survey file, and the folder of the result.

    Raises:
        KolinearError: no photographs, a pitch beside a file that has one, a survey file or a result of other
            photographs, or the file cannot be written.
    """
    with loading():
        from sfm.files.open_folders import refuse_links
        from sfm.report.origin import Origin, read_origin, refuse_other_origin
        from sfm.report.output import folder_name

    out = Path("out") / folder_name(photographs.resolve().name) if out is None else out
    file = out.parent / f"{out.name}.toml"
    refuse_links(file)
    if file.exists():
        earlier = read_origin(out)
        drafted_of = _photographs_of(file) or (earlier.images if earlier else photographs)
        if drafted_of.resolve() != photographs.resolve():
            raise OutputError(
                f"{file}: is the survey file of the photographs in {os.path.normpath(drafted_of)} and is "
                "left alone; --out names another folder, or remove it to draft a new one"
            )
    if not overwrite:
        refuse_other_origin(out, Origin(file, photographs))
    if file.exists():
        refuse_pitch(pitch, file)
        print(f"Running {file}, which is there already; remove it to draft a new one", file=sys.stderr)
        return file, out
    _write(_draft(photographs, pitch), photographs, file)
    return file, out


def _photographs_of(file: Path) -> Path | None:
    """Return the folder of photographs that a drafted survey file states; None where it states none."""
    text = file.read_text(encoding="utf-8", errors="replace")
    line = next((one for one in text.splitlines() if one.startswith(PHOTOGRAPHS)), None)
    if line is None:
        return None
    try:
        return file.parent / str(json.loads(line.removeprefix(PHOTOGRAPHS)))
    except ValueError:  # changed by hand
        return None


def refuse_pitch(pitch: float | None, file: Path) -> None:
    """Raise KolinearError where a pitch is given for a survey file that is there already."""
    if pitch is not None:
        raise KolinearError(
            f"{file}: --pitch {pitch:g} is for a survey file that is drafted, this one is there already; "
            "write targets.pitch in it, or remove it"
        )


def _draft(photographs: Path, pitch: float | None = None) -> Draft:
    with loading():
        from sfm.api import one_blas_thread, sensor_widths
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.survey.drafting.draft import draft_survey
        from sfm.survey.measuring.measured_store import MeasuredStore

    compile_first()
    unknown: list[Remark] = []
    with working_on(str(photographs)), drawn_progress() as drawn, one_blas_thread():
        draft = draft_survey(
            photographs,
            sensor_width=sensor_widths(unknown.append),
            pitch=pitch,
            store=MeasuredStore.of_user(),
            progress=drawn,
        )
    return replace(draft, remarks=(*draft.remarks, *unknown))


def _write(draft: Draft, photographs: Path, file: Path) -> None:
    """Write a drafted survey with the folder of its photographs, and report on stderr what was found."""
    from sfm.files.plain_text import as_plain
    from sfm.files.whole_files import whole_file
    from sfm.remarks.verdict import lines_of
    from sfm.report.origin import path_from

    stated = PHOTOGRAPHS + json.dumps(path_from(file.parent, photographs))
    with whole_file(file) as part:
        try:
            part.write_text(f"{stated}\n{draft.text}", encoding="utf-8")
        except UnicodeEncodeError as error:
            raise OutputError(f"{file}: a name in it is no text in UTF-8") from error
    for subject, finding in draft.found:
        print(as_plain(f"{subject}: {finding}"), file=sys.stderr)
    for line in lines_of(draft.remarks):
        mark = " " if line.severity == "note" else "!"
        print(as_plain(f"{mark} {line.text} {line.remedy}".rstrip()), file=sys.stderr)
    for name, why in draft.left_out:
        print(as_plain(f"  left out: {name}: {why}"), file=sys.stderr)
    print(f"Survey file: {file}", file=sys.stderr)
