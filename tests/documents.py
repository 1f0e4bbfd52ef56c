"""The documents of the repository, and what is in them."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IGNORED = (ROOT / ".gitignore").read_text(encoding="utf-8").split()
"""Folders that are made, not kept, with a slash at the end."""


def _walk() -> Iterator[str]:
    for folder, names, files in os.walk(ROOT):
        names[:] = [name for name in names if not name.startswith(".") and f"{name}/" not in IGNORED]
        yield from (f"{Path(folder, name).relative_to(ROOT)}" for name in (*names, *files))


PATHS = sorted(_walk())
"""Files and folders from the root of the repository."""
TEXTS = {path: (ROOT / path).read_text(encoding="utf-8") for path in PATHS if path.endswith(".md")}
"""Text of each document by its path."""
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(text: str, *languages: str) -> list[str]:
    """Return the fenced blocks of these languages."""
    return [body for language, body in _BLOCK.findall(text) if language in languages]


def prose(text: str) -> str:
    """Return a document without its fenced blocks."""
    return _BLOCK.sub("", text)


def code(text: str) -> list[str]:
    """Return what stands between backticks in the prose of a document, in one line each, without titles of links."""
    return [" ".join(words.split()) for words in re.findall(r"(?<![\[`])`([^`]+)`(?!\])", prose(text))]


def rows(text: str, heading: str) -> list[list[str]]:
    """Return the cells of the tables below a heading of the second level."""
    part = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    table = [line for line in part.splitlines() if line.startswith("|") and "---" not in line]
    return [[cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table]


def commands(text: str) -> Iterator[str]:
    """Yield the command lines of the shell blocks, without comments and prompts, continued lines joined."""
    for body in blocks(text, "sh"):
        for line in body.replace("\\\n", " ").splitlines():
            command = re.sub(r"(^|\s)#.*", "", line).strip()
            if command:
                yield command
