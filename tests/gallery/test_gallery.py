"""Pictures of the page by one command."""

import subprocess
import sys

from PIL import Image


def gallery(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.gallery", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def test_a_view_becomes_a_picture_and_joins_the_page(browser, tmp_path):
    done = gallery("failure", "--folder", tmp_path)
    assert done.returncode == 0, done.stderr
    assert Image.open(tmp_path / "failure.png").size == (1280, 800)
    page = (tmp_path / "index.html").read_text()
    assert "failure.png" in page and "Why a flight failed" in page and "dashboard.png" not in page


def test_an_unknown_view_is_named_with_those_that_exist():
    done = gallery("failed")
    assert done.returncode == 2 and "there is no view failed; there are dashboard, top" in done.stderr
