"""Opening the files of a recording. The first bytes of a file decide its format, not its name."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import yaml

from aero_planner.plain_yaml import compose_yaml
from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import METADATA_MAX
from aero_viz.recordings.bag_file import BagFile, list_names, one_line
from aero_viz.recordings.choices import AUTOMATIC, Choices
from aero_viz.recordings.compressed_file import COMPRESSED_MAGICS, decompress_file
from aero_viz.recordings.mcap_file import MCAP_MAGIC, McapFile
from aero_viz.recordings.ros1_file import ROS1_MAGIC, Ros1File
from aero_viz.recordings.sqlite_file import SQLITE_MAGIC, SqliteFile
from aero_viz.registry import Registry
from aero_viz.scenes.decoder_checks import refuse_pointer

if TYPE_CHECKING:
    from aero_viz.recordings.cloud_folders import CloudFolder

SUPPORTED = (
    "MCAP files, rosbag2 folders (metadata.yaml with .mcap or .db3), .db3 files, ROS 1 .bag files (2.0), files and "
    "folders of PCD, PLY, LAS, LAZ, E57, NPY, KITTI .bin and text clouds, Livox .lvx2, Ouster .osf, and .pcap of a "
    "Livox Mid-360, a Velodyne or an Ouster"
)


Opener = Callable[[Path, bytes, Choices], tuple[str, BagFile] | None]
"""Opens a file, given its first bytes and what the user has settled; returns the name of its format, such as "mcap",
and its reader, or None if the file has another format."""


def _bag(name: str, magic: bytes, reader: Callable[[Path], BagFile]) -> Opener:
    return lambda path, start, choices: (name, reader(path)) if start.startswith(magic) else None


def _accept(name: str, found: Any) -> Opener:
    if not callable(found):
        raise UserError(f"{name} is not a format; give a function of a path, the first bytes and the choices.")
    return cast(Opener, found)


FORMATS: Registry[Opener] = Registry(
    "format",
    "aero_viz.formats",
    {
        "mcap": _bag("mcap", MCAP_MAGIC, McapFile),
        "rosbag1": _bag("rosbag1", ROS1_MAGIC, Ros1File),
        "rosbag2-sqlite3": _bag("rosbag2-sqlite3", SQLITE_MAGIC, SqliteFile),
        "captures": "aero_viz.recordings.other_formats:open_capture",
        "clouds": "aero_viz.recordings.other_formats:open_cloud",
    },
    _accept,
)
"""All formats of files by name. They are tried in this order."""
_GUESSED = "clouds"
"""The format that is tried last, because it also goes by the names of files."""
_UNREAD = {
    b"PK\3\4": (0, "unpack this archive, and open the file or folder in it"),
    b"ustar": (257, "unpack this archive with `tar -xf`, and open the file or folder in it"),
}
"""Starts of files that cannot be read, with their offsets and advice."""
_START = 512
"""Number of bytes from which the format of a file is found."""
_PARTS_MAX = 100_000
_SUFFIXES = (".mcap", ".db3", ".bag", ".active", ".zstd", ".lvx2", ".osf", ".pcap")


class Storage:
    """The open files of one recording.

    Args:
        path: file or folder that the user named.
        files: files of the recording.
        is_folder: True if `path` is a rosbag2 folder.
        folder: its clouds if `path` is a folder of cloud files.
        choices: what the user has settled.
    """

    def __init__(
        self,
        path: Path,
        files: list[Path],
        *,
        is_folder: bool,
        folder: CloudFolder | None = None,
        choices: Choices = AUTOMATIC,
    ) -> None:
        self.path, self.choices = path, choices
        self.pose_file = folder.pose_file if folder else None
        """File of poses that was found next to the clouds."""
        self.problems: list[str] = []
        """Notices for the user about the files, one sentence each."""
        self.files: list[BagFile] = []
        """Open files in the order of recording."""
        self._stack = ExitStack()
        formats: set[str] = set()
        try:
            for file in files:
                with readable(file):
                    name, bag = self._open(file)
                self._stack.callback(bag.close)
                bag.budget_share = 1.0 / len(files)
                self.files.append(bag)
                formats.add(f"rosbag2-{name}" if is_folder and name == "mcap" else name)
            if folder is not None:
                self._stack.callback(folder.clouds.close)
                self.files.append(folder.clouds)
                self.problems += folder.clouds.notices
                formats.add(folder.format)
            if choices.columns is not None and not formats & {"bin", "folder of bin"}:
                raise UserError(f"--columns names the rows of .bin files, and {path} has none; leave it out.")
        except BaseException:
            self._stack.close()
            raise
        self.format = "+".join(sorted(formats))
        """Name of the format, such as "mcap", "rosbag2-sqlite3" or "lvx2"; several are joined by "+"."""

    def _open(self, path: Path, packed: Path | None = None) -> tuple[str, BagFile]:
        """Return the format of a file and its reader.

        Args:
            path: a recording, or one that rosbag2 compressed as a whole.
            packed: the compressed file that `path` was made from, by which the user knows it.
        """
        refuse_pointer(path)
        with open_user_file(path) as file:
            start = file.read(_START)
        name = packed or path
        if not start:
            raise UserError(f"{name} is empty: record or copy it again.")
        if start.startswith(COMPRESSED_MAGICS) and packed is None:
            content, problem = decompress_file(path, self._stack)
            try:
                format_name, bag = self._open(content, path)
            except UserError as error:
                raise UserError(str(error).replace(str(content), str(path))) from error
            if problem:
                bag.problems.append(problem)
            return format_name, bag
        if start.startswith(b"#ROSBAG") and not start.startswith(ROS1_MAGIC):
            version = start.split(b"\n")[0].decode(errors="replace")
            raise UserError(f"{name} is a bag of an old format ({version}): convert it with `rosbag fix`.")
        for format_name in sorted(FORMATS, key=_GUESSED.__eq__):
            if found := FORMATS[format_name](path, start, self.choices):
                found[1].path = name
                self.problems += found[1].notices
                return found
        for magic, (offset, advice) in _UNREAD.items():
            if start[offset:].startswith(magic):
                raise UserError(f"{name} is not a recording: {advice}.")
        raise UserError(f"{name} is not a recording that AERO-Viz can read; it reads {SUPPORTED}.")

    def close(self) -> None:
        """Close all files and remove the temporary ones."""
        self.files.clear()
        self._stack.close()


def open_storage(path: str | Path, choices: Choices = AUTOMATIC) -> Storage:
    """Open the recording at `path`: a file of any supported format or a rosbag2 folder.

    Args:
        path: file or folder.
        choices: what the user has settled.

    Raises:
        UserError: there is none, or a choice does not apply to it.
    """
    if not str(path).strip():
        raise UserError("The name of the recording is empty: give a file or a folder.")
    path = Path(path).expanduser()
    if path.name == "metadata.yaml" and path.is_file():
        path = path.parent
    with readable(path):
        if not path.exists():
            raise UserError(_missing(path))
        if not path.is_dir():
            return Storage(path, [path], is_folder=False, choices=choices)
        if (path / "metadata.yaml").is_file():
            return _open_folder(path, choices)
        files = sorted(path.iterdir())
        ros2 = [file for file in files if re.search(r"\.(mcap|db3)(\.zstd)?$", file.name)]
        # A recorder that is killed writes no metadata.yaml. The files of one recording differ only in a number.
        if len({re.sub(r"(_\d+)?\.(mcap|db3)(\.zstd)?$", "", file.name) for file in ros2}) == 1 and _are_parts(ros2):
            storage = Storage(path, sorted(ros2, key=_part), is_folder=True, choices=choices)
            storage.problems.append("the folder has no metadata.yaml: the recording was probably interrupted")
            missing = sorted(set(range(_part(storage.files[-1].path))) - {_part(file) for file in ros2})
            if missing and len(ros2) > 1:
                names = list_names([re.sub(r"_\d+\.", f"_{number}.", ros2[0].name) for number in missing])
                storage.problems.append(f"parts of the recording are missing, and with them their sweeps: copy {names}")
            return storage
        ros1 = sorted((file for file in files if re.search(r"\.bag(\.active)?$", file.name)), key=_part)
        # `rosbag record --split` appends the date and a number.
        names = {re.sub(r"(_\d{4}(-\d\d){5})?_\d+\.bag.*$", "", file.name) for file in ros1}
        if ros1 and not ros2 and len(names) == 1 and [_part(file) for file in ros1] == list(range(len(ros1))):
            return Storage(path, ros1, is_folder=False, choices=choices)
        from aero_viz.recordings.cloud_folders import open_cloud_folder

        if _recordings_in(path):
            raise UserError(_no_recording(path))
        if folder := open_cloud_folder(path, choices):
            return Storage(path, [], is_folder=True, folder=folder, choices=choices)
        raise UserError(_no_recording(path))


def _open_folder(path: Path, choices: Choices) -> Storage:
    metadata = path / "metadata.yaml"
    try:
        # The files may have been moved since they were recorded, so only their names count.
        names = list(dict.fromkeys(Path(name).name for name in _relative_paths(metadata)))
    except ValueError as error:
        raise UserError(
            f"{metadata} is damaged ({one_line(error)}): open the .mcap or .db3 file next to it instead."
        ) from error
    missing = [name for name in names if not (path / name).is_file()]
    if missing or not names:
        raise UserError(
            f"{path} lacks {list_names(missing) or 'any storage file'} named in its metadata.yaml: copy it again."
        )
    return Storage(path, [path / name for name in names], is_folder=True, choices=choices)


def _relative_paths(metadata: Path) -> list[str]:
    """Return the paths of the files that metadata.yaml lists.

    Only the nodes on the way to them are looked at, and nothing is constructed: aliases cost nothing, and tags have no
    meaning.

    Raises:
        ValueError: it is too large, or no text of this form.
    """
    with open_user_file(metadata) as file:
        content = file.read(METADATA_MAX + 1)
    if len(content) > METADATA_MAX:
        raise ValueError(f"it is larger than {METADATA_MAX >> 20} MiB")
    node = compose_yaml(content.decode("utf-8"))
    for key in ("rosbag2_bagfile_information", "relative_file_paths"):
        entries = node.value if isinstance(node, yaml.MappingNode) else ()
        node = next((value for name, value in entries if name.value == key), None)
        if node is None:
            raise ValueError(f"it has no {key}")
    items = node.value if isinstance(node, yaml.SequenceNode) else [node]
    names = [item.value for item in items if item.tag == "tag:yaml.org,2002:str"]
    if len(names) < len(items) or not all(name.isprintable() and Path(name).name for name in names):
        raise ValueError("its relative_file_paths are not a list of file names")
    return names


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn any exception of a library that reads `path` into a UserError."""
    try:
        yield
    except UserError:
        raise
    except PermissionError as error:
        raise UserError(f"{path} cannot be read: permission denied.") from error
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or one_line(error)}.") from error
    except Exception as error:
        raise UserError(f"{path} cannot be read and may be damaged or truncated: {one_line(error)}.") from error


