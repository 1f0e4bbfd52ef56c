"""The folders whose files a page may open."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from aero_viz.errors import UserError

_FOLDERS_MAX = 10_000
"""Largest number of folders below one that is opened."""


class Folders:
    """Folders in which a page may open files, at any depth. The page learns of no other files.

    Args:
        folders: the folders; those that do not exist are left out.
    """

    def __init__(self, folders: Iterable[str | Path]) -> None:
        resolved = (Path(folder).expanduser().resolve() for folder in folders)
        self.paths = tuple(dict.fromkeys(path for path in resolved if path.is_dir()))
        """The folders, absolute and without symbolic links."""

    def find(self, name: str) -> Path:
        """Return the file or the folder with this path, absolute and without symbolic links.

        Args:
            name: path, absolute or relative to one of the folders or to the current directory.

        Raises:
            UserError: there is no such file in the folders. The message is the same for a file that exists elsewhere.
        """
        try:
            path = Path(name).expanduser()
            candidates = [path, *(folder / path for folder in self.paths)]
            found = next((place.resolve() for place in candidates if self._holds(place)), None)
        except (OSError, ValueError, RuntimeError):  # a name that no file can have
            found = None
        if found is None:
            folders = " or ".join(_short_names(self.paths))
            where = f"in {folders}, where this page may open files" if folders else "that this page may open"
            raise UserError(f"There is no file {name} {where}. Start aero-viz with --folder DIR to add a folder.")
        if not found.is_file() and not found.is_dir():
            raise UserError(f"{name} is neither a file nor a folder with a recording.")
        if found.is_dir() and not _may_be_recording(found):
            raise UserError(f"{name} is a folder without a recording.")
        return found

    def _holds(self, path: Path) -> bool:
        """Return True if a path exists within the folders, and so does all that links below it lead to."""
        resolved = path.resolve()
        if not resolved.exists() or not self._is_inside(resolved):
            return False
        waiting, seen = [resolved] if resolved.is_dir() else [], {resolved}
        while waiting:
            for entry in os.scandir(waiting.pop()):
                target = Path(entry.path).resolve() if entry.is_symlink() else Path(entry.path)
                if not self._is_inside(target) or len(seen) > _FOLDERS_MAX:
                    return False
                if entry.is_dir() and target not in seen:
                    waiting.append(target)
                    seen.add(target)
        return True

    def _is_inside(self, resolved: Path) -> bool:
        return any(resolved.is_relative_to(folder) for folder in self.paths)


def _short_names(paths: Sequence[Path]) -> list[str]:
    """Return the last parts of each path that tell it from the others; visitors need not know where they are."""
    names = []
    for path in paths:
        others = [other.parts for other in paths if other != path]
        parts = 1
        while parts < len(path.parts) and any(other[-parts:] == path.parts[-parts:] for other in others):
            parts += 1
        names.append("/".join(part.strip("/") for part in path.parts[-parts:]))
    return names


def _may_be_recording(folder: Path) -> bool:
    named = (file for file in folder.iterdir() if file.name == "metadata.yaml" or file.suffix in (".mcap", ".db3"))
    return any(file.is_file() for file in named)
