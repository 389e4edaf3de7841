"""COLMAP databases with Kolinear's image points: cameras, photographs, keypoints and matches.

A database has no object points. Matches between pairs of photographs state which keypoints show the same
point. A point is therefore written as matches between all photographs that show it, and read back as a
connected component of the graph of matches. Keypoints are single precision: 1e-4 px at 2000 px.

The file is not trusted. It is opened read-only and immutable, so nothing is written to it or beside it. Only
its tables are read: no views, virtual tables or computed columns, whose expressions could run for ever.

Source: COLMAP 4.2 documentation, "Database Format"; sqlite.org/fileformat.html, sec. 1.3, for the header, and
sqlite.org/security.html.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from adapters.colmap.adjuster import load_pycolmap, quiet, reason_of
from adapters.colmap.model_files import MAX_ID, MODELS
from adapters.colmap.reconstruction import HALF_PIXEL, as_opencv, camera_of, colmap_camera
from sfm.files.csv_tables import MAX_NUMBER, MAX_ROWS, MAX_TABLE_BYTES
from sfm.files.plain_text import MAX_NAME, MAX_SIDE_PX, as_plain, is_name
from sfm.files.whole_files import refuse_full, whole_file
from sfm.model.camera import Camera
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, empty_estimate, rows_of

TABLES = ("cameras", "images", "keypoints", "matches", "two_view_geometries")
HEADER_BYTES = 100
PAIRS = 2**31 - 1  # the number of a pair is PAIRS times the number of its first photograph plus its second's
MAX_STEPS, STEPS = 1000, 300_000  # SQLite instructions in one query: at most MAX_STEPS blocks of STEPS
MAX_PLACES = 100_000_000  # photographs times points, the size of a table in memory


def write_database(path: Path, network: Network, cameras: tuple[Camera, ...]) -> None:
    """Write photographs, image points and their matches as a COLMAP database, ready for its mapper.

    Args:
        path: file to write; it must not exist yet.
        network: the measured network; names of points are lost.
        cameras: interior orientations, in an opencv model.

    Raises:
        BackendError: pycolmap is missing, or COLMAP does not have the model of a camera.
        OutputError: the file exists or cannot be written.
    """
    pycolmap = load_pycolmap()
    if Path(path).exists():
        raise OutputError(f"{path}: a file of this name already exists")
    if len(network.images) * len(network.points) > MAX_PLACES:
        raise OutputError(
            f"{path}: {len(network.images)} photographs of {len(network.points)} points; a database is "
            f"written only if their product is at most {MAX_PLACES}"
        )
    with quiet(pycolmap), whole_file(path, "the database") as part:
        try:
            database = pycolmap.Database.open(str(part))
            _fill(pycolmap, database, network, cameras)
            database.close()
        except (RuntimeError, ValueError) as error:
            refuse_full(part.parent)
            raise OutputError(f"{path}: the database cannot be written: {reason_of(error)}") from error


def read_database(path: Path) -> tuple[Network, Estimate]:
    """Read cameras, photographs and image points of a COLMAP database, with points from its matches.

    Verified matches are used if there are any, otherwise the raw ones. Keypoints without a match are left
    out, and so are points that would appear twice in one photograph.

    Raises:
        BackendError: Kolinear has no equivalent of a camera model.
        SurveyFileError: the file is not a readable database.
    """
    rows = read_rows(path)
    first = np.concatenate([[0], np.cumsum([len(points) for points in rows.keypoints])]).astype(np.int64)
    edges = [(first[a] + matches[:, 0], first[b] + matches[:, 1]) for a, b, matches in rows.pairs]
    image = np.repeat(np.arange(len(rows.images)), np.diff(first))
    point = _tracks(edges, image)
    kept = np.flatnonzero(point >= 0)
    xy = np.concatenate([np.zeros((0, 2)), *rows.keypoints]) - HALF_PIXEL
    count = int(point.max(initial=-1)) + 1
    network = Network(
        rows.images,
        rows.camera,
        tuple(f"{j + 1}" for j in range(count)),
        ImagePoints(
            image[kept],
            point[kept],
            xy[kept],
            np.tile(np.eye(2), (len(kept), 1, 1)),
            np.zeros(len(kept), dtype=bool),
        ),
    )
    return network, empty_estimate(network, tuple(as_opencv(camera_of(camera)) for camera in rows.cameras))


def _fill(pycolmap: Any, database: Any, network: Network, cameras: tuple[Camera, ...]) -> None:
    """Fill a database; cameras and photographs are numbered from 1, and each photograph has a frame."""
    for k, camera in enumerate(cameras):
        written = colmap_camera(pycolmap, camera, k + 1)
        database.write_camera(written, True)
        rig = pycolmap.Rig(rig_id=k + 1)
        rig.add_ref_sensor(written.sensor_id)
        database.write_rig(rig, True)
    seen = network.image_points
    slot = np.empty(len(seen), dtype=np.int32)
    of_image = rows_of(seen.image, len(network.images))
    for i, name in enumerate(network.images):
        camera_id = int(network.camera[i]) + 1
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=i + 1)
        database.write_image(image, True)
        frame = pycolmap.Frame(frame_id=i + 1, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, True)
        rows = of_image[i]
        slot[rows] = np.arange(len(rows))
        xy = (seen.xy[rows] + HALF_PIXEL).astype(np.float32).reshape(-1, 2)
        database.write_keypoints(i + 1, xy)
    table = np.full((len(network.images), len(network.points)), -1, dtype=np.int32)
    table[seen.image, seen.point] = slot
    for a, b in combinations(range(len(network.images)), 2):
        common = np.flatnonzero((table[a] >= 0) & (table[b] >= 0))
        if len(common):
            matches = np.stack([table[a, common], table[b, common]], axis=1).astype(np.uint32)
            database.write_matches(a + 1, b + 1, matches)
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED, inlier_matches=matches
            )
            database.write_two_view_geometry(a + 1, b + 1, geometry)


def _tracks(edges: list[tuple[IntArray, IntArray]], image: IntArray) -> IntArray:
    """Return the number of the point that each keypoint shows, -1 for none, (k,)."""
    count = len(image)
    if not edges:
        return np.full(count, -1)
    a, b = (np.concatenate(side) for side in zip(*edges, strict=True))
    _, part = connected_components(
        coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False
    )
    size = np.bincount(part)
    twice = np.zeros(len(size), dtype=bool)
    order = np.lexsort((image, part))
    same = (part[order][1:] == part[order][:-1]) & (image[order][1:] == image[order][:-1])
    twice[part[order][1:][same]] = True
    good = (size[part] >= 2) & ~twice[part]
    # Points are numbered in the order in which they first appear.
    names, where = np.unique(part[good], return_index=True)
    rank = np.empty(len(size), dtype=np.int64)
    rank[names[np.argsort(where)]] = np.arange(len(names))
    return np.where(good, rank[part], -1)


@dataclass(frozen=True)
class DatabaseCamera:
    """A camera as COLMAP names its fields."""

    camera_id: int
    model_name: str
    width: int
    height: int
    params: FloatArray


@dataclass(frozen=True)
class DatabaseRows:
    """Everything that is read from a database."""

    cameras: tuple[DatabaseCamera, ...]  # by number
    images: tuple[str, ...]  # names by number, (m,)
    camera: IntArray  # index of the camera of each photograph, (m,)
    keypoints: tuple[FloatArray, ...]  # of each photograph, COLMAP's pixel frame, px, (k_i, 2)
    pairs: tuple[tuple[int, int, IntArray], ...]  # two photographs and their matching keypoints, (n, 2)


def read_rows(path: Path) -> DatabaseRows:
    """Read a database.

    Raises:
        SurveyFileError: not a complete COLMAP database, or a row that COLMAP does not write.
    """
    with _opened(path) as database:
        reader = _Reader(path, database)
        cameras = reader.cameras()
        numbers, images, owners = reader.images({camera.camera_id: k for k, camera in enumerate(cameras)})
        index = {number: i for i, number in enumerate(numbers)}
        keypoints = reader.keypoints(images, index)
        pairs = reader.matches("two_view_geometries", index, keypoints)
        if not any(len(matches) for _, _, matches in pairs):
            pairs = reader.matches("matches", index, keypoints)
    return DatabaseRows(cameras, images, owners, keypoints, pairs)


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a complete SQLite file with COLMAP's tables."""
    size = _refuse_other_files(path)
    try:
        database = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            database.text_factory = lambda text: text.decode("utf-8", "surrogateescape")
            left = iter(range(MAX_STEPS))
            database.set_progress_handler(lambda: next(left, None) is None, STEPS)
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, HEADER_BYTES))
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA ignore_check_constraints = ON")
            # no file without COLMAP's tables, or with views or virtual tables in their place
            kinds = dict(database.execute("SELECT name, type = 'table' AND rootpage > 0 FROM sqlite_master"))
            for name in TABLES:
                if name not in kinds:
                    raise SurveyFileError(
                        f"{path}: an SQLite file without the table {name}; a COLMAP database has "
                        f"{', '.join(TABLES)}"
                    )
                columns = database.execute(f"PRAGMA table_xinfo({name})").fetchall()
                if not kinds[name] or any(hidden for *_, hidden in columns):
                    raise SurveyFileError(f"{path}: {name} is computed, needed a table that contains it")
            damage = database.execute("PRAGMA quick_check(1)").fetchone()[0]
            if damage != "ok":
                raise SurveyFileError(f"{path}: the database is damaged, {_one_line(damage)}")
            yield database
        finally:
            database.close()
    except (sqlite3.Error, OverflowError) as error:
        raise SurveyFileError(f"{path}: not a readable COLMAP database, {_one_line(error)}") from error


