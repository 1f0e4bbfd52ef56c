"""Files that are named like installed modules, in a folder from which programs are started."""

from pathlib import Path

INSTALLED = (
    "PIL", "cmaes", "imageio", "landlockpy", "laspy", "lazrs", "lz4", "matplotlib", "mcap", "numpy", "optuna", "psutil",
    "pymavlink", "ray", "rich", "rosbags", "scipy", "sqlalchemy", "trimesh", "tyro", "viser", "warp", "websockets",
    "yaml",
)  # fmt: skip
STANDARD = (
    "collections", "ctypes", "dataclasses", "email", "json", "logging", "multiprocessing", "pickle", "random", "select",
    "signal", "socket", "sqlite3", "struct", "subprocess", "tempfile", "typing", "uuid",
)  # fmt: skip


def write_stray_modules(folder: Path, names: tuple[str, ...] = INSTALLED + STANDARD) -> None:
    """Write modules that note in the folder that they were executed, and fail."""
    for name in names:
        marker = folder / f"{name}.executed"
        (folder / f"{name}.py").write_text(f"open({str(marker)!r}, 'w').close()\nraise ImportError('a stray module')\n")


def leave_what_python_imports(folder: Path) -> None:
    """Delete the stray modules that `python -m` itself imports from the current folder, before any module of ours."""
    (folder / "collections.py").unlink()


def executed_modules(folder: Path) -> list[str]:
    """Return the names of the stray modules that were executed."""
    return sorted(file.stem for file in folder.glob("*.executed"))
