"""The store of measurements in photographs, and of matches between them, so that none is made twice.

It is in the user's cache folder, never beside photographs or results, which may come from somebody else. The
key of an entry depends on the content of the photograph, the settings and the measuring code. An entry can
therefore be missing or unreadable, but never out of date. The folder may be removed at any time.
"""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from sfm.files.user_cache import make_user_folder, remove_unused, user_folder
from sfm.files.whole_files import whole_file
from sfm.matching.tracks.interest import NaturalPoints
from sfm.matching.tracks.matched_pairs import LIBRARIES, MatchTable
from sfm.model.errors import OutputError, PhotographError
from sfm.runtime.compiling import code_version
from sfm.runtime.memory import open_files
from sfm.targets.detect import Targets

Measured = Targets | NaturalPoints | MatchTable
M = TypeVar("M", Targets, NaturalPoints, MatchTable)
MAX_ENTRY_BYTES = 100_000_000  # 400,000 targets, 180,000 features; checked before any memory is allocated


@dataclass(frozen=True)
class Kind(Generic[M]):
    """Kind of measurements of a single photograph that can be stored: named arrays."""

    type: type[M]
    measuring: tuple[str, ...]  # modules that measure; the result depends on these and all their imports
    apart: str  # prefix of the arrays that share another length; all others share one length
    mapped: str = ""  # array with a file of its own, which is read when it is used and takes no memory before


TARGETS = Kind(Targets, ("sfm.photographs.reading", "sfm.targets.detect"), "rejected")
TEXTURE = Kind(
    NaturalPoints, ("sfm.photographs.reading", "sfm.matching.tracks.interest"), "corners", "descriptor"
)
MATCHES = Kind(MatchTable, ("sfm.matching.tracks.matched_pairs",), "pair_")
KINDS: tuple[Kind[Any], ...] = (TARGETS, TEXTURE, MATCHES)


@dataclass(frozen=True)
class MeasuredStore:
    """Measurements of this run, and a folder of those of earlier ones, which belongs to the user alone."""

    folder: Path | None  # None: measurements are held for this run alone
    held: dict[str, tuple[Measured, bool]] = field(default_factory=dict)
    """measurements of this run by their keys, each with whether it was read from the folder"""

    @classmethod
    def of_user(cls) -> MeasuredStore:
        """Return the store in the user's cache folder (XDG_CACHE_HOME), which is created when needed.

        Raises:
            OutputError: other users can write into the folder.
        """
        return cls(user_folder("measured", "measured points"))

    @property
    def has_earlier(self) -> bool:
        """Whether measurements of this run were read from the folder."""
        return any(stored for _, stored in self.held.values())

    def begin(self) -> None:
        """Be told that something is measured, which is not stored."""

    def load(self, key: str, kind: Kind[M]) -> M | None:
        """Return the measurements under a key; None if they are missing or incomplete."""
        if self.folder is None:
            return None
        try:
            path = self._path(self.folder, key)
            if path.stat().st_size > MAX_ENTRY_BYTES:
                return None
            data = path.read_bytes()
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                if sum(entry.file_size for entry in archive.infolist()) > len(data):
                    raise ValueError("entries are stored as they are, these are packed")
            with np.load(io.BytesIO(data), allow_pickle=False) as stored:
                arrays = {f.name: stored[f.name] for f in fields(kind.type) if f.name != kind.mapped}
            if kind.mapped:
                # each mapped file stays open; those beyond what the system allows are read into memory
                mode: Literal["c"] | None = "c" if len(self.held) < open_files() // 2 else None
                mapped = np.load(path.with_suffix(".npy"), mmap_mode=mode, allow_pickle=False)
                arrays[kind.mapped] = mapped.view(np.ndarray)
                os.utime(path.with_suffix(".npy"))
            for apart in (True, False):
                if len({len(a) for name, a in arrays.items() if name.startswith(kind.apart) == apart}) != 1:
                    raise ValueError("arrays of different length")
            measured = kind.type(**arrays)
            os.utime(path)  # marks it as used now
            return measured
        except (OSError, ValueError, TypeError, EOFError, KeyError, MemoryError, zipfile.BadZipFile):
            return None

    def save(self, key: str, measured: Measured) -> None:
        """Store measurements completely or not at all; without room on the disk they are not stored."""
        if self.folder is None:
            return
        arrays = {f.name: getattr(measured, f.name) for f in fields(measured)}
        kind = next(kind for kind in KINDS if isinstance(measured, kind.type))
        mapped, data = arrays.pop(kind.mapped, None), io.BytesIO()
        np.savez(data, allow_pickle=False, **arrays)
        if data.tell() > MAX_ENTRY_BYTES:  # `load` would not read it
            return
        path = self._path(self.folder, key)
        with suppress(OSError, OutputError):
            make_user_folder(self.folder)
            if mapped is not None:
                with whole_file(path.with_suffix(".npy"), replaces=True) as part:
                    np.save(part, mapped, allow_pickle=False)
            with whole_file(path, replaces=True) as part:
                part.write_bytes(data.getbuffer())

    def adopt(self, held: dict[str, tuple[Measured, bool]]) -> None:
        """Hold what another process measured, and store it unless it is there.

        Args:
            held: measurements by their keys, as they are held there.
        """
        for key, (measured, stored) in held.items():
            kind = next(kind for kind in KINDS if isinstance(measured, kind.type))
            kept = self.load(key, kind)
            if kept is None:
                self.save(key, measured)
                kept = self.load(key, kind) if kind.mapped else None
            self.held[key] = (measured if kept is None else kept), stored

    def remove_old(self) -> None:
        """Remove entries not used for months, and half-written files of a killed run."""
        if self.folder is not None:
            remove_unused(self.folder)

    @staticmethod
    def _path(folder: Path, key: str) -> Path:
        return folder / key[:2] / f"{key}.npz"


