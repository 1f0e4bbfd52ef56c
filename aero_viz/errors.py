"""The one error that is meant for the user's eyes."""

from __future__ import annotations

__all__ = ["UserError"]


class UserError(Exception):
    """A user's mistake or unreadable input, as one sentence: what was wrong, where, and what to do next.

    The command line prints it on one line and exits with code 2; the dashboard shows it as a notification.
    """
