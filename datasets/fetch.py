"""Downloads public recordings and worlds, and checks them: `datasets/fetch.py` lists them, `.. NAME` gets one.

Needs nothing but Python. A file is kept only if its size and SHA-256 are right. The checksums were computed from the
repositories at the commits that the addresses name. Without a network, a file that was downloaded elsewhere can be put
into the folder by hand; it is checked in the same way.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import urllib.error
import urllib.request
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).resolve().parent / "fetched"
TIMEOUT = 30.0
"""Longest wait for the next bytes [s]."""
_BLOCK = 1 << 16


class PublicFile(NamedTuple):
    """A file that anyone can download."""

    url: str
    size: int
    """[bytes]."""
    sha256: str
    licence: str
    description: str

    @property
    def path(self) -> Path:
        """The place of the file in the folder."""
        return FOLDER / self.url.rsplit("/", 1)[1]


_RAW = "https://raw.githubusercontent.com"
_KR = f"{_RAW}/KumarRobotics/kr_param_map/2594f9c8f20ffb6bdb12f6b15c03d209d18ae84e/param_env/data"
_FASTER = f"{_RAW}/jtorde/planning_worlds_gazebo/95d18de94a16aa5b58c625a2d4d968d07f014607"
_SUPER = f"{_RAW}/hku-mars/SUPER/d6bc41479500cd784598070064979dc570c7e5d8/mars_uav_sim"
FILES = {
    "livox-surf": PublicFile(
        f"{_RAW}/Livox-SDK/livox_relocalization/518f2eb9049e2f3d6e2f357516b99f4635549de6/map/surf.pcd",
        1_468_592,
        "de9671cee2729876fff7f144c2470a866f0edbe583127d86b33eb936667d623f",
        "BSD",
        "map of surfaces, Livox Mid-40, 91 531 points (PCD)",
    ),
    "livox-corner": PublicFile(
        f"{_RAW}/Livox-SDK/livox_relocalization/518f2eb9049e2f3d6e2f357516b99f4635549de6/map/corner.pcd",
        1_018_192,
        "09602bf3831cdb89a94b047b740facdb31f9e138c55723262f12968af56969c6",
        "BSD",
        "map of edges, Livox Mid-40 (PCD)",
    ),
    "px4-log": PublicFile(
        f"{_RAW}/PX4/pyulog/3cf17793f14709713ab297d3743314c658874068/test/sample_log_small.ulg",
        921_631,
        "68d1020f688109f027dba08d2950247cc0ae34aaefdcf37e4a7d60838f3e1aa3",
        "BSD-3-Clause",
        "state of a flight with PX4, for --poses (ULog)",
    ),
    "faster-forest": PublicFile(
        f"{_FASTER}/src/forest/density01seed0.world",
        485_338,
        "702f5fa86d3f7a48325e6840ba01c470054675f00e9e45eed654361542b3c04e",
        "BSD-3-Clause",
        "forest of 250 cylinders in which FASTER flew, for fly and demo (Gazebo world)",
    ),
    "kr-maze": PublicFile(
        f"{_KR}/img/maze/maze1.png",
        845,
        "1954864bcd7e545bca6f17b00957c67b48a9e93721c8eab7173ea48ff20a2fb2",
        "BSD-3-Clause",
        "maze of 20 m x 10 m of kr_param_map, for fly and demo (PNG)",
    ),
    "kr-cloud": PublicFile(
        f"{_KR}/pcd/cloud_0917.pcd",
        150_640,
        "b065686db6d3d9e833533f1548fc3da57c5fe220a999fd5c08c2996e4d18ccc4",
        "BSD-3-Clause",
        "map of kr_param_map, for fly and demo (PCD)",
    ),
    "super-forest": PublicFile(
        f"{_SUPER}/perfect_drone_sim/pcd/random_map_24_6635.pcd",
        3_619_744,
        "e469aa2150ed33ef8f8f3359bfb924a0283dc7e9d640cd83a98ad1723d3a34c4",
        "not stated",
        "map of the simulation of SUPER, in the form of MARSIM's, for fly and demo (PCD)",
    ),
    "kitti-sweep": PublicFile(
        f"{_RAW}/open-mmlab/mmdetection3d/fe25f7a51d36e3702f961e198894580d83c4387b/demo/data/kitti/000008.bin",
        275_808,
        "3b9de6cc966534900f6a1bdc93b21772e47a334eb2ef18082021956520d902d1",
        "CC BY-NC-SA 3.0 (KITTI)",
        "one sweep of a Velodyne HDL-64E on a car (KITTI .bin)",
    ),
}


class FetchError(Exception):
    """A file that could not be had; the text says why and what to do."""


def fetch(name: str) -> Path:
    """Download a file unless it is there, check it, and return its path.

    Raises:
        FetchError: the name is unknown, the network or the disk fails, or the file is not the expected one.
    """
    if name not in FILES:
        raise FetchError(f"there is no recording {name!r}; choose one of {', '.join(FILES)}")
    file = FILES[name]
    if file.path.exists():
        _check(file, file.path, "remove it and run this again")
        return file.path
    partial = file.path.with_suffix(file.path.suffix + ".part")
    try:
        FOLDER.mkdir(exist_ok=True)
        _download(file, partial)
        _check(file, partial, "try again later; the file at the source may have changed")
        partial.replace(file.path)
    except OSError as error:
        reason = getattr(error, "reason", None) or error
        raise FetchError(
            f"{file.url} could not be downloaded ({reason}). Check the network, or download it elsewhere, save it as "
            f"{file.path} and run this again to check it"
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return file.path


def _download(file: PublicFile, target: Path) -> None:
    with urllib.request.urlopen(file.url, timeout=TIMEOUT) as source, target.open("wb") as sink:
        # One byte more than expected is enough to see that the file is another one.
        while sink.tell() <= file.size and (block := source.read(_BLOCK)):
            sink.write(block)
            _show(f"\r{file.path.name}: {100 * sink.tell() // file.size} %")
    _show("\n")


def _show(text: str) -> None:
    if sys.stderr.isatty():
        print(text, end="", file=sys.stderr, flush=True)


def _check(file: PublicFile, path: Path, advice: str) -> None:
    size, digest = path.stat().st_size, hashlib.sha256()
    with path.open("rb") as content:
        while block := content.read(_BLOCK):
            digest.update(block)
    if size != file.size:
        raise FetchError(f"{path} has {size} bytes instead of {file.size}: {advice}")
    if digest.hexdigest() != file.sha256:
        raise FetchError(f"{path} has the SHA-256 {digest.hexdigest()} instead of {file.sha256}: {advice}")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("name", nargs="*", help="recording to download; without any, all are listed")
    names = parser.parse_args(arguments).name
    if not names:
        width = max(map(len, FILES))
        for name, file in FILES.items():
            print(f"{name:{width}}  {file.size / 1e6:4.1f} MB  {file.licence:24} {file.description}")
        return 0
    try:
        for name in names:
            print(fetch(name))
    except FetchError as error:
        print(f"fetch.py: {error}.", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
