"""Notifications while a source is being opened; a pipe stands in for a file that takes long to read."""

from __future__ import annotations

import os

import pytest
from small_source import small_source

if not hasattr(os, "mkfifo"):
    pytest.skip("named pipes need POSIX", allow_module_level=True)


def test_a_notification_stays_while_a_source_is_being_opened(fresh_desk, tmp_path):
    desk, path, whole = fresh_desk, tmp_path / "slow.json", tmp_path / "whole.json"
    os.mkfifo(path)
    world = small_source().info.world
    assert world is not None
    world.save(whole)
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    notification = desk.page.locator(".mantine-Notification-root", has_text=f"Opening {path}")
    notification.wait_for()
    desk.page.wait_for_timeout(1000)
    assert notification.is_visible()
    path.write_bytes(whole.read_bytes())
    desk.wait_for(lambda: desk.session.frame.source.name == "poles", "the world from the pipe")
    notification.wait_for(state="detached")
    assert desk.console == []
    assert desk.dashboard.failures == 0


def test_the_notification_disappears_if_a_source_cannot_be_opened(fresh_desk, tmp_path):
    desk, path = fresh_desk, tmp_path / "slow.json"
    os.mkfifo(path)
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    notification = desk.page.locator(".mantine-Notification-root", has_text=f"Opening {path}")
    notification.wait_for()
    path.write_text("{")
    desk.refusal("is not JSON").wait_for()
    notification.wait_for(state="detached")
