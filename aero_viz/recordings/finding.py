"""A finding on a recording."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A fault, or a property that the user should know of."""

    code: str
    """Short name, such as "time-offset"."""
    evidence: str
    """Evidence, one sentence without a full stop."""
    advice: str
    """The next step, an imperative without a full stop."""
    is_fault: bool = True
    """False if the playback handles it without help."""
