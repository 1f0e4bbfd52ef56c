"""Files that were compressed as a whole (.db3.zstd, .bag.gz, .pcd.xz), decompressed into the temporary folder."""

from __future__ import annotations

import bz2
import lzma
import shutil
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import expansion_limit
from aero_viz.recordings.bag_file import ZSTD_MAGIC, one_line

_BLOCK = 1 << 20
"""Bytes that are read at once."""
_STEP = 2048
"""Bytes that are decompressed at once: they expand to 64 MiB at most."""
_XZ_MEMORY = 256 << 20  # [bytes]


def decompress_file(path: Path, stack: ExitStack) -> tuple[Path, str]:
    """Decompress a file into a temporary folder that `stack` removes.

    At most half of the space that is free there is used.

    Returns:
        The new file, and its defect as a text that completes the sentence "FILE is ...", empty if it is whole.

    Raises:
        UserError: the content is damaged from the start, expands more than any recording, or does not fit.
    """
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="aero-viz-")))
    target = folder / path.with_suffix("").name
    with open_user_file(path) as source, target.open("wb") as sink:
        limit = expansion_limit(source.seek(0, 2))
        source.seek(0)
        space = shutil.disk_usage(folder).free // 2
        problem, written = "", 0
        for piece in _pieces(source):
            if isinstance(piece, str):
                problem = piece
                break
            written += len(piece)
            if written > limit:
                raise UserError(
                    f"{path} expands to more than {limit >> 20} MiB, which no recording of its size does: it is "
                    "damaged or hostile."
                )
            if written > space:
                raise UserError(
                    f"{path} expands to more than the {space >> 20} MiB that may be used in {folder.parent}: set "
                    f"TMPDIR to a larger folder, or decompress {path.name} and open the result."
                )
            sink.write(piece)
    if not written:
        raise UserError(
            f"{path} is {problem or 'empty inside'}, and nothing of it can be read: record or copy it again."
        )
    return target, problem and f"{problem}; only the data before the damage is used"


def _pieces(source: BinaryIO) -> Iterator[bytes | str]:
    """Yield the decompressed content in pieces, and at last its defect, if there is one."""
    start = source.read(max(map(len, COMPRESSED_MAGICS)))
    source.seek(0)
    make = next(make for magic, make in _DECOMPRESSORS.items() if start.startswith(magic))
    frame, is_open = make(), True
    while block := source.read(_BLOCK):
        for at in range(0, len(block), _STEP):
            data = block[at : at + _STEP]
            while data:
                if not is_open:
                    frame, is_open = make(), True
                try:
                    yield frame.decompress(data)
                except Exception as error:  # every library raises its own class
                    yield f"damaged ({one_line(error)})"
                    return
                is_open, data = not frame.eof, frame.unused_data if frame.eof else b""
    if is_open:
        yield "truncated"


def _zstd() -> Any:
    import zstandard

    return zstandard.ZstdDecompressor().decompressobj()


def _lz4() -> Any:
    import lz4.frame

    return lz4.frame.LZ4FrameDecompressor()


_DECOMPRESSORS: dict[bytes, Callable[[], Any]] = {
    ZSTD_MAGIC: _zstd,
    b"\x04\x22\x4d\x18": _lz4,
    b"\x1f\x8b\x08": lambda: zlib.decompressobj(16 + zlib.MAX_WBITS),
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ\0": lambda: lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY),
}
COMPRESSED_MAGICS = tuple(_DECOMPRESSORS)
"""Starts of zstd, LZ4, gzip, bzip2 and xz files."""
