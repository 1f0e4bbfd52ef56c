"""Presets, undo and files: the configuration as a whole."""

from __future__ import annotations

import asyncio
import shlex
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import viser

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig
from aero_planner.config.file import ConfigFile, format_changes, format_config
from aero_planner.onboard.flight_config import format_onboard, load_flight_config
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import TYPING_DELAY, Page, Panel
from aero_viz.dashboard.preset_store import PresetStore
from aero_viz.dashboard.server import notify
from aero_viz.flight.known_drone import config_without_facts
from aero_viz.planners.registry import name_of
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame

_CHANGED = "(changed)"
_HISTORY_HINT = "undo and redo one change of a parameter or an obstacle; reset all returns to the preset."
_COPY = (
    "getSelection().selectAllChildren(this.nextElementSibling);document.execCommand('copy');this.textContent='copied'"
)
"""Script of a button that copies the text of the next element; the clipboard's own interface needs HTTPS."""


@dataclass
class Baseline:
    """Preset that the page compares the configuration with: the one that was chosen last.

    What the planner knows about a flight, see `config_for_flight`, does not count as a difference from a preset.
    """

    name: str
    config: DroneConfig

    @classmethod
    def from_config(cls, config: DroneConfig) -> Baseline:
        """Return the preset that equals `config`, or the default."""
        name = config.preset_name if config.preset_name in config.presets() else "default"
        return cls(name, config.preset(name))


class ConfigurationPanel(Panel):
    """Presets, undo and redo, download and upload.

    The page does not use the settings of the drone's node, under `onboard:` in an uploaded file; a later download
    contains them unchanged.

    Args:
        page: page of the panel.
        controls: commands of the session.
        baseline: the preset that was chosen last; this panel changes it.
        store: presets of the user; None are those in the user's configuration folder.
    """

    def __init__(
        self, page: Page, controls: SessionControls, baseline: Baseline, store: PresetStore | None = None
    ) -> None:
        self._controls = controls
        self._baseline = baseline
        self._store = store or PresetStore(kind=type(page.session.config))
        self._saved = self._store.names()
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._onboard = OnboardConfig()
        self._shown: tuple[object, ...] = (None,) * 5
        self._changes: list[Change] = []
        hint = " ".join(f"{name}: {help}" for name, help in self.session.config.presets().items())
        self._preset = gui.add_dropdown("Preset", self._names(), initial_value=_CHANGED, hint=hint)
        self.differences = gui.add_html("")
        """Parameters that differ from the preset, as flags and as YAML."""
        steps = gui.add_button_group("History", ("undo", "redo", "reset all"), hint=_HISTORY_HINT)
        with gui.add_folder("Save as a preset", expand_by_default=False):
            self._create_saving(gui)
        with gui.add_folder("File", expand_by_default=False):
            self._create_files(gui)

        @self._preset.on_update
        async def _(event: viser.GuiEvent) -> None:
            if (client := event.client) is not None and self._preset.value != _CHANGED:
                name = self._preset.value
                self.page.attempt(lambda: self._choose(name, client), client)

        @steps.on_click
        async def _(event: viser.GuiEvent) -> None:
            actions = {
                "undo": self._controls.undo,
                "redo": self._controls.redo,
                "reset all": lambda: self._controls.configure(self.page.config_for_flight(self._baseline.config)),
            }
            self.page.attempt(actions[steps.value], event.client)

    def _create_saving(self, gui: viser.GuiApi) -> None:
        hint = f"Name of the preset, which is kept with the goal in {self._store.folder}."
        with gui.add_form(None) as form:
            name = gui.add_text("Name", "", hint=hint)
        save = gui.add_button("Save preset", icon=viser.Icon.DEVICE_FLOPPY, color="gray")
        hint = "Delete the saved preset of this name."
        delete = gui.add_button("Delete preset", icon=viser.Icon.TRASH, color="gray", hint=hint)

        async def save_it(event: viser.GuiEvent) -> None:
            await asyncio.sleep(TYPING_DELAY)
            if (client := event.client) is not None:
                self.page.attempt(lambda: self._save_or_ask(name.value.strip(), client), client)

        form.on_submit(save_it)
        save.on_click(save_it)

        @delete.on_click
        async def _(event: viser.GuiEvent) -> None:
            await asyncio.sleep(TYPING_DELAY)
            if (client := event.client) is not None:
                self.page.attempt(lambda: self._ask_to_delete(name.value.strip(), client), client)

    def _create_files(self, gui: viser.GuiApi) -> None:
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

        @save.on_click
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                content = format_config(self._config())
                if self._onboard != OnboardConfig():
                    content += f"\n{format_onboard(self._onboard)}"
                event.client.send_file_download("aero-planner.yaml", content.encode(), save_immediately=True)

        @load.on_upload
        async def _(event: viser.GuiEvent) -> None:
            file = load.value
            # A large file takes a while, and the event loop serves all pages.
            is_used = await asyncio.to_thread(self.page.attempt, lambda: self._load(file), event.client)
            if not is_used and event.client is not None:
                self.page.server.hide_upload(event.client)

    def _names(self) -> tuple[str, ...]:
        return (*self.session.config.presets(), *self._saved, _CHANGED)

    def _choose(self, name: str, client: viser.ClientHandle) -> None:
        """Use a preset, and ask whether to move the goal if it was saved with another one."""
        goal = None
        if name in self.session.config.presets():
            config = self.session.config.preset(name)
        else:
            saved = self._store.load(name)
            config, goal = saved.config, saved.goal
        self._baseline.name, self._baseline.config = name, config
        self._controls.configure(self.page.config_for_flight(self._baseline.config))
        frame = self.session.frame
        if goal is not None and frame is not None and not np.allclose(goal, frame.observation.goal.position, atol=1e-3):
            self._ask_to_move(name, goal, client)

    def _ask_to_move(self, name: str, goal: tuple[float, float, float], client: viser.ClientHandle) -> None:
        place = ", ".join(f"{x:.1f}" for x in goal)
        self.page.ask(
            client,
            "Move the goal, too?",
            markup.block(markup.text(f"The preset {name} was saved with the goal at ({place}) m.")),
            yes="Move the goal",
            no="Keep the goal",
            action=lambda: self._controls.set_goal(goal),  # if it cannot be flown to here, the session says so
        )

    def _save_or_ask(self, name: str, client: viser.ClientHandle) -> None:
        """Save a preset, after a question if it replaces another one."""
        if name not in self._store.names():
            self._save(name, client)
            return
        self.page.ask(
            client,
            "Replace this preset?",
            markup.block(f"<b>{markup.text(name)}</b>", markup.text(str(self._store.path(name)))),
            yes="Replace",
            no="Keep it",
            action=lambda: self._save(name, client),
        )

    def _save(self, name: str, client: viser.ClientHandle) -> None:
        config, frame = self._config(), self.session.frame
        self._store.save(name, config, None if frame is None else np.asarray(frame.observation.goal.position).tolist())
        notify(self.page.server, f"The preset {name!r} was saved.", client=client)
        self._saved = self._store.names()
        self._baseline.name, self._baseline.config = name, config

    def _ask_to_delete(self, name: str, client: viser.ClientHandle) -> None:
        self.page.ask(
            client,
            "Delete this preset?",
            markup.block(f"<b>{markup.text(name)}</b>", markup.text(str(self._store.path(name)))),
            yes="Delete",
            no="Keep it",
            action=lambda: self._delete(name, client),
        )

    def _delete(self, name: str, client: viser.ClientHandle) -> None:
        self._store.delete(name)
        notify(self.page.server, f"The preset {name!r} was deleted.", client=client)
        self._saved = self._store.names()
        if self._baseline.name == name:
            self._baseline.name, self._baseline.config = "default", type(self.session.config)()

    def _load(self, file: viser.UploadedFile) -> None:
        config, onboard = parse_upload(file, type(self.session.config))
        self._controls.configure(self.page.config_for_flight(config))
        self._onboard = onboard

    def _config(self) -> DroneConfig:
        """Return the configuration without the facts of this flight, which do not apply to another one."""
        frame = self.session.frame
        return self.session.config if frame is None else config_without_facts(self.session.config, frame.source)

    def update(self, frame: Frame) -> list[Change]:
        shown = (self.session.config, self._baseline.config, self._baseline.name, self._saved, frame.source)
        if any(new is not old for new, old in zip(shown, self._shown, strict=True)):
            self._shown, self._changes = shown, self._show(self._config(), self._baseline)
        return self._changes

    def _show(self, config: DroneConfig, baseline: Baseline) -> list[Change]:
        names = self._names()
        name = config.preset_name if config.preset_name in config.presets() else _CHANGED
        if baseline.config == config and baseline.name in names:
            name = baseline.name
        return [
            (self._preset, "options", names),
            (self._preset, "value", name),
            (self.differences, "content", differences(config, baseline)),
        ]


