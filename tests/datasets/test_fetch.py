"""The downloads of datasets/fetch.py, from a server on this machine."""

import functools
import hashlib
import http.server
import importlib.util
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

CONTENT = b"points" * 50_000


@pytest.fixture
def fetch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The script, with one file, which a local server offers, and its own folder."""
    spec = importlib.util.spec_from_file_location("fetch", Path(__file__).parents[2] / "datasets" / "fetch.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    offered = tmp_path / "offered"
    offered.mkdir()
    (offered / "points.pcd").write_bytes(CONTENT)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(offered)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_address[1]}/points.pcd"
    file = module.PublicFile(url, len(CONTENT), hashlib.sha256(CONTENT).hexdigest(), "BSD", "points")
    monkeypatch.setattr(module, "FILES", {"points": file})
    monkeypatch.setattr(module, "FOLDER", tmp_path / "fetched")
    yield module
    server.shutdown()
    server.server_close()


def test_a_file_is_downloaded_once_and_checked(fetch: ModuleType, capsys: pytest.CaptureFixture[str]):
    path = fetch.FOLDER / "points.pcd"
    assert fetch.main(["points"]) == 0
    assert path.read_bytes() == CONTENT
    assert capsys.readouterr().out.strip() == str(path)
    fetch.FILES["points"] = fetch.FILES["points"]._replace(url="http://127.0.0.1:9/points.pcd")  # nobody answers
    assert fetch.main(["points"]) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sha256": "0" * 64}, "SHA-256"),
        ({"size": len(CONTENT) - 1}, f"instead of {len(CONTENT) - 1}"),
        ({"size": len(CONTENT) + 1}, f"has {len(CONTENT)} bytes instead of {len(CONTENT) + 1}"),
        ({"url": "http://127.0.0.1:9/points.pcd"}, "Check the network, or download it elsewhere, save it as"),
    ],
)
def test_a_wrong_file_or_no_network_leaves_nothing_behind(
    fetch: ModuleType, capsys: pytest.CaptureFixture[str], change: dict[str, object], message: str
):
    fetch.FILES["points"] = fetch.FILES["points"]._replace(**change)
    assert fetch.main(["points"]) == 2
    assert message in capsys.readouterr().err
    assert not list(fetch.FOLDER.iterdir())


def test_a_file_saved_by_hand_is_checked_and_kept(fetch: ModuleType, capsys: pytest.CaptureFixture[str]):
    fetch.FOLDER.mkdir()
    path = fetch.FOLDER / "points.pcd"
    path.write_bytes(b"cut")
    assert fetch.main(["points"]) == 2
    assert "remove it and run this again" in capsys.readouterr().err
    assert path.read_bytes() == b"cut"


def test_the_list_names_every_file_with_size_and_licence(fetch: ModuleType, capsys: pytest.CaptureFixture[str]):
    assert fetch.main([]) == 0
    assert capsys.readouterr().out.split() == ["points", "0.3", "MB", "BSD", "points"]
    assert fetch.main(["nothing"]) == 2
    assert "choose one of points" in capsys.readouterr().err
