"""Clouds in texts: separators, headers, units, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.recordings import open_recording
from aero_viz.scenes.map_files import read_points

POINTS = np.round(np.random.default_rng(0).uniform(-9, 9, (60, 3)), 3)


def table(separator: str, *, more: bool = False, first: bool = False, points: np.ndarray = POINTS) -> str:
    """Return the rows of a text, with an intensity behind and a name and a time before the coordinates."""
    rows = []
    for k, point in enumerate(points):
        words = [f"{value:.3f}" for value in point]
        words = [*(["tree", f"{k}"] if first else []), *words, *([f"{k}"] if more else [])]
        rows.append(separator.join(words))
    return "\n".join(rows) + "\n"


TEXTS = {
    "spaces": table(" "),
    "commas": table(","),
    "commas and spaces": table(", "),
    "semicolons": table(";"),
    "tabs": table("\t"),
    "decimal commas between semicolons": table(";").replace(".", ","),
    "decimal commas between spaces": table(" ").replace(".", ","),
    "decimal commas between tabs": table("\t").replace(".", ","),
    "header": "x y z\n" + table(" "),
    "header of CloudCompare": "//X Y Z\n60\n" + table(" "),
    "header of CloudCompare with more": "//X Y Z Scalar_field\n60\n" + table(" ", more=True),
    "header with commas": "x,y,z,intensity\n" + table(",", more=True),
    "quoted header": '"X";"Y";"Z";"I"\n' + table(";", more=True),
    "other columns first": "class,index,x,y,z,i\n" + table(",", more=True, first=True),
    "comment": "# made by a scanner\n# X Y Z\n" + table(" "),
    "count": "60\n" + table(" ", more=True),
    "byte order mark": "\ufeffx,y,z\n" + table(","),
    "units": "X (mm),Y (mm),Z (mm)\n" + table(",", points=1000 * POINTS),
    "units of the first columns only": "X (mm),Y (mm),Z (mm)\n" + table(",", more=True, points=1000 * POINTS),
    "units in words": "X (meters);Y (meters);Z (meters)\n" + table(";"),
    "units behind a stroke": "x/cm,y/cm,z/cm\n" + table(",", points=100 * POINTS),
    "numbers of the points first": "".join(f"{k} {row}\n" for k, row in enumerate(table(" ").splitlines())),
    "names of VeloView": "Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2,intensity\n" + table(",", more=True),
    "trailing separator": table(",").replace("\n", ",\n"),
    "Windows": table(",").replace("\n", "\r\n"),
    "order of the header": "z,y,x\n" + table(",", points=POINTS[:, ::-1]),
    "fields of points": "point.x;point.y;point.z\n" + table(";"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_texts_are_read_as_maps_and_as_recordings(tmp_path: Path, name: str):
    suffixes = (".xyz", ".txt", ".csv", ".asc", ".pts")
    path = tmp_path / f"cloud{suffixes[list(TEXTS).index(name) % len(suffixes)]}"
    path.write_text(TEXTS[name], encoding="utf-8", newline="")
    np.testing.assert_allclose(read_points(path), POINTS, atol=1e-9)
    with open_recording(path) as recording:
        np.testing.assert_allclose(recording.sweep(0).points, POINTS, atol=1e-5)
        assert any(text.startswith("x, y, z are ") for text in recording.problems)


@pytest.mark.parametrize("suffix", ["xyz", "csv", "txt"])
def test_a_folder_of_texts_plays_and_poses_next_to_them_are_poses(tmp_path: Path, suffix: str):
    for k in range(4):
        (tmp_path / f"{k}.{suffix}").write_text("x,y,z\n" + table(",", points=POINTS + k))
    (tmp_path / "poses.txt").write_text("".join(f"{0.1 * k} {k} 0 0 0 0 0 1\n" for k in range(4)))
    with open_recording(tmp_path) as recording:
        assert recording.poses is not None and len(recording.sweep_times) == 4
        np.testing.assert_allclose(recording.sweep(2).points, POINTS + 2, atol=1e-5)


def test_a_column_of_times_is_used(tmp_path: Path):
    rows = "".join(f"{x},{y},{z},{1e8 * k / 60:.0f}\n" for k, (x, y, z) in enumerate(POINTS.tolist()))
    (tmp_path / "a.csv").write_text("x,y,z,offset_time\n" + rows)
    with open_recording(tmp_path / "a.csv") as recording:
        times = recording.sweep(0).point_times
        assert times is not None and times.max() == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("lat,lon,height\n52.1,13.4,30\n52.2,13.4,30\n", "names no x among lat, lon, height"),
        ("x,y,q\n1,2,3\n", "names no z"),
        ("y,x,z\n1,2,3,4\n", "names 3 columns, and its rows have 4"),
        ("x,y\n1,2,3\n", "is not a recording"),
        ("x (mm),y (m),z (m)\n1,2,3\n", "different units"),
        ("90\n" + table(" "), "declares 90 points, and it holds 60"),
        (table(" ") + "1 2\n", "truncated: its last row has 2 columns"),
        (table(",") + "1,tree,2\n", "row 60 does not have 3 numbers"),
        ("0.1 1 2 3 0 0 0 1\n0.2 1 2 3 0 0 0 1\n", "holds poses (TUM) and no clouds: give it with --poses"),
        ("1 0 0 1 0 1 0 2 0 0 1 3\n" * 3, "holds poses (KITTI)"),
        ("#sec,nsec,x,y,z,qx,qy,qz,qw\n1,2,3,4,5,0,0,0,1\n", "holds poses"),
        ("a letter to\nsomebody who reads\n", "is not a recording"),
        ("1 2\n3 4\n", "is not a recording"),
        ("", "is empty"),
    ],
)
def test_texts_that_are_no_clouds_are_refused(tmp_path: Path, content: str, message: str):
    path = tmp_path / "cloud.csv"
    path.write_text(content)
    with pytest.raises(UserError) as caught:
        open_recording(path)
    assert message in str(caught.value) and str(path) in str(caught.value)
