"""Presets, undo and files: the configuration as a whole."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path

import viser

from aero_planner import PlannerConfig
from aero_planner.config.file import ConfigFile, format_config
from aero_planner.onboard.settings import OnboardConfig, format_onboard, load_flight_config
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame

__all__ = ["ConfigurationPanel", "differences", "parse_upload"]

_CHANGED = "(changed)"
_HISTORY_HINT = "undo and redo one change of the configuration; reset all returns to the default preset."


class ConfigurationPanel(Panel):
    """Presets, undo and redo, download and upload.

    The page does not use the settings of the drone's node, under `onboard:` in an uploaded file; a later download
    contains them unchanged.
    """

    def __init__(self, page: Page, controls: SessionControls) -> None:
        self._controls = controls
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._onboard = OnboardConfig()
        presets = PlannerConfig.presets()
        hint = " ".join(f"{name}: {help}" for name, help in presets.items())
        self._preset = gui.add_dropdown("Preset", (*presets, _CHANGED), initial_value=_CHANGED, hint=hint)
        self.differences = gui.add_html("")
        """Parameters that differ from the default preset, with their defaults and as flags."""
        steps = gui.add_button_group("History", ("undo", "redo", "reset all"), hint=_HISTORY_HINT)
        with gui.add_folder("File", expand_by_default=False):
            save = gui.add_button(
                "Download YAML", icon=viser.Icon.DOWNLOAD, color="gray", hint="Save the configuration as YAML."
            )
            load = gui.add_upload_button(
                "Upload YAML",
                icon=viser.Icon.UPLOAD,
                color="gray",
                mime_type=".yaml,.yml",
                hint="Use the configuration of a YAML file.",
            )

        @self._preset.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None and self._preset.value != _CHANGED:
                preset = PlannerConfig.preset(self._preset.value)
                self.page.attempt(lambda: self._controls.configure(preset), event.client)

        @steps.on_click
        async def _(event: viser.GuiEvent) -> None:
            actions = {
                "undo": self._controls.undo,
                "redo": self._controls.redo,
                "reset all": lambda: self._controls.configure(PlannerConfig()),
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
            file = load.value
            # A large file takes a while, and the event loop serves all pages.
            await asyncio.to_thread(self.page.attempt, lambda: self._load(file), event.client)

    def _load(self, file: viser.UploadedFile) -> None:
        config, onboard = parse_upload(file)
        self._controls.configure(config)
        self._onboard = onboard

    def update(self, frame: Frame) -> list[Change]:
        config = self.session.config
        presets = PlannerConfig.presets()
        name = next((name for name in presets if PlannerConfig.preset(name) == config), _CHANGED)
        return [(self._preset, "value", name), (self.differences, "content", differences(config))]


def differences(config: PlannerConfig) -> str:
    """Return what differs from the default preset as HTML: labels, old and new values, and the flags."""
    changed = PlannerConfig().differences(config)
    if not changed:
        return ""
    rows = [(PlannerConfig.find(path).title, f"{old} → {new}", path) for path, (old, new) in changed.items()]
    flags = " ".join(f"--{path.replace('_', '-')} {new}" for path, (_, new) in changed.items())
    heading = markup.heading("differs from the default", f"{len(changed)}")
    code = f'<code class="aero-flags" style="user-select:all;overflow-wrap:anywhere">{markup.text(flags)}</code>'
    return markup.block(heading, markup.table(rows), f"{markup.muted('as flags: ')}{code}")


def parse_upload(file: viser.UploadedFile) -> tuple[PlannerConfig, OnboardConfig]:
    """Return the planner's and the node's settings in a file that a browser sent.

    Raises:
        ValueError: the file is malformed or sets nothing; names the file as the user knows it.
    """
    name = Path(file.name).name or "upload.yaml"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(file.content)
        try:
            if not ConfigFile.read(path).entries:
                raise ValueError(f"{path} sets nothing; the configuration stays. Press 'reset all' for the default.")
            return load_flight_config(path)
        except ValueError as error:
            raise ValueError(str(error).replace(str(path), name)) from error
