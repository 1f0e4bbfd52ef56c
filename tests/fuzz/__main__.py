"""Run the fuzzer: `make fuzz` for an hour, `make fuzz ARGS="--seconds 60 --only pcd"` for less."""

import argparse
import contextlib
import importlib.util
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copy as copy_file
from shutil import copytree, rmtree

from fuzz.cases import INPUTS, NAMES, TARGET, write_case, write_seed
from fuzz.worker import Outcome, Worker

_GUIDED = {"mcap-plain.bagfolder": "recording", "rosbag1.bagfolder": "recording", "db3.bagfolder": "recording"}
_GUIDED |= {"binary.pcd": "decoder", "compressed.pcd": "decoder", "a.npy": "decoder", "a.off": "decoder"}
_GUIDED |= {name: "recording" for name in ("mid360.pcap", "mid360.lvx2", "foxglove.mcap", "scans.mcap")}
_GUIDED |= {"tum.txt": "poses", "kitti.txt": "poses"}
"""Seeds of the parsers written by hand, which atheris explores by coverage."""

EVERY = {
    "control.messages": 20, "visitor.messages": 20, "flight.mcap": 10, "hall.ouster": 10, "hall.osf": 10,
    "flight.ulg": 5, "a.world": 5, "a.png": 5, "server.map": 5, "lidar.datagrams": 4, "mavlink.datagrams": 4,
    "mavlink.serial": 4,
}  # fmt: skip
"""Kinds whose cases take long, in so many rounds one."""


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
    names = [name for name in NAMES if options.only in name]
    seeds = {name: write_seed(name, options.folder / "seeds") for name in names}
    guided = [name for name in names if name in _GUIDED] if importlib.util.find_spec("atheris") else []
    share = 0.3 * options.seconds / max(len(guided), 1)
    failures = sum(_explore(name, share, options.folder) for name in guided)
    failures += _run_cases(seeds, options.seconds * (0.7 if guided else 1.0), options.first, options.folder)
    return int(failures > 0)


def _run_cases(seeds: dict[str, Path | None], seconds: float, first: int, folder: Path) -> int:
    """Run the cases of all kinds in turn, and return the number of failures."""
    end, table, number = time.monotonic() + seconds, {name: _Row() for name in seeds}, first
    with contextlib.suppress(KeyboardInterrupt), Worker() as worker:  # after Ctrl-C, the table shows what was done
        whole = {name: worker.run(TARGET[name], path) for name, path in seeds.items() if path is not None}
        while time.monotonic() < end:
            for name in seeds:
                if number % EVERY.get(name, 1):
                    continue
                path = write_case(name, folder / "seeds", folder, number)
                outcome = worker.run(TARGET[name], path)
                table[name].add(outcome, whole.get(name))
                if outcome.is_failure:
                    _keep(folder, name, number, outcome)
            number += 1
    columns = ("inputs", "refused", "same", "told", "silent", "failed")
    print(f"{'kind':22}", *(f"{column:>8}" for column in (*columns, "seconds", "MiB")))
    for name, row in table.items():
        counts = [row.cases * INPUTS[name], *(row.counts[column] for column in columns[1:-1]), row.failures]
        print(f"{name:22}", *(f"{count:8}" for count in counts), f"{row.seconds:8.2f} {row.memory >> 20:8}")
    total = sum(row.cases * INPUTS[name] for name, row in table.items())
    failed = sum(row.failures for row in table.values())
    print(f"{total} inputs, {failed} failures; the next run may start with --first {number}")
    return failed


@dataclass
class _Row:
    """Results of the cases of one kind."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: int = 0
    seconds: float = 0.0
    memory: int = 0

    @property
    def cases(self) -> int:
        return self.counts.total() + self.failures

    def add(self, outcome: Outcome, whole: Outcome | None) -> None:
        """Count a case, compared with the whole file."""
        self.seconds, self.memory = max(self.seconds, outcome.seconds), max(self.memory, outcome.memory)
        if outcome.is_failure:
            self.failures += 1
        elif outcome.kind == "refused":
            self.counts["refused"] += 1
        elif whole is None or outcome.digest == whole.digest:
            self.counts["same"] += 1
        else:
            self.counts["silent" if outcome.remarks == whole.remarks else "told"] += 1


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
