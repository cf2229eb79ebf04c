"""The sweeps of a recording, on disk until the boxes of all tracks are known."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
import pickle
from tempfile import TemporaryFile
from typing import NamedTuple

from boxreg_ros.io.fixed_frame import FixedFrameItems, StoredCloud
from boxreg_ros.io.items import Item
from boxreg_ros.structures import Floats, Sweep
import numpy as np

ALIGNMENT = 16
"""Of arrays in the file [bytes]: numpy and compiled kernels are slower without."""


class MergedCloud(NamedTuple):
    """A cloud that a sweep was merged from."""

    topic: str  # empty if there is only one topic of clouds
    stamp_ns: int
    rows: slice  # its points in the sweep
    R_fixed_cloud: Floats  # (3, 3) the identity where unknown


class StoredSweep(NamedTuple):
    """A sweep of the recording."""

    sweep: Sweep | None  # in the fixed frame; None where no transform is known
    cloud: StoredCloud | None  # the same for label files; None unless asked for


class StoredPlace(NamedTuple):
    """Where a sweep is in the file, and the clouds that it was merged from."""

    first_byte: int
    sizes: list[int]  # bytes of its arrays, and of their description; starts are aligned
    parts: tuple[MergedCloud, ...]


class StoredSweeps:
    """
    Sweeps in a temporary file: written by the process that reads, then read by the other.

    It lies in `folder`, without a name, or among the temporary files; with clouds, it has the
    sweeps for label files, too. `places` are in the order of reading; the process that reads them
    hands them over.

    """

    def __init__(self, folder: Path | None, with_clouds: bool) -> None:
        self._file = TemporaryFile(dir=folder)  # noqa: SIM115  closed with the object
        self.with_clouds = with_clouds
        self.places: list[StoredPlace] = []

    def add(self, item: Item, items: FixedFrameItems, sensor_frame: str) -> None:
        """Store a sweep of `items`; label files have merged ones in `sensor_frame`."""
        cloud = items.stored_cloud(item, sensor_frame) if self.with_clouds else None
        moved = item.moved if isinstance(item.moved, Sweep) else None
        parts = tuple(_parts(item, items))
        arrays: list[pickle.PickleBuffer] = []
        # The arrays are written as they are, without copies of them.
        described = pickle.dumps(StoredSweep(moved, cloud), 5, buffer_callback=arrays.append)
        blocks = [*(array.raw() for array in arrays), memoryview(described)]
        first_byte = self._file.tell()
        for block in blocks:
            self._file.write(block)
            self._file.write(bytes(-block.nbytes % ALIGNMENT))
        self.places.append(StoredPlace(first_byte, [block.nbytes for block in blocks], parts))

    def complete(self) -> list[StoredPlace]:
        """Write what waits; return the places."""
        self._file.flush()
        return self.places

    def __iter__(self) -> Iterator[StoredSweep]:
        """Yield all sweeps."""
        yield from map(self.__getitem__, range(len(self.places)))

    def __getitem__(self, number: int, /) -> StoredSweep:
        """Return a sweep."""
        first_byte, sizes, _ = self.places[number]
        *starts, end = accumulate((size + -size % ALIGNMENT for size in sizes), initial=0)
        content = memoryview(bytearray(end))
        self._file.seek(first_byte)
        self._file.readinto(content)
        blocks = [content[a : a + size] for a, size in zip(starts, sizes, strict=True)]
        stored: StoredSweep = pickle.loads(blocks[-1], buffers=blocks[:-1])
        return stored


def _parts(item: Item, items: FixedFrameItems) -> Iterator[MergedCloud]:
    """Yield the clouds that an item was merged from."""
    first = 0
    for part in item.parts or (item,):
        cloud = part.content
        assert isinstance(cloud, Sweep)
        rows = slice(first, first + len(cloud.points))
        first = rows.stop
        T = item.T_fixed_item
        if len(item.parts) > 1:
            T = items.pose_of(cloud.frame_id, cloud.stamp_ns)
        yield MergedCloud(cloud.topic, cloud.stamp_ns, rows, np.eye(3) if T is None else T[:3, :3])
