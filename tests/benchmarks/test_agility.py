"""Rows of worlds that the benchmarks of flights accept."""

from benchmarks.agility import make_flight_parser, passable_worlds


def test_a_row_is_a_scene_with_or_without_a_count():
    rows = ["windows", "windows:2", "hall", "pillars", "pillars:3"]
    options = make_flight_parser("agility", None).parse_args(["--rows", *rows, "--seeds", "5-6", "--processes", "1"])
    names = {row: [world.name for world in worlds] for row, worlds in passable_worlds(options).items()}
    assert names == {
        "windows": ["windows-4-5", "windows-4-6"],
        "windows:2": ["windows-2-5", "windows-2-6"],
        "hall": ["hall-5", "hall-6"],
        "pillars": ["pillars-6-5", "pillars-6-6"],
        "pillars:3": ["pillars-3-5", "pillars-3-6"],
    }