def measured_once(
    store: MeasuredStore | None, path: Path, kind: Kind[M], settings: str, measure: Callable[[], M]
) -> tuple[M, bool]:
    """Return the measurements of a photograph, and whether they were read from the store.

    Args:
        store: is searched first, and stores new measurements; None to measure in any case.
        path: the photograph.
        kind: kind of measurements.
        settings: everything else that the measurements depend on, as any unambiguous text.
        measure: measures the photograph.

    Raises:
        PhotographError: the photograph cannot be read.
    """
    if store is None:
        return measure(), False
    key = measured_key(path, kind, settings)
    if key not in store.held and (kept := store.load(key, kind)) is not None:
        store.held[key] = kept, True
    if key in store.held:
        known, stored = store.held[key]
        if isinstance(known, kind.type):
            return known, stored
    store.begin()
    measured = measure()
    store.save(key, measured)
    if kind.mapped:
        measured = store.load(key, kind) or measured
    store.held[key] = measured, False
    return measured, False


@dataclass(frozen=True)
class StoredMatches:
    """The matches of photographs in a store."""

    store: MeasuredStore

    def load(self, fingerprint: str, *, seed: int) -> MatchTable | None:
        """Return the matches of a photograph, see `MatchStore.load`."""
        return self.store.load(self._key(fingerprint, seed), MATCHES)

    def save(self, fingerprint: str, table: MatchTable, *, seed: int) -> None:
        """Keep the matches of a photograph, see `MatchStore.save`."""
        self.store.save(self._key(fingerprint, seed), table)

    @staticmethod
    def _key(fingerprint: str, seed: int) -> str:
        parts = (fingerprint, str(seed), code_version(LIBRARIES, *MATCHES.measuring))
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def measured_key(path: Path, kind: Kind[M], settings: str) -> str:
    """Return the key of the measurements of a photograph: a SHA-256 of everything they depend on.

    Args:
        path: the photograph.
        kind: kind of measurements.
        settings: settings of the measurement, as any unambiguous text.

    Raises:
        PhotographError: the photograph cannot be read.
    """
    parts = (content_hash(path), settings, code_version(LIBRARIES, *kind.measuring))
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
