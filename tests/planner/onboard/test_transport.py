import socket
from pathlib import Path

import pytest

from aero_planner.onboard.transport import open_transport


@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("tcp:1.2.3.4:5", "not understood"),
        ("udpin:14540", "no address and port"),
        ("udpin:h:99999", "no address and port"),
    ],
)
def test_invalid_urls(url: str, error: str):
    with pytest.raises(ValueError, match=error):
        open_transport(url)


def test_invalid_devices(tmp_path: Path):
    with pytest.raises(OSError, match="missing"):
        open_transport(str(tmp_path / "missing"))
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="not a serial device"):
        open_transport(str(tmp_path / "file"))
    with pytest.raises(ValueError, match="baud rate"):
        open_transport("/dev/null", baud=12345)


def test_a_port_in_use_is_an_error():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match="in use"):
            open_transport(f"udpin:127.0.0.1:{taken.getsockname()[1]}")
