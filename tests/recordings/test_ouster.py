"""Captures of an Ouster, written by ouster-sdk in another process, because it changes modules of its own."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from captures import write_frames, write_ouster, write_pcap, write_two_ousters
from command_line import run_json, run_refused

from aero_viz.errors import UserError
from aero_viz.reader_process import ReaderProcess
from aero_viz.recordings import inspect, open_recording
from aero_viz.recordings.imu import read_imu
from aero_viz.recordings.pcap import udp_payloads
from aero_viz.recordings.storage import open_storage

needs_sdk = pytest.mark.skipif(importlib.util.find_spec("ouster") is None, reason="ouster-sdk is not installed")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of the captures, without suffix."""
    path = tmp_path_factory.mktemp("ouster") / "hall"
    ReaderProcess()(write_ouster, path)
    return path


@pytest.fixture
def capture(written: Path, tmp_path: Path) -> Path:
    """Return a copy of the .pcap; .json and .osf are beside it."""
    for suffix in (".pcap", ".json", ".osf"):
        (tmp_path / f"hall{suffix}").write_bytes(written.with_suffix(suffix).read_bytes())
    return tmp_path / "hall.pcap"


@needs_sdk
@pytest.mark.parametrize(("suffix", "name"), [(".pcap", "ouster-pcap"), (".osf", "osf")])
def test_sweeps_have_points_and_times(capture: Path, suffix: str, name: str):
    with open_recording(capture.with_suffix(suffix)) as recording:
        assert recording.format == name
        np.testing.assert_allclose(recording.sweep_times, [0.0, 0.1, 0.2], atol=1e-9)
        sweep = recording.sweep(1)
        np.testing.assert_allclose(np.linalg.norm(sweep.points, axis=1), 5.1, atol=0.05)
        assert sweep.points.shape == (64 * 511, 3) and sweep.point_times is not None
        assert float(np.ptp(sweep.point_times)) == pytest.approx(510 * 190e-6, abs=1e-6)


@needs_sdk
def test_the_imu_of_a_capture_is_read(capture: Path):
    storage = open_storage(capture)
    imu = read_imu(storage.files)
    storage.close()
    assert imu is not None and imu.topic == "/ouster/imu" and len(imu.times) == 3
    np.testing.assert_allclose(imu.rates[0], [math.radians(10.0), 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(imu.forces[0], [0.0, 0.0, 9.80665], atol=1e-5)


@needs_sdk
def test_a_capture_converts_to_mcap(capture: Path, capsys: pytest.CaptureFixture[str]):
    run_json(capsys, "convert", str(capture), str(capture.with_suffix(".mcap")))
    with open_recording(capture) as before, open_recording(capture.with_suffix(".mcap")) as after:
        np.testing.assert_array_equal(before.sweep(1).points, after.sweep(1).points)
        np.testing.assert_allclose(before.sweep(1).point_times, after.sweep(1).point_times)  # type: ignore[arg-type]


@needs_sdk
@pytest.mark.parametrize("share", [0.4, 0.9])
def test_a_truncated_capture_plays_up_to_the_cut(capture: Path, share: float):
    content = capture.read_bytes()
    capture.write_bytes(content[: int(share * len(content))])
    report = inspect(capture)
    assert report.sweeps >= 1 and report.points_per_sweep is not None and report.points_per_sweep.min < 64 * 511
    assert any("hall.pcap is truncated" in problem for problem in report.problems)


@needs_sdk
@pytest.mark.parametrize(("suffix", "share"), [(".pcap", 0.001), (".osf", 0.01), (".osf", 0.5)])
def test_a_file_without_a_whole_sweep_is_refused(
    capture: Path, capsys: pytest.CaptureFixture[str], suffix: str, share: float
):
    path = capture.with_suffix(suffix)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    error = run_refused(capsys, "inspect", str(path))
    assert path.name in error


@needs_sdk
def test_the_temporary_file_of_a_capture_is_limited(capture: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("aero_viz.recordings.ouster.expansion_limit", lambda stored: 600_000)
    report = inspect(capture)
    assert report.sweeps == 2
    assert any("its sweeps take more than 0 MiB" in problem for problem in report.problems)


@needs_sdk
def test_the_metadata_are_the_json_file_with_the_most_similar_name(capture: Path):
    capture.with_suffix(".json").rename(capture.with_name("hall_0.json"))
    capture.with_name("hal.json").write_text('{"beam_altitude_angles": []}')
    capture.with_name("hall.pcap.json").write_text("{}")
    with open_recording(capture) as recording:
        assert len(recording.sweep_times) == 3


@needs_sdk
def test_metadata_of_another_sensor_are_named(capture: Path, capsys: pytest.CaptureFixture[str]):
    metadata = capture.with_suffix(".json")
    metadata.write_text(metadata.read_text().replace("7502", "7602"))
    error = run_refused(capsys, "inspect", str(capture))
    assert "hall.pcap holds no sweep" in error and "UDP port that hall.json describes" in error


@needs_sdk
def test_missing_metadata_are_named(capture: Path, capsys: pytest.CaptureFixture[str]):
    capture.with_suffix(".json").unlink()
    error = run_refused(capsys, "inspect", str(capture))
    assert "hall.pcap needs the metadata of the sensor" in error and "hall.json" in error


def test_the_library_to_install_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    write_pcap(tmp_path / "os.pcap", [(0.0, 7502, bytes(8448))])
    (tmp_path / "os.osf").write_bytes(b"\x34\0\0\0\x14\0\0\0OSF$" + bytes(40))
    for name in ("os.pcap", "os.osf"):
        error = run_refused(capsys, "inspect", str(tmp_path / name))
        assert name in error and "pip install --no-deps ouster-sdk" in error


@needs_sdk
def test_a_capture_of_any_interface_is_read(capture: Path):
    datagrams = [(frame.time * 1e-9, f"10.0.0.5/{frame.port}", frame.payload) for frame in udp_payloads(capture)]
    for link, ng in (("cooked 2", False), ("cooked", True), ("ethernet", True)):
        write_frames(capture, datagrams, link=link, ng=ng)
        with open_recording(capture) as recording:
            np.testing.assert_allclose(recording.sweep_times, [0.0, 0.1, 0.2], atol=1e-9)


@needs_sdk
def test_sensors_of_an_osf_are_named_and_mounted(tmp_path: Path):
    ReaderProcess()(write_two_ousters, tmp_path / "two.osf")
    with open_recording(tmp_path / "two.osf") as recording:
        np.testing.assert_allclose(np.linalg.norm(recording.sweep(1).points, axis=1), 5.0, atol=0.05)
        assert any("of 2 sensors" in text and " 22" in text for text in recording.problems)
    with open_recording(tmp_path / "two.osf", sensor="22") as recording:
        points = recording.sweep(1).points - np.array([0, 0, 2])
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 8.0, atol=0.05)
        assert any("as its metadata say" in text for text in recording.problems)
    with pytest.raises(UserError, match="no sensor is called 33"):
        open_recording(tmp_path / "two.osf", sensor="33")
