"""Run the fuzzer: `make fuzz` for an hour, `make fuzz ARGS="--seconds 60 --only pcd"` for less."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from shutil import copy as copy_file
from shutil import copytree, rmtree

from fuzz.mutation import write_case
from fuzz.seeds import SEEDS
from fuzz.worker import Outcome, Worker

_GUIDED = {"mcap-plain.bagfolder": "recording", "rosbag1.bagfolder": "recording", "db3.bagfolder": "recording"}
_GUIDED |= {"binary.pcd": "decoder", "compressed.pcd": "decoder", "a.npy": "decoder", "a.off": "decoder"}
_GUIDED |= {name: "recording" for name in ("mid360.pcap", "mid360.lvx2", "foxglove.mcap", "scans.mcap")}
_GUIDED |= {"tum.txt": "poses", "kitti.txt": "poses"}
"""Seeds of the parsers written by hand, which atheris explores by coverage."""


def main() -> int:
    """Run cases until the time is up, print a table, keep the files of failures, and return 1 if there are any."""
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="how long to run")
    parser.add_argument("--first", type=int, default=0, help="number of the first case; other numbers, other damage")
    parser.add_argument("--only", default="", help="run the seeds whose names contain this text")
    parser.add_argument("--folder", type=Path, default=Path("build/fuzz"), help="where files are written")
    options = parser.parse_args()
    rmtree(options.folder / "seeds", ignore_errors=True)
    (options.folder / "seeds").mkdir(parents=True)
    names = [name for name in SEEDS if options.only in name]
    for name in names:
        SEEDS[name][1](options.folder / "seeds" / name)
    guided = [name for name in names if name in _GUIDED] if importlib.util.find_spec("atheris") else []
    share = 0.3 * options.seconds / max(len(guided), 1)
    failures = sum(_explore(name, share, options.folder) for name in guided)
    failures += _run_cases(names, options.seconds * (0.7 if guided else 1.0), options.first, options.folder)
    return int(failures > 0)


def _run_cases(names: list[str], seconds: float, first: int, folder: Path) -> int:
    """Run the cases of all seeds in turn, and return the number of failures."""
    end, counts, peak, number = time.monotonic() + seconds, Counter[tuple[str, str]](), Counter[str](), first
    slowest: dict[str, float] = {}
    with contextlib.suppress(KeyboardInterrupt), Worker() as worker:  # after Ctrl-C, the table shows what was done
        while time.monotonic() < end:
            for name in names:
                path = write_case(folder / "seeds" / name, folder, number)
                outcome = worker.run(SEEDS[name][0], path)
                counts[name, outcome.kind] += 1
                peak[name] = max(peak[name], outcome.memory)
                slowest[name] = max(slowest.get(name, 0.0), outcome.seconds)
                if outcome.is_failure:
                    _keep(folder, name, number, outcome)
            number += 1
    print(f"{'seed':28}{'cases':>8}{'used':>8}{'refused':>9}{'failed':>8}{'slowest':>10}{'memory':>10}")
    failed = 0
    for name in names:
        kinds = {kind: count for (seed, kind), count in counts.items() if seed == name}
        total, good = sum(kinds.values()), kinds.get("done", 0) + kinds.get("refused", 0)
        failed += total - good
        print(
            f"{name:28}{total:8}{kinds.get('done', 0):8}{kinds.get('refused', 0):9}{total - good:8}"
            f"{slowest.get(name, 0.0):8.2f} s{peak[name] >> 20:6} MiB"
        )
    print(f"{counts.total()} cases, {failed} failures; the next run may start with --first {number}")
    return failed


def _keep(folder: Path, name: str, number: int, outcome: Outcome) -> None:
    """Print a failure, and keep its file."""
    place = folder / "failures" / f"{number}-{name}"
    rmtree(place, ignore_errors=True)
    place.parent.mkdir(exist_ok=True)
    source = folder / name
    (copytree if source.is_dir() else copy_file)(source, place)
    print(f"{outcome.kind}: case {number} of {name}, kept in {place}\n{outcome.text}", flush=True)


def _explore(name: str, seconds: float, folder: Path) -> int:
    """Let atheris explore a parser, and return 1 if it finds a failure."""
    command = [sys.executable, "-m", "fuzz.guided", _GUIDED[name], str(folder / "seeds" / name), str(int(seconds))]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = [line for line in done.stderr.splitlines() if line.startswith(("#", "Done"))]
    print(f"atheris, {name}: {lines[-1] if lines else 'no output'}", flush=True)
    if done.returncode:
        print(done.stderr[-3000:], flush=True)
    return int(done.returncode != 0)


if __name__ == "__main__":
    sys.exit(main())
