"""Files that rosbag2 compressed as a whole (.db3.zstd, .mcap.zstd), decompressed into the temporary folder."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import expansion_limit

_BLOCK = 1 << 20
"""Bytes that are read at once."""
_STEP = 2048
"""Bytes that are decompressed at once: they expand to 64 MiB at most."""


def decompress_file(path: Path, stack: ExitStack) -> tuple[Path, str]:
    """Decompress a zstd file into a temporary folder that `stack` removes.

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
                    "damaged or hostile"
                )
            if written > space:
                raise UserError(
                    f"{path} expands to more than the {space >> 20} MiB that may be used in {folder.parent}: set "
                    f"TMPDIR to a larger folder, or run `unzstd {path.name}` and open its result"
                )
            sink.write(piece)
    if not written:
        raise UserError(
            f"{path} is {problem or 'empty inside'}, and nothing of it can be read: record or copy it again"
        )
    return target, problem and f"{problem}; only what precedes the damage is used"


def _pieces(source: BinaryIO) -> Iterator[bytes | str]:
    """Yield the decompressed content in pieces, and at last its defect, if there is one."""
    import zstandard

    decompressor = zstandard.ZstdDecompressor()
    frame, is_open = decompressor.decompressobj(), True
    while block := source.read(_BLOCK):
        for at in range(0, len(block), _STEP):
            data = block[at : at + _STEP]
            while data:
                if not is_open:
                    frame, is_open = decompressor.decompressobj(), True
                try:
                    yield frame.decompress(data)
                except zstandard.ZstdError as error:
                    yield f"damaged ({error})"
                    return
                is_open, data = not frame.eof, frame.unused_data if frame.eof else b""
    if is_open:
        yield "truncated"
