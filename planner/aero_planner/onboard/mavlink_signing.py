"""Signatures of MAVLink 2: who does not know the key can neither command nor pose as the autopilot.

A signature has a link id, a time stamp in steps of 10 us since 2015, and six bytes of the SHA-256 of key and frame.
"""

from __future__ import annotations

import hashlib
import hmac
import time
from pathlib import Path

from aero_planner.onboard.signing_memory import SigningMemory, Stream
from aero_planner.user_file import read_user_text

_EPOCH = 1_420_070_400  # 2015-01-01 [s]
_RELEASED = 1_793_491_200  # 2026-11-01 [s]
_TICKS = 100_000  # per second
_KEY_FILE_MAX = 4096  # [bytes]
_MAX_DELAY = 60 * _TICKS  # by which the first time stamp of a stream may be late


def clock_is_set() -> bool:
    """Return False if this computer's date is before the release of this version, so that it must be wrong."""
    return time.time() >= _RELEASED


def signing_time() -> int:
    """Return the present time stamp of a signature, in steps of 10 us since 2015."""
    return max(0, int((time.time() - _EPOCH) * _TICKS))


def load_key(path: str | Path, named_by: str = "mavlink.signing_key_file") -> bytes:
    """Return the key in a file: 64 hexadecimal digits, or a passphrase, whose SHA-256 is the key as in ground stations.

    Args:
        path: The file.
        named_by: The setting or flag that names it, for errors.

    Raises:
        ValueError: The file can't be read, or is empty; says what to do.
    """
    try:
        text = read_user_text(Path(path).expanduser(), limit=_KEY_FILE_MAX).strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a text file"
        raise ValueError(f"can't read the key {path} ({named_by}): {reason}.") from error
    if not text:
        raise ValueError(f"the key {path} ({named_by}) is empty; write 64 hexadecimal digits or a passphrase.")
    if len(text) == 64:
        try:
            return bytes.fromhex(text)
        except ValueError:
            pass
    return hashlib.sha256(text.encode()).digest()


class SignatureChecker:
    """Checks the signatures of received frames.

    Args:
        key: The secret key, 32 bytes.
        memory: What was accepted before the start; None knows of nothing.

    Attributes:
        newest: Newest time stamp that was accepted, or the time at the start.
    """

    def __init__(self, key: bytes, memory: SigningMemory | None = None) -> None:
        self._key = key
        self._memory = memory
        self._streams: dict[Stream, int] = {} if memory is None else dict(memory.streams)
        self.newest = max(signing_time(), *self._streams.values(), 0)

    def accept(self, frame: bytes) -> bool:
        """Return True if a frame of MAVLink 2 has a valid signature that is newer than the last one of its stream.

        A stream that was never heard must begin within a minute of the present, so it can't while the date is not set.
        """
        if frame[0] != 0xFD or not frame[2] & 1:
            return False
        expected = hashlib.sha256(self._key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(expected, frame[-6:]):
            return False
        # Only a valid signature moves the time on: otherwise a forged frame from the future would lock its stream.
        stamp, stream = int.from_bytes(frame[-12:-6], "little"), (frame[-13], frame[5], frame[6])
        if stream not in self._streams and not clock_is_set():
            return False
        is_new = stamp > self._streams.get(stream, max(self.newest, signing_time()) - _MAX_DELAY)
        if is_new:
            self._streams[stream] = stamp
            self.newest = max(self.newest, stamp)
            if self._memory is not None:
                self._memory.keep(self._streams, stream)
        return is_new

    def close(self) -> None:
        """Keep what was accepted for the next start."""
        if self._memory is not None:
            self._memory.close(self._streams)
