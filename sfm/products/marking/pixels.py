"""Pixels of the photographs that are marked: for measuring, and as tiles for the page.

A photograph is decoded when it is first needed, and removed when memory is full. Small pictures come from a
JPEG that is decoded at an eighth of its size.

Source: the DZI format of Microsoft's Deep Zoom, which OpenSeadragon reads.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from threading import Lock
from typing import Generic, TypeVar

import cv2
import numpy as np

from sfm.model.conventions import AnyArray
from sfm.photographs.reading import read_for_display, read_photograph

TILE_PX, OVERLAP_PX, QUALITY = 510, 1, 88
SHRINKS = (8, 4, 2, 1)
GREY_BYTES, SHOWN_BYTES, TILE_BYTES = 1_500_000_000, 500_000_000, 100_000_000
K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Kept(Generic[K, V]):
    """Values that are made once and kept while memory lasts; threads may share it."""

    def __init__(self, make: Callable[[K], V], size: Callable[[V], int], most: int) -> None:
        """Start empty.

        Args:
            make: makes a value from its key.
            size: its size, bytes.
            most: of all kept values, bytes; the last one is always kept.
        """
        self._make, self._size, self._most = make, size, most
        self._values: OrderedDict[K, V] = OrderedDict()
        self._lock, self._making = Lock(), dict[K, Lock]()

    def __contains__(self, key: K) -> bool:
        with self._lock:
            return key in self._values

    @property
    def size(self) -> int:
        """Size of the kept values, bytes."""
        with self._lock:
            return sum(map(self._size, self._values.values()))

    def __getitem__(self, key: K) -> V:
        """Return a value, made by one thread while others that need it wait."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
            making = self._making.setdefault(key, Lock())
        with making:
            with self._lock:
                if key in self._values:
                    return self._values[key]
            value = self._make(key)
            with self._lock:
                self._values[key] = value
                self._making.pop(key, None)
                total = sum(map(self._size, self._values.values()))
                while total > self._most and len(self._values) > 1:
                    total -= self._size(self._values.popitem(last=False)[1])
            return value


class PhotographPixels:
    """The pixels of photographs, by their numbers."""

    def __init__(self, paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> None:
        """Take the files, without reading them.

        Args:
            paths: of the photographs.
            sizes: their widths and heights, px.
        """
        self._paths, self._sizes = tuple(paths), tuple(sizes)
        self._grey: Kept[int, AnyArray] = Kept(
            lambda i: read_photograph(self._paths[i]), lambda pixels: pixels.nbytes, GREY_BYTES
        )
        self._shown: Kept[tuple[int, int], AnyArray] = Kept(
            self._level, lambda pixels: pixels.nbytes, SHOWN_BYTES
        )
        self._tiles: Kept[tuple[int, int, int, int], bytes] = Kept(self._encode, len, TILE_BYTES)

    def grey(self, i: int) -> AnyArray:
        """Return the intensities of a photograph, (H, W), uint8 or uint16."""
        return self._grey[i]

    def is_decoded(self, i: int) -> bool:
        """Return whether the intensities of a photograph are in memory."""
        return i in self._grey

    @property
    def is_full(self) -> bool:
        """Whether another photograph would take the memory of one that is in it."""
        return self._grey.size > GREY_BYTES - max(map(math.prod, self._sizes))

    def descriptor(self, i: int) -> str:
        """Return the DZI descriptor of a photograph."""
        width, height = self._sizes[i]
        return (
            '<?xml version="1.0" encoding="UTF-8"?>'
            f'<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" Format="jpg" Overlap="{OVERLAP_PX}" '
            f'TileSize="{TILE_PX}"><Size Width="{width}" Height="{height}"/></Image>'
        )

    def tile(self, i: int, level: int, column: int, row: int) -> bytes | None:
        """Return a tile as JPEG; None if there is none at this place."""
        if not 0 <= i < len(self._sizes) or not 0 <= level <= self._highest(i):
            return None
        width, height = self._size_at(i, level)
        if not (0 <= column * TILE_PX < width and 0 <= row * TILE_PX < height):
            return None
        return self._tiles[i, level, column, row]

    def _highest(self, i: int) -> int:
        return int(np.ceil(np.log2(max(self._sizes[i]))))

    def _size_at(self, i: int, level: int) -> tuple[int, int]:
        divisor = 2 ** (self._highest(i) - level)
        width, height = self._sizes[i]
        return -(-width // divisor), -(-height // divisor)

    def _level(self, key: tuple[int, int]) -> AnyArray:
        """Return a photograph at a level, (h, w, 3); those below an eighth come from the one there."""
        i, level = key
        below = self._highest(i) - level
        size = self._size_at(i, level)
        if below > 3:
            return np.asarray(
                cv2.resize(self._shown[i, self._highest(i) - 3], size, interpolation=cv2.INTER_AREA)
            )
        pixels = read_for_display(self._paths[i], shrink=2**below)
        if pixels.shape[1::-1] != size:
            pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
        return pixels

    def _encode(self, key: tuple[int, int, int, int]) -> bytes:
        i, level, column, row = key
        left, top = max(column * TILE_PX - OVERLAP_PX, 0), max(row * TILE_PX - OVERLAP_PX, 0)
        right, bottom = (column + 1) * TILE_PX + OVERLAP_PX, (row + 1) * TILE_PX + OVERLAP_PX
        part = self._shown[i, level][top:bottom, left:right]
        _, data = cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        return bytes(data)
