"""Presets of the user on disk."""

import os
import stat

import pytest

from aero_planner import PlannerConfig
from aero_planner.config.file import load_config
from aero_viz.dashboard.preset_store import PresetStore
from aero_viz.errors import UserError

CONFIG = PlannerConfig().replace({"costs.q_track": 7.5, "candidates.previous": False})


@pytest.fixture
def store(tmp_path) -> PresetStore:
    return PresetStore(tmp_path / "presets")


def test_a_preset_is_there_again_with_its_goal(store):
    assert store.names() == []
    store.save("narrow gap v1.2", CONFIG, (40.0, -1e-7, 2.5))
    again = PresetStore(store.folder)
    assert again.names() == ["narrow gap v1.2"]
    saved = again.load("narrow gap v1.2")
    assert saved.config == CONFIG and saved.goal == (40.0, -1e-7, 2.5)
    assert load_config(store.folder / "narrow gap v1.2.yaml") == CONFIG, "--config reads it as well"
    store.save("narrow gap v1.2", PlannerConfig(), None)
    assert again.load("narrow gap v1.2").config == PlannerConfig() and again.load("narrow gap v1.2").goal is None
    again.delete("narrow gap v1.2")
    assert again.names() == [] and os.listdir(store.folder) == []


def test_the_folder_follows_the_xdg_standard(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert PresetStore().folder == tmp_path / "aero-viz" / "presets"
    monkeypatch.setenv("XDG_CONFIG_HOME", "relative")  # the standard: ignored
    monkeypatch.setenv("HOME", str(tmp_path))
    assert PresetStore().folder == tmp_path / ".config" / "aero-viz" / "presets"


@pytest.mark.parametrize(
    "name", ["", "../x", "a/b", ".hidden", "a" * 41, "x\n", "é", "end ", "end.", "paper", "(changed)"]
)
def test_a_name_that_cannot_be_used_is_refused(store, name):
    with pytest.raises(UserError, match="built-in preset" if name == "paper" else "letters from A to Z"):
        store.save(name, CONFIG, None)
    with pytest.raises(UserError, match="name"):
        store.delete(name)
    assert not store.folder.exists() or os.listdir(store.folder) == []


def test_a_preset_that_is_not_there_cannot_be_deleted(store):
    with pytest.raises(UserError, match=r"There is no saved preset 'room'; none has been saved\."):
        store.delete("room")
    store.save("rooms", CONFIG, None)
    with pytest.raises(UserError, match=r"no saved preset 'room' \(did you mean 'rooms'\?\); saved presets: rooms\."):
        store.delete("room")
    assert store.names() == ["rooms"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("costs: [1", "line 1"),
        ("costs:\n  q_trak: 3\n", "line 2"),
        ("goal:\n  x: 1.0\n  y: 2.0\n", "line 1.*three finite"),
        ("goal:\n  x: 1.0\n  y: far\n  z: 2.0\n", "line 1.*three finite"),
        ("\0", "bad.yaml"),
    ],
)
def test_a_damaged_file_is_named_and_left_alone(store, content, words):
    store.folder.mkdir()
    path = store.folder / "bad.yaml"
    path.write_text(content)
    assert store.names() == ["bad"]
    with pytest.raises(ValueError, match=f"(?s)bad.yaml.*{words}" if words != "bad.yaml" else words):
        store.load("bad")
    with pytest.raises(UserError, match="left as it is"):
        store.save("bad", CONFIG, None)
    assert path.read_text() == content


def test_a_folder_that_cannot_be_written_is_reported(store):
    store.folder.parent.joinpath("presets").write_text("a file")
    with pytest.raises((UserError, ValueError), match="presets"):
        store.save("mine", CONFIG, None)
    assert stat.S_ISREG(store.folder.stat().st_mode)
