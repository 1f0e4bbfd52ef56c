"""Read a format of your own: sweeps, each as its time, the number of its points, and these as 16-bit centimetres.

Every command reads it then, such as `own_format.py inspect FILE` or `own_format.py play FILE --odometry auto`.
Without a command, a file is written, with what a drone sees on its way to a wall, and played with a file of poses.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from aero_viz.cli import main
from aero_viz.recordings import FORMATS, PacketClouds, RecordingSource, StampedCloud, inspect, open_recording
from aero_viz.recordings.choices import Choices
from aero_viz.session import Session

MAGIC = b"CENTISWEEPS\n"
HEAD = np.dtype([("stamp", "<i8"), ("count", "<i4")])  # [ns]


def sweeps(path: Path) -> Iterator[StampedCloud]:
    """Yield the sweeps; EOFError says that the end is missing, and what came before is played."""
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        while head := file.read(HEAD.itemsize):
            stamp, count = np.frombuffer(head, HEAD)[0] if len(head) == HEAD.itemsize else (0, 0)
            data = file.read(6 * max(count, 0))
            if len(data) < 6 * count or len(head) < HEAD.itemsize:
                raise EOFError
            yield StampedCloud(int(stamp), np.frombuffer(data, "<i2").reshape(-1, 3) * np.float32(0.01), None)


def open_centisweeps(path: Path, start: bytes, choices: Choices) -> tuple[str, PacketClouds] | None:
    """Return the name of the format and the file's sweeps, or None for a file of another format."""
    return ("centisweeps", PacketClouds(path, "/points", sweeps(path))) if start.startswith(MAGIC) else None


FORMATS.add("centisweeps", open_centisweeps)

if __name__ == "__main__":
    if sys.argv[1:]:
        sys.exit(main())
    file, poses, rng = Path("own_format.sweeps"), Path("own_format.tum"), np.random.default_rng(0)
    wall = np.column_stack((np.full(3000, 12.0), rng.uniform((-4.0, 0.0), (4.0, 4.0), (3000, 2))))
    with file.open("wb") as output, poses.open("w") as table:
        output.write(MAGIC)
        for stamp, x in zip(range(10**9, 3 * 10**9, 10**8), np.linspace(0.0, 4.0, 20), strict=True):
            points = np.round(100.0 * (wall - [x, 0.0, 2.0])).astype("<i2")
            output.write(np.array([(stamp, len(points))], HEAD).tobytes() + points.tobytes())
            table.write(f"{stamp * 1e-9:.1f} {x:.3f} 0 2 0 0 0 1\n")  # time, position, quaternion x y z w
    info = inspect(file, poses=poses)
    frame = Session(RecordingSource(open_recording(file, poses=poses))).tick()
    print(
        f"{info.format}: {info.sweeps} sweeps, {info.poses} poses, {len(frame.plan.positions)} candidates at the wall"
    )
