"""Limits on what reading one file may cost, all in one place; docs/security.md sums them up.

Most of them grow with the size of the file, so that a long recording is read whole and a small file that claims or
expands to gigabytes is refused.
"""

from __future__ import annotations

import time

_MIB = 2**20

BLOCK_MAX = 256 * _MIB
"""Largest chunk or message after decompression [bytes]."""
EXPANSION_BASE = 64 * _MIB
"""A file may decompress to this [bytes] .."""
EXPANSION_RATIO = 100
""".. plus this many times its own size. Clouds compress two to ten times."""
TIME_BASE = 3.0
"""Reading a file may take this CPU time [s] .."""
TIME_PER_BYTE = 5.0 / _MIB
""".. plus this per byte of the file [s]. Small compressed poses, the slowest content, take a tenth of it."""
CHECKSUM_MAX = 4096 * _MIB
"""Bytes of uncompressed chunks whose checksums are verified while a file is opened, before any of it is played."""
METADATA_MAX = _MIB
"""Largest metadata.yaml [bytes]."""
SWEEP_POINTS_MAX = 10_000_000
"""Largest number of points in a cloud of a recording."""
TOPICS_MAX = 2000
"""Largest number of topics in a recording."""
NAME_MAX = 512
"""Longest name in a recording [characters]: topic and type, frame, field."""
TEXT_MAX = 64 * _MIB
"""Largest world or table in a text file [bytes]."""
DECODER_MEMORY_BASE = 1536 * _MIB
"""The process that decodes a map may take this address space [bytes] .."""
DECODER_MEMORY_RATIO = 40
""".. plus this many times the size of the file."""
MAP_POINTS_MAX = 40_000_000
"""Largest number of points in a map, and of faces in a mesh."""
MAP_VOXELS_MAX = 4_000_000
"""Largest number of occupied voxels of a map."""
MAP_CELLS_MAX = 25_000_000
"""Largest number of cells of the search for a start and a goal in a map."""
MAP_SPAN_MAX = 20_000.0
"""Largest extent of a map along any axis [m]."""
COORDINATE_MAX = 1e9
"""Largest distance of a map or a cloud from the origin of its coordinates [m]; farther away they lose millimetres."""
IMAGE_PIXELS_MAX = 25_000_000
"""Largest number of pixels of an occupancy image."""
SDF_DEPTH_MAX = 100
"""Deepest nesting of elements in a Gazebo world."""
SDF_SOLIDS_MAX = 200_000
"""Largest number of solids in a Gazebo world."""


class LimitExceeded(Exception):
    """Reading would cost more than the limits allow. The text completes the sentence "FILE is ..."."""


def expansion_limit(stored: int, share: float = 1.0) -> int:
    """Return the number of bytes to which `stored` bytes may decompress.

    Args:
        stored: size of the file [bytes].
        share: share of the fixed allowance, for one of several files of a recording.
    """
    return int(share * EXPANSION_BASE) + EXPANSION_RATIO * stored


class ReadingBudget:
    """Budget that is left for one pass over a file.

    Time is the CPU time of the calling thread: a busy machine does not cut a recording short.

    Args:
        stored: size of the file [bytes].
        share: share of the fixed allowances, for one of several files of a recording.
    """

    def __init__(self, stored: int, share: float = 1.0) -> None:
        self._bytes = expansion_limit(stored, share)
        self._seconds = share * TIME_BASE + TIME_PER_BYTE * stored
        self._wall_start, self._start = time.monotonic(), time.thread_time()

    def take_bytes(self, count: int) -> None:
        """Count bytes that are about to be decompressed. Raises LimitExceeded if they are too many."""
        self._bytes -= count
        if self._bytes < 0:
            raise LimitExceeded(
                f"compressed more than {EXPANSION_RATIO} times, as no recording is: only the part read so far is used"
            )

    @property
    def is_late(self) -> bool:
        """True if the time is up."""
        # CPU time costs a system call, and elapsed time, which is never less, does not.
        if time.monotonic() - self._wall_start <= self._seconds:
            return False
        return time.thread_time() - self._start > self._seconds

    def check_time(self) -> None:
        """Raise LimitExceeded if the time is up."""
        if self.is_late:
            raise LimitExceeded(
                f"too costly to read, more than {self._seconds:.0f} s for its size: only the part read so far is used"
            )
