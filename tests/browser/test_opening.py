"""What the page shows while a source is being opened: a pipe stands in for a file that takes long to read."""

from __future__ import annotations

import os

import pytest
from small_source import small_source

if not hasattr(os, "mkfifo"):
    pytest.skip("named pipes need POSIX", allow_module_level=True)


def test_the_page_tells_that_a_source_is_being_opened_until_it_is(fresh_desk, tmp_path):
    desk, path, whole = fresh_desk, tmp_path / "slow.json", tmp_path / "whole.json"
    os.mkfifo(path)
    world = small_source().info.world
    assert world is not None
    world.save(whole)
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    told = desk.page.locator(".mantine-Notification-root", has_text=f"Opening {path}")
    told.wait_for()
    desk.page.wait_for_timeout(1000)
    assert told.is_visible()
    path.write_bytes(whole.read_bytes())
    desk.wait_for(lambda: desk.session.frame.source.name == "poles", "the world from the pipe")
    told.wait_for(state="detached")
    assert desk.console == []
    assert desk.dashboard.failures == 0


def test_the_page_does_not_go_on_telling_of_a_source_that_cannot_be_opened(fresh_desk, tmp_path):
    desk, path = fresh_desk, tmp_path / "slow.json"
    os.mkfifo(path)
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    told = desk.page.locator(".mantine-Notification-root", has_text=f"Opening {path}")
    told.wait_for()
    path.write_text("{")
    desk.refusal("is not JSON").wait_for()
    told.wait_for(state="detached")
