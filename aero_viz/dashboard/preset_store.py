"""Presets that users save by name: files of the user's configuration folder, with the goal."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig, did_you_mean
from aero_planner.config.file import ConfigFile, format_config, format_goal, write_text
from aero_viz.errors import UserError
from aero_viz.planners.registry import name_of

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,39}(?<![ .])")
_FILES_MAX = 200
"""Largest number of saved presets: visitors of the page may not fill the disk."""


@dataclass(frozen=True)
class SavedPreset:
    """A preset in a file."""

    config: DroneConfig
    goal: tuple[float, float, float] | None
    """Goal x, y, z [m], world frame; None if none was saved."""


class PresetStore:
    """Saves presets as YAML files, which `--config` reads as well.

    Args:
        folder: folder of the files; None is presets/ in the user's configuration folder of AERO-Viz, by the XDG
            standard ~/.config/aero-viz.
        kind: class of the configurations; planners other than AERO-MPPI have folders of their own in that folder.
    """

    def __init__(self, folder: str | Path | None = None, kind: type[DroneConfig] = PlannerConfig) -> None:
        self._kind = kind
        home = os.environ.get("XDG_CONFIG_HOME", "")
        default = (Path(home) if os.path.isabs(home) else Path("~/.config").expanduser()) / "aero-viz" / "presets"
        own = "" if kind.planner == PlannerConfig.planner else re.sub(r"[^A-Za-z0-9_]", "-", name_of(kind))
        self.folder = (default if folder is None else Path(folder)) / own

    def names(self) -> list[str]:
        """Return the names of all presets in alphabetical order, whether they can be read or not."""
        try:
            found = [path.stem for path in self.folder.iterdir() if path.suffix == ".yaml"]
        except OSError:  # nothing was saved so far
            return []
        return sorted(name for name in found if _NAME.fullmatch(name) and name not in self._kind.presets())

    def load(self, name: str) -> SavedPreset:
        """Return a preset.

        Raises:
            ValueError: there is no preset of this name, or its file is damaged; the message names the file and the
                line.
        """
        file = ConfigFile.read(self._path(name))
        return SavedPreset(file.planner_config(self._kind), file.goal())

    def save(self, name: str, config: DroneConfig, goal: Sequence[float] | None) -> None:
        """Write a preset; one of the same name is replaced, as a whole or not at all.

        Raises:
            UserError: the name cannot be used, the file of this name is damaged and therefore left alone, or there are
                too many presets.
            ValueError: the file cannot be written.
        """
        path = self._path(name)
        if name not in self.names() and len(self.names()) >= _FILES_MAX:
            raise UserError(f"There are {_FILES_MAX} saved presets; delete one first.")
        if path.exists():
            try:
                self.load(name)
            except ValueError as error:
                raise UserError(f"{error} The file is left as it is; choose another name, or remove it.") from error
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"Cannot create {self.folder}: {error.strerror or error}.") from error
        text = format_config(config)
        write_text(text if goal is None else f"{text}\n{format_goal(goal)}", path)

    def delete(self, name: str) -> None:
        """Remove a preset.

        Raises:
            UserError: there is no preset of this name, or it cannot be removed.
        """
        path = self.path(name)
        try:
            path.unlink()
        except OSError as error:
            raise UserError(f"{path} cannot be removed: {error.strerror or error}.") from error

    def path(self, name: str) -> Path:
        """Return the file of a preset.

        Raises:
            UserError: there is no preset of this name; the message lists the existing ones.
        """
        path, names = self._path(name), self.names()
        if name not in names:
            saved = f"saved presets: {', '.join(names)}" if names else "none has been saved"
            raise UserError(f"There is no saved preset {name!r}{did_you_mean(name, names)}; {saved}.")
        return path

    def _path(self, name: str) -> Path:
        if name in self._kind.presets():
            raise UserError(f"{name!r} is the name of a built-in preset; choose another one.")
        if not _NAME.fullmatch(name):
            raise UserError(
                f"{name!r} cannot be the name of a preset; use up to 40 letters from A to Z, digits, spaces, periods, "
                "dashes and underscores, beginning with a letter or a digit."
            )
        return self.folder / f"{name}.yaml"
