"""Studies on disk, flown for a moment: what is read, and the messages where nothing can be."""

from __future__ import annotations

import dataclasses
import os
import sqlite3
import sys
from pathlib import Path
from typing import Any

import optuna
import pytest
from small_source import small_config, small_source

from aero_viz.errors import UserError
from aero_viz.evaluation.tune import FlightOptions, ParameterRange, SearchOptions, StoredStudy, tune
from aero_viz.flight import FlightRules
from aero_viz.sensors import LidarModel

SPEED = ParameterRange("vehicle.speed_limit", 1.0, 8.0)
TRACK = ParameterRange("costs.q_track", 0.5, 50.0)
QUICK = FlightRules(ticks_per_plan=5)


def fly(storage: str, *, trials: int, flights: int = 2, rules: FlightRules = QUICK, **search: Any) -> None:
    world = small_source(goal=7.0).info.world
    assert world is not None
    how = dataclasses.replace(SearchOptions(trials, generation=4, rungs=1), **search)
    options = FlightOptions(lidar=LidarModel("sparse", points_per_sweep=500), rules=rules)
    tune(
        small_config(),
        [SPEED, TRACK],
        [world] * flights,
        [world],
        search=how,
        flight=options,
        storage=storage,
        study_name="poles",
    )


@pytest.fixture(scope="module")
def storage(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A study of eight candidates with two objectives."""
    storage = f"sqlite:///{tmp_path_factory.mktemp('study')}/tune.db"
    fly(storage, trials=8, objectives=("time", "clearance"), sampler="random")
    return storage


def test_candidates_front_and_importance_are_read(storage: str) -> None:
    view = StoredStudy(storage, "poles").read()
    assert (view.name, view.finished, view.asked, view.flights, view.progress) == ("poles", 8, 8, 18, 1.0)
    assert view.axes == ("arrived [%]", "time [s]", "clearance [m]")
    incumbent, *candidates = view.points
    assert incumbent.trial is None and incumbent.config == small_config() and len(candidates) == 8
    slow = min(candidates, key=lambda point: point.config.vehicle.speed_limit)
    fast = min(
        view.points, key=lambda point: (point.estimates["time [s]"].value, -point.estimates["clearance [m]"].value)
    )
    assert fast.on_front and slow.estimates["time [s]"].value > 2 * fast.estimates["time [s]"].value
    share, time = fast.estimates["arrived [%]"], fast.estimates["time [s]"]
    assert (share.value, round(share.low), share.high) == (100.0, 34, 100.0)
    assert time.low <= time.value <= time.high
    for point in view.points:
        beaten = [
            other for other in view.points
            if other.estimates["time [s]"].value < point.estimates["time [s]"].value
            and other.estimates["clearance [m]"].value > point.estimates["clearance [m]"].value
        ]  # fmt: skip
        assert not (point.on_front and beaten)
    assert {one.path for one in view.importance} == {"vehicle.speed_limit", "costs.q_track"}
    assert sum(one.share for one in view.importance) == pytest.approx(1.0)
    assert all(0.0 <= one.low <= one.share <= one.high <= 1.0 for one in view.importance)


def test_a_study_is_followed_while_it_is_flown(tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/tune.db"
    short = FlightRules(time_limit=0.1)
    fly(storage, trials=2, rules=short)
    study = StoredStudy(storage, "poles")
    before = study.read()
    assert study.read() is before and before.finished == before.asked == 2 and before.importance == ()
    assert not any(point.on_front for point in before.points)  # nobody arrives
    fly(storage, trials=4, rules=short)
    assert study.read().finished == 4 and study.read().flights == 10


def test_importance_finds_the_parameter_that_matters(tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/tune.db"
    fly(storage, trials=16, flights=1, sampler="random", generation=16)
    first, second = StoredStudy(storage, "poles").read().importance
    assert first.path == "vehicle.speed_limit" and first.share > 2 * second.share


def test_what_cannot_be_read_is_named_with_the_next_step(storage: str, tmp_path: Path) -> None:
    def refusal(url: str, name: str = "poles") -> str:
        with pytest.raises(UserError) as caught:
            StoredStudy(url, name)
        return str(caught.value)

    absent = tmp_path / "absent.db"
    assert f"There is no storage {absent}; make a study with aero-viz tune" in refusal(f"sqlite:///{absent}")
    assert not absent.exists()
    text = tmp_path / "text.db"
    text.write_text("no database, but long enough to look like one " * 20)
    assert "text.db cannot be read as a storage of studies: file is not a database" in refusal(f"sqlite:///{text}")
    other = tmp_path / "other.db"
    with sqlite3.connect(other) as database:
        database.execute("CREATE TABLE birds (name TEXT)")
    content = other.read_bytes()
    assert "other.db is a database without studies of Optuna; give another --storage" in refusal(f"sqlite:///{other}")
    assert other.read_bytes() == content
    assert "no study 'pole' in" in (message := refusal(storage, "pole")) and "(did you mean 'poles'?)" in message
    assert message.endswith("it holds poles.")
    assert "Cannot read the storage nonsense://x of Optuna" in refusal("nonsense://x")


def test_foreign_and_damaged_studies_are_named(tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/tune.db"
    fly(storage, trials=1, rules=FlightRules(time_limit=0.1))
    optuna.create_study(storage=storage, study_name="foreign")
    with pytest.raises(UserError, match=r"'foreign' in .* was not made by aero-viz tune .* choose another --study"):
        StoredStudy(storage, "foreign")
    study = optuna.load_study(study_name="poles", storage=storage)
    open_study, definition = StoredStudy(storage, "poles"), study.user_attrs["definition"]
    study.set_user_attr("definition", definition | {"config": {"costs": {"q_trick": 1.0}}})
    with pytest.raises(UserError, match=r"'poles' in .* is damaged, or of another version .*q_trick"):
        StoredStudy(storage, "poles")
    study.set_user_attr("definition", definition)
    study.set_user_attr("incumbent", {"0": {"arrived": "perhaps"}})
    study.set_user_attr("trials", 7)
    with pytest.raises(UserError, match="is damaged"):
        open_study.read()


@pytest.mark.parametrize(
    ("statements", "problem"),
    [
        (
            "ALTER TABLE trials RENAME TO old; CREATE VIEW trials AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT "
            "i + 1 FROM n) SELECT old.* FROM n, old",
            "has the view 'trials'",
        ),
        ("CREATE VIEW harmless AS SELECT 1", "has the view 'harmless'"),
        ("CREATE TRIGGER t AFTER INSERT ON trials BEGIN DELETE FROM studies; END", "has the trigger 't'"),
        ("CREATE VIRTUAL TABLE search USING fts5(text)", "has the table 'search'"),
        ("ALTER TABLE trials ADD COLUMN d AS (number * 2)", "has computed columns in its table 'trials'"),
        ("CREATE INDEX i ON trials (number * 2)", "has computed columns in its index 'i'"),
    ],
)
def test_a_storage_with_a_program_is_refused(storage: str, tmp_path: Path, statements: str, problem: str) -> None:
    path = tmp_path / "evil.db"
    path.write_bytes(Path(storage.removeprefix("sqlite:///")).read_bytes())
    with sqlite3.connect(path) as database:
        database.executescript(f"PRAGMA legacy_alter_table = ON; {statements}")
    for url in (f"sqlite:///{path}", f"sqlite+pysqlite:///{path}?timeout=3"):
        with pytest.raises(UserError, match=rf"evil\.db {problem}.* give another --storage"):
            StoredStudy(url, "poles")
        with pytest.raises(UserError, match=problem):
            fly(url, trials=1)


def test_special_files_are_no_storage(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.db")
    for url, problem in (
        (f"sqlite:///{tmp_path}/pipe.db", "it is a pipe"),
        (f"sqlite:///{tmp_path}", "Is a directory"),
        (f"sqlite:///file:{tmp_path}/tune.db?uri=true", "give sqlite:///PATH"),
    ):
        with pytest.raises(UserError, match=problem):
            StoredStudy(url, "poles")


def test_a_study_that_is_read_is_not_changed(storage: str) -> None:
    path = Path(storage.removeprefix("sqlite:///"))
    content = path.read_bytes()
    StoredStudy(storage, "poles").read()
    assert path.read_bytes() == content and [file.name for file in path.parent.iterdir()] == [path.name]


def test_without_optuna_one_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, storage: str) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    message = r"Studies need the extra 'tune': run pip install '\.\[tune\]'"
    with pytest.raises(UserError, match=message):
        StoredStudy(storage, "poles")
    with pytest.raises(UserError, match=message):
        fly("sqlite:///unused.db", trials=1)