def differences(config: DroneConfig, baseline: Baseline) -> str:
    """Return the differences from a preset as HTML: labels, old and new values, and the text of flags and of a file."""
    changed = baseline.config.differences(config)
    if not changed:
        return ""
    rows = [(config.find(path).title, f"{old} → {new}", path) for path, (old, new) in changed.items()]
    heading = markup.heading(f"differs from {baseline.name}", f"{len(changed)}")
    start = Baseline.from_config(baseline.config)  # what the program knows by its name; a saved preset is written out
    return markup.block(
        heading,
        markup.table(rows),
        _copyable("flags", _flags(config, start)),
        _copyable("yaml", format_changes(config, preset=start.name)),
    )


def _flags(config: DroneConfig, start: Baseline) -> str:
    base = [] if config.planner == PlannerConfig.planner else ["--planner", name_of(config)]
    base += [] if start.name == "default" else ["--config", start.name]
    changed = start.config.differences(config)
    changes = [word for path, (_, new) in changed.items() for word in (f"--{path.replace('_', '-')}", str(new))]
    return shlex.join([*base, *changes])


def _copyable(name: str, text: str) -> str:
    """Return a button that copies a text, and the text."""
    button = f'<button type="button" class="aero-copy" onclick="{markup.text(_COPY)}">copy {name}</button>'
    style = "user-select:all;overflow-wrap:anywhere;white-space:pre-wrap;display:block;max-height:7em;overflow:auto"
    return f'{button}<code class="aero-{name}" style="{style}">{markup.text(text)}</code>'


def parse_upload(
    file: viser.UploadedFile, kind: type[DroneConfig] = PlannerConfig
) -> tuple[DroneConfig, OnboardConfig]:
    """Return the planner's and the node's settings in a file that a browser sent, for the planner of `kind`.

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
            if kind is PlannerConfig:
                return load_flight_config(path)
            return ConfigFile.read(path).planner_config(kind), OnboardConfig()
        except ValueError as error:
            raise ValueError(str(error).replace(str(path), name)) from error