def _refuse_other_files(path: Path) -> int:
    """Refuse a file that is not a complete SQLite file, and return its size."""
    try:
        if not path.is_file():
            raise SurveyFileError(f"{path}: there is no such file")
        with path.open("rb") as file:
            header = file.read(HEADER_BYTES)
        size = path.stat().st_size
        if size > MAX_TABLE_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_TABLE_BYTES} are read")
        for beside in (path.with_name(f"{path.name}{end}") for end in ("-wal", "-journal")):
            if beside.exists() and beside.stat().st_size:
                raise SurveyFileError(
                    f"{path}: changes to it are still in {beside.name}; close the program that writes it"
                )
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
    if header[:16] != b"SQLite format 3\0" or len(header) < HEADER_BYTES:
        raise SurveyFileError(f"{path}, line 1: not a COLMAP database (not an SQLite file)")
    page = int.from_bytes(header[16:18], "big")
    stated = (65536 if page == 1 else page) * int.from_bytes(header[28:32], "big")
    if size < stated:
        raise SurveyFileError(
            f"{path}: the file is cut off, it has {size} of the {stated} bytes stated in its header"
        )
    return size


class _Reader:
    """Reads the tables of an open database; an error names its table and row."""

    def __init__(self, path: Path, database: sqlite3.Connection) -> None:
        self.path, self.database = path, database

    def cameras(self) -> tuple[DatabaseCamera, ...]:
        """Return the cameras by number.

        Raises:
            SurveyFileError: an impossible size, or impossible parameters.
        """
        cameras, names = [], tuple(MODELS)
        for where, row in self._rows("cameras", "camera_id, model, width, height, params"):
            number = self._whole(where, "camera_id", row[0], MAX_ID)
            model = names[self._whole(where, "model", row[1], len(names) - 1)]
            width, height = row[2], row[3]
            if not all(isinstance(side, int) and 1 <= side <= MAX_SIDE_PX for side in (width, height)):
                raise SurveyFileError(
                    f"{self.path}: camera {number} has photographs of {_shown(width)} x {_shown(height)} px, "
                    f"needed 1 to {MAX_SIDE_PX} on each side"
                )
            params = self._array(where, row[4], "<f8", 1, MODELS[model]).ravel()
            if not ((np.abs(params) <= MAX_NUMBER).all() and params[0] > 0):
                raise self._error(where, "params are not the parameters of a camera")
            cameras.append(DatabaseCamera(number, model, width, height, params))
        return tuple(cameras)

    def images(self, camera: dict[int, int]) -> tuple[list[int], tuple[str, ...], IntArray]:
        """Return numbers and names of the photographs, and the index of the camera of each.

        Raises:
            SurveyFileError: a photograph of an unknown camera, or a name that is not plain text.
        """
        numbers, names, owners = [], [], []
        for where, (number, name, camera_id) in self._rows("images", "image_id, name, camera_id"):
            numbers.append(self._whole(where, "image_id", number, PAIRS))
            if not (isinstance(name, str) and is_name(name)):
                raise self._error(
                    where, f"name is '{_shown(name)}', needed plain text of 1 to {MAX_NAME} characters"
                )
            if camera_id not in camera:
                raise self._error(where, f"camera_id is {_shown(camera_id)}, there is no such camera")
            names.append(name)
            owners.append(camera[camera_id])
        return numbers, tuple(names), np.array(owners, dtype=np.int64)

    def keypoints(self, images: tuple[str, ...], index: dict[int, int]) -> tuple[FloatArray, ...]:
        """Return the keypoints of every photograph, empty for one without a row.

        Raises:
            SurveyFileError: keypoints of an unknown photograph, too many, or not finite.
        """
        keypoints: list[FloatArray] = [np.zeros((0, 2))] * len(images)
        count = 0
        for where, (number, rows, columns, data) in self._rows("keypoints", "image_id, rows, cols, data"):
            if number not in index:
                raise self._error(where, f"image_id is {_shown(number)}, there is no such photograph")
            if columns not in (2, 4, 6):
                raise self._error(where, f"cols is {_shown(columns)}, needed 2, 4 or 6")
            xy = self._array(where, data, "<f4", rows, columns)[:, :2].astype(float)
            count += len(xy)
            if count > MAX_ROWS:
                raise self._error(where, f"more than {MAX_ROWS} keypoints, no more are read")
            if not (np.abs(xy) <= MAX_NUMBER).all():
                raise SurveyFileError(
                    f"{self.path}: a keypoint of {images[index[number]]} is not a finite number of at most "
                    f"{MAX_NUMBER:g}"
                )
            keypoints[index[number]] = xy
        return tuple(keypoints)

    def matches(
        self, table: str, index: dict[int, int], keypoints: tuple[FloatArray, ...]
    ) -> tuple[tuple[int, int, IntArray], ...]:
        """Return the matches of every pair of photographs.

        Raises:
            SurveyFileError: a pair of unknown photographs, a missing keypoint, or too many matches.
        """
        pairs, count = [], 0
        for where, (number, rows, columns, data) in self._rows(table, "pair_id, rows, cols, data"):
            first, second = divmod(self._whole(where, "pair_id", number, PAIRS**2), PAIRS)
            if first not in index or second not in index:
                raise self._error(where, f"pair_id of photographs {first} and {second}, which are not there")
            if rows == 0:
                continue
            a, b = index[first], index[second]
            matches = self._array(where, data, "<u4", rows, 2 if columns == 2 else -1).astype(np.int64)
            count += len(matches)
            if count > MAX_ROWS:
                raise self._error(where, f"more than {MAX_ROWS} matches, no more are read")
            if (matches >= (len(keypoints[a]), len(keypoints[b]))).any():
                raise SurveyFileError(f"{self.path}: a match names a keypoint that is not there ({where})")
            pairs.append((a, b, matches))
        return tuple(pairs)

    def _rows(self, table: str, columns: str) -> Iterator[tuple[str, tuple[Any, ...]]]:
        """Yield the location and the content of each row, in the order of the first column."""
        rows = self.database.execute(f"SELECT {columns} FROM {table} ORDER BY 1")
        for count, row in enumerate(rows, 1):
            where = f"{table}, {columns.split(',')[0]} {_shown(row[0])}"
            if count > MAX_ROWS:
                raise self._error(where, f"more than {MAX_ROWS} rows, no more are read")
            yield where, row

    def _error(self, where: str, message: str) -> SurveyFileError:
        return SurveyFileError(f"{self.path}: {where}: {message}")

    def _whole(self, where: str, column: str, value: object, most: int) -> int:
        if not (isinstance(value, int) and 0 <= value <= most):
            raise self._error(where, f"{column} is {_shown(value)}, needed a whole number from 0 to {most}")
        return value

    def _array(self, where: str, data: object, kind: str, rows: object, columns: int) -> AnyArray:
        """Return the numbers of a blob, whose size must match the given rows and columns."""
        held = len(data) if isinstance(data, bytes) else 0
        due = rows * columns * np.dtype(kind).itemsize if isinstance(rows, int) and rows >= 0 else -1
        if held != due:
            raise self._error(where, f"{held} bytes of numbers do not match {_shown(rows)} rows")
        return np.frombuffer(data if isinstance(data, bytes) else b"", kind).reshape(-1, columns)


def _shown(value: object) -> str:
    """Return a value of a database in a form for messages."""
    return as_plain(str(value)[:MAX_NAME]) if isinstance(value, str) else f"{value!r:.40}"


def _one_line(error: object) -> str:
    return as_plain(" ".join(str(error).split())[:200])
