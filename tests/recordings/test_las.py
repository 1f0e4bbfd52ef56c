"""Units, coordinate systems and classes of LAS and LAZ files."""

from pathlib import Path
from typing import Any

import bags
import laspy
import numpy as np
import pytest
from captures import write_las

from aero_viz.errors import UserError
from aero_viz.recordings import open_recording
from aero_viz.scenes.map_files import read_points

WALL = bags.wall(500)


@pytest.mark.parametrize(
    ("keys", "units"),
    [
        ({3076: 9002}, (0.3048, 0.3048)),
        ({1024: 1, 3072: 2926, 3076: 9003}, (1200 / 3937, 1200 / 3937)),
        ({1024: 1, 3072: 2926}, (1200 / 3937, 1200 / 3937)),  # Washington North, in US survey feet
        ({1024: 1, 3072: 6559}, (0.3048, 0.3048)),  # Oregon South, in feet
        ({1024: 1, 3072: 2926, 4096: 5703}, (1200 / 3937, 1.0)),
        ({1024: 1, 3072: 2926, 4099: 9001}, (1200 / 3937, 1.0)),
        ({1024: 1, 3072: 32610, 4096: 6360}, (1.0, 1200 / 3937)),
    ],
)
def test_feet_and_map_coordinates_of_las_become_metres_near_the_origin(
    tmp_path: Path, keys: dict[int, int], units: tuple[float, float]
):
    path = tmp_path / "forest.las"
    horizontal, vertical = units
    write_las(path, WALL / [horizontal, horizontal, vertical] + [1_500_000.0, 4_600_000.0, 300.0], keys=keys)
    with open_recording(path) as recording:
        points = recording.sweep(0).points
        assert any("feet" in problem for problem in recording.problems)
        assert any("map coordinates" in problem for problem in recording.problems)
    assert np.abs(points).max() < 10.0
    np.testing.assert_allclose(points - points.mean(axis=0), WALL - WALL.mean(axis=0), atol=2e-3)


def test_a_plot_in_metres_says_only_what_was_subtracted_and_one_without_a_system_what_was_assumed(tmp_path: Path):
    path = tmp_path / "plot.laz"
    for keys, said in (({1024: 1, 3072: 32633}, False), (None, True)):
        write_las(path, np.add(WALL, [500_000.0, 5_400_000.0, 600.0]), keys=keys)
        with open_recording(path) as recording:
            assert not any("feet" in problem for problem in recording.problems)
            assert any("assumed to be metres" in problem for problem in recording.problems) == said


@pytest.mark.parametrize(
    "options", [{"keys": {1024: 2, 2048: 4326}}, {"wkt": 'GEOGCS["WGS 84",UNIT["degree",0.0175]]'}]
)
def test_coordinates_in_degrees_are_refused_with_the_next_step(tmp_path: Path, options: dict[str, Any]):
    path = tmp_path / "plot.laz"
    write_las(path, np.add(1e-4 * WALL, [13.4, 52.5, 30.0]), **options)
    with pytest.raises(UserError, match=r"coordinates are degrees: .*pdal"):
        open_recording(path)


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize(("heights", "factor"), [("US survey foot", 1200 / 3937), ("metre", 1.0)])
def test_units_of_a_well_known_text_are_those_of_the_plane_and_of_the_heights(
    tmp_path: Path, heights: str, factor: float, extended: bool
):
    foot = 1200 / 3937
    wkt = (
        'COMPD_CS["Washington North",PROJCS["NAD83 (ftUS)",GEOGCS["NAD83",UNIT["degree",0.0174532925199433]],'
        f'PARAMETER["false_easting",1640416.667],UNIT["US survey foot",{foot}]],'
        f'VERT_CS["NAVD88",VERT_DATUM["NAVD88",2005],UNIT["{heights}",{factor}]]]'
    )
    path = tmp_path / "plot.laz"
    write_las(path, WALL / [foot, foot, factor] + [1_500_000.0, 600_000.0, 300.0], wkt=wkt, extended=extended)
    with open_recording(path) as recording:
        points = recording.sweep(0).points
        assert any("feet" in problem for problem in recording.problems)
    np.testing.assert_allclose(points - points.mean(axis=0), WALL - WALL.mean(axis=0), atol=2e-3)


def test_withheld_points_and_noise_of_las_are_left_out(tmp_path: Path):
    path = tmp_path / "plot.laz"
    write_las(path, np.vstack([WALL, [[0.0, 0.0, 9000.0], [0.0, 0.0, -9000.0], [9000.0, 0.0, 0.0]]]))
    content = laspy.read(path)
    content.classification[-3:] = [18, 7, 2]
    content.withheld[-1:] = 1
    content.write(str(path))
    with open_recording(path) as recording:
        np.testing.assert_allclose(recording.sweep(0).points, WALL, atol=1e-3)


@pytest.mark.parametrize(
    ("unit", "length", "is_odd"),
    [
        ('"US survey foot",1.0', 1200 / 3937, True),
        ('"foot",1', 0.3048, True),
        ('"Foot_US",1.0', 1200 / 3937, True),
        ('"metre",0.3048', 1.0, True),
        ('"metre",0.3048006096012192,AUTHORITY["EPSG","9003"]', 1200 / 3937, True),
        ('"foot",1.0,ID["EPSG",9001]', 1.0, True),
        ('"foot",0.3048', 0.3048, False),
        ('"foot",0.3048006096', 0.3048006096, False),
        ('"ftUS",0.304800609601219', 1200 / 3937, False),
        ('"metre",1', 1.0, False),
        ('"link",0.201168', 0.201168, False),
    ],
)
def test_a_unit_whose_name_and_factor_contradict_each_other_is_noted(
    tmp_path: Path, unit: str, length: float, is_odd: bool, caplog: pytest.LogCaptureFixture
):
    path = tmp_path / "plot.laz"
    wkt = f'PROJCS["a",GEOGCS["NAD83",UNIT["degree",0.0174532925199433]],UNIT[{unit}]]'
    write_las(path, WALL / length, wkt=wkt)
    with open_recording(path) as recording:
        np.testing.assert_allclose(np.ptp(recording.sweep(0).points, axis=0), np.ptp(WALL, axis=0), atol=2e-3)
        assert any("a unit of the file is called" in text for text in recording.problems) == is_odd
    read_points(path)
    assert ("a unit of the file is called" in caplog.text) == is_odd
