"""The store of measured targets: what was measured once in a photograph is not measured again.

It lies in the cache folder of the user, never beside photographs or results, which may come from somebody
else. Targets are kept by the content of the photograph, the settings and the code that measures, so an entry
can be missing or unreadable but never out of date. The folder may be removed at any time.
"""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from sfm.errors import OutputError, PhotographError
from sfm.files.user_cache import make_user_folder, remove_unused, user_folder
from sfm.files.whole_files import whole_file
from sfm.kernels.sources import sources_of
from sfm.targets.codes.families import TargetFamily
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.codes.tags import TagFamily
from sfm.targets.detect import Targets

MAX_ENTRY_BYTES = 100_000_000  # some 400,000 targets; bounded before any memory is taken
MEASURING = ("sfm.photographs.reading", "sfm.targets.detect")  # what is measured depends on these


@dataclass(frozen=True)
class TargetStore:
    """A folder of measured targets, which is the user's alone."""

    folder: Path
    held: dict[str, tuple[Targets, bool]] = field(default_factory=dict)
    """of this run by their keys: targets, and whether they were taken from the folder"""

    @classmethod
    def of_user(cls) -> TargetStore:
        """Return the store in the user's cache folder (XDG_CACHE_HOME), which is made when it is needed.

        Raises:
            OutputError: others can write into it.
        """
        return cls(user_folder("targets", "measured targets"))

    def load(self, key: str) -> Targets | None:
        """Return the targets of a key; None if they are not there or not whole."""
        try:
            path = self._path(key)
            if path.stat().st_size > MAX_ENTRY_BYTES:
                return None
            found = _targets(path.read_bytes())
            os.utime(path)  # asked for now
            return found
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            return None

    def save(self, key: str, targets: Targets) -> None:
        """Keep targets, whole or not at all; where there is no room they are simply not kept."""
        data = io.BytesIO()
        np.savez(data, allow_pickle=False, **{f.name: getattr(targets, f.name) for f in fields(Targets)})
        with suppress(OSError, OutputError):
            make_user_folder(self.folder)
            with whole_file(self._path(key), replaces=True) as part:
                part.write_bytes(data.getbuffer())

    def remove_old(self) -> None:
        """Remove what nobody has asked for in months, and what a killed run left half-written."""
        remove_unused(self.folder)

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.npz"


def target_key(path: Path, settings: str, family: TargetFamily | None) -> str:
    """Return the key of a photograph's targets: a SHA-256 of everything that they depend on.

    Args:
        path: the photograph.
        settings: the settings of the measurement, in any unambiguous text.
        family: the code family.

    Raises:
        PhotographError: the photograph cannot be read.
    """
    codes = "none"
    if isinstance(family, TagFamily):
        codes = family.name
    elif isinstance(family, PlateFamily):
        codes = repr(family)
    elif family is not None:
        table = family.number.tobytes() + family.pattern.tobytes()
        codes = f"{family.cells} {family.inner} {family.outer} {hashlib.sha256(table).hexdigest()}"
    parts = (content_hash(path), settings, codes, _code_version())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a photograph's file.

    Raises:
        PhotographError: the photograph cannot be read.
    """
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise PhotographError(f"{path.name}: not a file, a photograph is needed")
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        why = f"no such file in {path.parent}" if not path.exists() else error.strerror
        raise PhotographError(f"{path.name}: {why}") from error


@cache
def _code_version() -> str:
    """Return a fingerprint of the code that measures: its own sources and the library that decodes."""
    digest = hashlib.sha256(f"{cv2.__version__} {np.__version__}".encode())
    for _, source in sorted(sources_of(*MEASURING).items()):
        digest.update(source.encode())
    return digest.hexdigest()


def _targets(data: bytes) -> Targets:
    """Read targets back; ValueError or KeyError if they are not what was written."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > len(data):
            raise ValueError("entries are stored as they are, these are packed")
    with np.load(io.BytesIO(data), allow_pickle=False) as found:
        arrays = {f.name: found[f.name] for f in fields(Targets)}
    lengths = {
        kind: {len(a) for name, a in arrays.items() if name.startswith("rejected") == kind}
        for kind in (True, False)
    }
    if any(len(different) != 1 for different in lengths.values()):
        raise ValueError("arrays of different length")
    return Targets(**arrays)
