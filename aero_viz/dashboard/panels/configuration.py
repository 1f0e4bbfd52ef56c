"""The configuration as a whole: presets, undo, files."""

from __future__ import annotations

import tempfile
from pathlib import Path

import viser

from aero_planner import PlannerConfig
from aero_planner.config.file import ConfigFile, format_config
from aero_planner.onboard.settings import OnboardConfig, format_onboard, load_flight_config
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame

__all__ = ["ConfigurationPanel"]

_OWN = "(changed)"


class ConfigurationPanel(Panel):
    """Presets, undo and redo, download and upload.

    Settings of the drone's node, under `onboard:` in an uploaded file, are not for the page; what is downloaded has
    them again.
    """

    def create(self, gui: viser.GuiApi) -> None:
        self._onboard = OnboardConfig()
        presets = PlannerConfig.presets()
        hint = " ".join(f"{name}: {help}" for name, help in presets.items())
        self._preset = gui.add_dropdown("Preset", (*presets, _OWN), initial_value=_OWN, hint=hint)
        steps = gui.add_button_group("History", ("undo", "redo", "reset all"))
        with gui.add_folder("File", expand_by_default=False):
            save = gui.add_button("Download YAML", icon=viser.Icon.DOWNLOAD, color="gray")
            load = gui.add_upload_button("Upload YAML", icon=viser.Icon.UPLOAD, color="gray", mime_type=".yaml,.yml")

        @self._preset.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None and self._preset.value != _OWN:
                self.page.attempt(
                    lambda: self.session.configure(PlannerConfig.preset(self._preset.value)), event.client
                )

        @steps.on_click
        async def _(event: viser.GuiEvent) -> None:
            actions = {
                "undo": self.session.undo,
                "redo": self.session.redo,
                "reset all": lambda: self.session.configure(PlannerConfig()),
            }
            self.page.attempt(actions[steps.value], event.client)

        @save.on_click
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                content = format_config(self.session.config)
                if self._onboard != OnboardConfig():
                    content += f"\n{format_onboard(self._onboard)}"
                event.client.send_file_download("aero-planner.yaml", content.encode(), save_immediately=True)

        @load.on_upload
        async def _(event: viser.GuiEvent) -> None:
            self.page.attempt(lambda: self._take(load.value), event.client)

    def _take(self, file: viser.UploadedFile) -> None:
        config, onboard = _uploaded(file)
        self.session.configure(config)
        self._onboard = onboard

    def update(self, frame: Frame) -> list[Change]:
        config = self.session.config
        presets = PlannerConfig.presets()
        name = next((name for name in presets if PlannerConfig.preset(name) == config), _OWN)
        return [(self._preset, "value", name)]


def _uploaded(file: viser.UploadedFile) -> tuple[PlannerConfig, OnboardConfig]:
    """Read a file that a browser sent, the planner's part and the node's; errors name it as the user does."""
    name = Path(file.name).name or "upload.yaml"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(file.content)
        try:
            if not ConfigFile.read(path).entries:
                raise ValueError(f"{path} sets nothing; the configuration stays. 'reset all' brings the default.")
            return load_flight_config(path)
        except ValueError as error:
            raise ValueError(str(error).replace(str(path), name)) from error
