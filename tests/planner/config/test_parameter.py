"""Base classes of configurations, tested with a configuration that has renamed and removed parameters."""

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import pytest

from aero_planner.config.file import ConfigFile
from aero_planner.parameters import (
    ParameterInfo,
    ParameterSection,
    SectionedConfig,
    choice,
    live,
    structural,
    switch,
    text,
)


@dataclass(frozen=True)
class Wing(ParameterSection, section="wing"):
    """A wing."""

    owner: str = "nobody"
    span: float = live(2.0, "m", 0.0, 10.0, "Tip to tip.", label="Wing span", symbol="b", group="Size")
    spars: int = structural(2, 1, 9, "Number of spars.")
    folded: bool = switch(False, "Fold the wing.")
    profile: str = choice("thin", ("thin", "thick"), "Profile.")
    host: str = text("here", "[a-z]+", "a word", "Where it is.")


@dataclass(frozen=True)
class Bird(SectionedConfig):
    """A bird."""

    noun: ClassVar[str] = "feature"
    renamed: ClassVar[Mapping[str, str]] = {"wing.width": "wing.span"}
    removed: ClassVar[Mapping[str, str]] = {"wing.color": "birds are white now"}
    wing: Wing = field(default_factory=Wing)


def test_sections_describe_their_parameters():
    assert [info.path for info in Bird.parameters()] == [
        "wing.span", "wing.spars", "wing.folded", "wing.profile", "wing.host",
    ]  # fmt: skip
    span, spars, folded, profile, host = Bird.parameters()
    assert (span.title, span.group, span.range) == ("Wing span b [m]", "Size", "0 to 10 m")
    assert (spars.title, spars.group, spars.range) == ("Spars", "Wing", "1 to 9")
    assert [info.live for info in (span, spars, folded)] == [True, False, True]
    assert (folded.range, profile.range, host.range) == ("true, false", "thin, thick", "a word")
    assert Bird.sections() == {"wing": Wing}


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"span": 11}, r"wing\.span is 11; it must be a number in \[0, 10\] m\."),
        ({"spars": 1.5}, r"wing\.spars is 1\.5; it must be a whole number in \[1, 9\]\."),
        ({"folded": 1}, r"wing\.folded is 1; it must be true or false\."),
        ({"profile": "fat"}, r"wing\.profile is 'fat'; it must be one of thin, thick\."),
        ({"host": "Here"}, r"wing\.host is 'Here'; it must be a word\."),
    ],
)
def test_sections_check_their_values(values: dict, problem: str):
    with pytest.raises(ValueError, match=problem):
        Wing(**values)
    with pytest.raises(ValueError, match=problem):
        dataclasses.replace(Wing(owner="me"), **values)


def test_errors_use_the_noun_of_the_configuration():
    with pytest.raises(ValueError, match=r"unknown feature 'wing\.spam' \(did you mean 'wing\.span'\?\)"):
        Bird.find("wing.spam")
    with pytest.raises(ValueError, match="section 'wing' is 3; it must be a Wing"):
        Bird(wing=3)  # type: ignore[arg-type]


def notices(caplog: pytest.LogCaptureFixture) -> list[str]:
    assert all(record.levelno == logging.WARNING for record in caplog.records)
    return [record.getMessage() for record in caplog.records]


RENAMED = "wing.width is now wing.span; the old name works until the next release."
REMOVED = "wing.color is ignored: birds are white now."


def test_old_names_still_work_with_a_notice(caplog: pytest.LogCaptureFixture):
    assert Bird().replace({"wing.width": 5}) == Bird().replace({"wing.span": 5.0})
    assert Bird.from_dict({"wing": {"width": 5}}).wing.span == 5.0
    assert notices(caplog) == [RENAMED] * 2
    assert Bird().get("wing.width") == 2.0 and isinstance(Bird.find("wing.width"), ParameterInfo)


def test_removed_names_are_ignored_with_a_notice(caplog: pytest.LogCaptureFixture):
    assert Bird().replace({"wing.color": 5}) == Bird.from_dict({"wing": {"color": "red"}}) == Bird()
    assert notices(caplog) == [REMOVED] * 2
    with pytest.raises(ValueError, match=r"wing\.color was removed: birds are white now\."):
        Bird.find("wing.color")


def test_files_may_use_old_names(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    path = tmp_path / "bird.yaml"
    path.write_text("wing:\n  width: 3\n  color: [red]\n")
    file = ConfigFile.read(path)
    assert file.change(Bird(), file.entries).wing.span == 3.0
    assert notices(caplog) == [f"{path}, line 2: {RENAMED}", f"{path}, line 3: {REMOVED}"]
    path.write_text("wing:\n  width: 3\n  span: 4\n")
    file = ConfigFile.read(path)
    with pytest.raises(ValueError, match=r"line 3: wing\.span is given twice, under its old and its new name"):
        file.change(Bird(), file.entries)


def test_notices_reach_stderr_without_logging_being_configured(capfd: pytest.CaptureFixture[str]):
    root = logging.getLogger()
    handlers, root.handlers = root.handlers, []
    try:
        Bird().replace({"wing.width": 5})
    finally:
        root.handlers = handlers
    assert capfd.readouterr().err == f"{RENAMED}\n"
