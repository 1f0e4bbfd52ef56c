"""The process that decodes the file of a map, with limits on its memory and time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

from aero_viz.input_limits import DECODER_MEMORY_BASE, DECODER_MEMORY_RATIO, TIME_BASE, TIME_PER_BYTE

__all__ = ["decode_apart", "main"]

_CODE = "from aero_viz.scenes.decoding_process import main; main()"
_PATIENCE = 20  # wall time for a second of CPU time, on a busy machine


def decode_apart(path: Path, content: str) -> NDArray[np.float64]:
    """Return what `aero_viz.scenes.map_decoders.decode` returns for the same arguments.

    Raises:
        ValueError: the file cannot be decoded within the limits; the text says why.
    """
    size = path.stat().st_size
    memory, seconds = DECODER_MEMORY_BASE + DECODER_MEMORY_RATIO * size, int(TIME_BASE + TIME_PER_BYTE * size) + 1
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        # Each thread of a library takes address space, which is limited.
        "MALLOC_ARENA_MAX": "2", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "RAYON_NUM_THREADS": "2",
    }  # fmt: skip
    with TemporaryFile(prefix="aero-viz-") as table:
        arguments = [str(path), content, str(table.fileno()), str(memory), str(seconds)]
        try:
            done = subprocess.run(
                [sys.executable, "-c", _CODE, *arguments], env=environment, pass_fds=[table.fileno()],
                stdin=subprocess.DEVNULL, capture_output=True, timeout=_PATIENCE * (seconds + 10),
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise ValueError("decoding it does not end; it may be damaged") from None
        if done.returncode == -signal.SIGXCPU:
            raise ValueError(f"decoding it takes more than {seconds} s, too long for its size; it may be damaged")
        answer = json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 and done.stdout else {}
        if "shape" not in answer:
            raise ValueError(answer.get("error") or "its data are damaged, and its decoder crashed")
        table.seek(0)
        return np.fromfile(table, dtype=np.float64).reshape(answer["shape"])


def main() -> None:
    """Decode a file in this process, write the table to a file descriptor and its shape, or an error, to stdout."""
    path, content, descriptor, memory, seconds = sys.argv[1:]
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # libraries print
    _limit(int(memory), int(seconds))
    try:
        from aero_viz.scenes.map_decoders import decode

        table = decode(Path(path), content)
        with os.fdopen(int(descriptor), "wb", closefd=False) as file:
            np.ascontiguousarray(table, dtype=np.float64).tofile(file)
        answer = {"shape": table.shape}
    except MemoryError:
        answer = {"error": f"it takes more than {int(memory) >> 20} MiB of memory, too much for its size"}
    except OSError as error:
        answer = {"error": error.strerror or str(error)}
    except Exception as error:  # the parsers raise whatever a damaged file leads them to
        text = "".join(letter if letter.isprintable() else "?" for letter in " ".join(str(error).split())[:300])
        is_ours = type(error) is ValueError
        answer = {"error": text if text and is_ours else f"its data are damaged ({type(error).__name__}: {text})"}
    answers.write(json.dumps(answer) + "\n")
    answers.flush()
    os._exit(0)  # the destructors of a library that read a damaged file may crash


def _limit(memory: int, seconds: int) -> None:
    """Limit what this process may take beyond what it has taken so far."""
    try:
        import resource
    except ImportError:  # not on Windows
        return
    with_libraries = 0
    status = Path("/proc/self/statm")
    if status.exists():
        with_libraries = int(status.read_text().split()[0]) * resource.getpagesize()
    usage = resource.getrusage(resource.RUSAGE_SELF)
    used = int(usage.ru_utime + usage.ru_stime)
    limits = {resource.RLIMIT_AS: with_libraries + memory, resource.RLIMIT_CPU: used + seconds, resource.RLIMIT_CORE: 0}
    for kind, limit in limits.items():
        hard = resource.getrlimit(kind)[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (limit, hard))
