"""Start Warp without output: stdout and stderr belong to the program that plans."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import warp as wp

_log = logging.getLogger(__name__)
_lock = threading.Lock()
_started = False


def init_warp() -> None:
    """Start Warp, once per process, without its banner and its warning about a missing GPU.

    Module loading is not reported either, unless another log level was chosen. Call this before the first use of Warp,
    which would start it with all of that output.

    A kernel in Warp's cache that is damaged, as after a full disk, is compiled again. A cache that cannot be used is
    replaced by a temporary folder. Both are logged.
    """
    global _started
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    with _lock:
        if not _started:
            try:
                with _silent_stderr():
                    wp.init()
            except OSError as error:
                _use_temporary_cache(error)
                with _silent_stderr():
                    wp.init()
            wp.Module.load = _load_or_rebuild  # type: ignore[method-assign]
            _started = True


def find_device(name: str) -> wp.Device:
    """Return the Warp device "cpu" or such as "cuda:0", after starting Warp.

    Raises:
        ValueError: this machine has no such device; the message lists those that it has.
    """
    init_warp()
    try:
        return wp.get_device(name)
    except Exception as error:
        known = ", ".join(str(device) for device in wp.get_devices())
        advice = "choose one of these" if wp.is_cuda_available() else "choose that one, or install the GPU's driver"
        raise ValueError(f"device {name!r} is not available: this machine has {known}; {advice}.") from error


_load = wp.Module.load


def _load_or_rebuild(module: Any, *arguments: Any, **options: Any) -> Any:
    """Load a module of kernels as `warp.Module.load` does, which has no way to recover from a damaged cache itself."""
    try:
        return _load(module, *arguments, **options)
    except Exception as error:
        # Without a build that failed, it is the cached files that are wrong. Those of a bundle cannot be rebuilt here.
        if module.failed_builds or options.get("binary_path") is not None:
            raise
        if isinstance(error, OSError) and not isinstance(error, FileNotFoundError):
            _use_temporary_cache(error)
        elif not _remove_cached(module, error):
            raise
        return _load(module, *arguments, **options)


def _remove_cached(module: Any, error: Exception) -> bool:
    """Remove the cached files of a module; return False if there are none."""
    folder = Path(wp.config.kernel_cache_dir or "")
    found = [folder / module.get_module_identifier(block_dim) for block_dim in module.hashers]
    existing = [path for path in found if path.exists()]
    reason = " ".join(str(error).split())
    for path in existing:
        _log.warning("The compiled kernels in %s are damaged (%s); they are compiled again.", path, reason)
        try:
            shutil.rmtree(path)
        except OSError as problem:
            _use_temporary_cache(problem)
    return bool(existing)


def _use_temporary_cache(error: OSError) -> None:
    folder = tempfile.mkdtemp(prefix="aero-planner-kernels-")
    _log.warning("The kernel cache cannot be used (%s); %s is used instead.", error, folder)
    wp.config.kernel_cache_dir = folder


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard the output of native code on stderr."""
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed, as a service's may be
        yield
        return
    if sys.stderr is not None:
        sys.stderr.flush()
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)