def _part(file: Path) -> int:
    number = re.search(r"_(\d+)\.(mcap|db3|bag)(\.\w+)?$", file.name)
    return int(number[1]) if number else 0


def _are_parts(files: list[Path]) -> bool:
    """Return True for one file, or for files that rosbag2 numbered from 0 on. Parts may be missing."""
    if len(files) < 2:
        return True
    numbers = {_part(file) for file in files if re.search(r"_\d+\.", file.name)}
    return len(numbers) == len(files) and 0 in numbers and max(numbers) < _PARTS_MAX


def _recordings_in(folder: Path) -> list[str]:
    """Return the names of the recordings in a folder, judged by their suffixes."""
    names = []
    for entry in folder.iterdir():
        if entry.suffix in _SUFFIXES or (entry.is_dir() and (entry / "metadata.yaml").is_file()):
            names.append(entry.name)
    return sorted(names)


def _missing(path: Path) -> str:
    parent = path.parent
    if not parent.is_dir():
        return f"{path} does not exist, nor does the folder {parent}."
    close = difflib.get_close_matches(path.name, [entry.name for entry in parent.iterdir()], n=3, cutoff=0.5)
    if close:
        return f"{path} does not exist; did you mean {' or '.join(close)}?"
    names = _recordings_in(parent)
    where = "this folder" if parent == Path() else parent
    return f"{path} does not exist; {where} holds {list_names(names) if names else 'no recording'}."


def _no_recording(path: Path) -> str:
    names = _recordings_in(path)
    if names:
        return (
            f"{path} is a folder of recordings, not one recording: choose one of {list_names(names)}. Clouds play from "
            "a folder of their own."
        )
    return f"{path} is a folder without a recording; AERO-Viz reads {SUPPORTED}."
