"""The error that is reported to the user."""

from __future__ import annotations


class UserError(Exception):
    """A user's mistake or unreadable input. The message is one sentence: what is wrong, where, and what to do next.

    The command line prints it in one line and exits with code 2. The dashboard shows it as a notification.
    """
