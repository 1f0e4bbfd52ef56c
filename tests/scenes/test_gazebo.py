"""Gazebo worlds in the layout of those of FASTER (jtorde/planning_worlds_gazebo)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.scenes import World, load_map

GROUND = """<model name='ground_plane'><static>1</static><link name='link'><collision name='c'><geometry><plane>
  <normal>0 0 1</normal><size>40 30</size></plane></geometry></collision></link></model>"""


def model(name: str, geometry: str, pose: str = "0 0 0 0 0 0", *, part: str = "collision", inner: str = "") -> str:
    return f"""<model name='{name}'><pose frame=''>{pose}</pose><link name='link'>{inner}
      <{part} name='c'><geometry>{geometry}</geometry></{part}></link></model>"""


def load(tmp_path: Path, *models: str, header: str = "<?xml version='1.0'?>", **options: Any) -> World:
    path = tmp_path / "trees.world"
    text = f"{header}<sdf version='1.6'><world name='default'>{GROUND}{''.join(models)}</world></sdf>"
    path.write_text(text, encoding="utf-8")
    ends: dict[str, Any] = {"start": (-15.0, 0.0, 2.0), "goal": (15.0, 0.0, 2.0)}
    return load_map(path, **(ends | options))


CYLINDER = "<cylinder><radius>0.3</radius><length>4</length></cylinder>"
BOX = "<box><size>2 4 6</size></box>"


def test_cylinders_boxes_spheres_and_the_ground_become_solids(tmp_path: Path):
    world = load(
        tmp_path,
        model("tree", CYLINDER, "1 2 2 0 0 0"),
        model("house", BOX, "5 6 3 0 0 0.5"),
        model("ball", "<sphere><radius>0.7</radius></sphere>", "8 0 1 0 0 0"),
    )
    np.testing.assert_allclose(world.cylinders, [[1.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.3, 4.0]])
    np.testing.assert_allclose(
        world.boxes, [[5.0, 6.0, 3.0, 2.0, 4.0, 6.0, 0.5], [0.0, 0.0, -0.5, 40.0, 30.0, 1.0, 0.0]]
    )
    np.testing.assert_allclose(world.spheres, [[8.0, 0.0, 1.0, 0.7]])
    assert world.ground_height == 0.0
    assert world.name == "trees"


def test_poses_of_model_link_and_collision_follow_one_another(tmp_path: Path):
    link = "<pose>2 0 0 0 1.5707963267948966 0</pose>"
    world = load(tmp_path, model("lying", CYLINDER, "1 0 3 0 0 1.5707963267948966", inner=link))
    # The link is 2 m along the model's x axis, which is y in the world; the cylinder's axis, z, is turned to it.
    np.testing.assert_allclose(world.cylinders, [[1.0, 0.0, 3.0, 0.0, 1.0, 0.0, 0.3, 4.0]], atol=1e-9)


def test_a_tilted_box_keeps_its_exact_surface(tmp_path: Path):
    world = load(tmp_path, model("ramp", BOX, "0 0 5 0.5 0 0"))
    assert world.triangles.shape == (12, 9)
    normal = np.array([0.0, -np.sin(0.5), np.cos(0.5)])
    np.testing.assert_allclose(world.distance([np.array([0.0, 0.0, 5.0]) + 4.5 * normal]), 1.5, atol=1e-5)


def test_the_state_of_the_world_moves_and_scales_models(tmp_path: Path):
    state = """<state world_name='default'><model name='tree'><pose frame=''>7 8 3 0 0 0</pose><scale>1 2 1.5</scale>
      </model></state>"""
    world = load(tmp_path, model("tree", CYLINDER, "1 2 2 0 0 0"), state)
    np.testing.assert_allclose(world.cylinders, [[7.0, 8.0, 0.0, 0.0, 0.0, 1.0, 0.6, 6.0]])


def test_without_collision_geometry_the_visual_one_counts(tmp_path: Path):
    assert len(load(tmp_path, model("tree", CYLINDER, part="visual")).cylinders) == 1


def test_start_and_goal_across_lie_at_the_ends_of_the_longest_side(tmp_path: Path):
    trees = [model(f"{x}{y}", CYLINDER, f"{x} {y} 2 0 0 0") for x in range(0, 31, 6) for y in (-4, 4)]
    world = load(tmp_path, *trees, start=None, goal=None, across=True)
    assert world.start[0] < 4.0
    assert world.goal[0] > 26.0
    assert world.distance([world.start, world.goal]).min() > 0.7


def test_what_is_no_primitive_is_left_out_with_a_message(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    mesh = model("wall", "<mesh><uri>file:///etc/passwd</uri></mesh>")
    assert len(load(tmp_path, mesh, model("tree", CYLINDER)).cylinders) == 1
    assert "1 of the kind mesh" in caplog.text
    with pytest.raises(UserError, match="has no cylinders, boxes or spheres, only 1 of the kind mesh"):
        load(tmp_path, mesh)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<!DOCTYPE sdf [<!ENTITY a 'b'>]>", "defines entities"),
        ("<!DOCTYPE sdf SYSTEM 'file:///etc/passwd'>", "document type"),
    ],
)
def test_definitions_of_entities_are_refused(tmp_path: Path, text: str, message: str):
    with pytest.raises(UserError, match=message):
        load(tmp_path, model("tree", CYLINDER), header=text)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<cylinder><radius>thick</radius><length>4</length></cylinder>", "'tree'.*radius of its cylinder is 'thick'"),
        ("<cylinder><length>4</length></cylinder>", "radius of its cylinder is ''"),
        ("<box><size>1 2</size></box>", "must have 3 finite numbers"),
        ("<box><size>1 2 nan</size></box>", "must have 3 finite numbers"),
        ("<cylinder><radius>-1</radius><length>4</length></cylinder>", "radius = -1"),
        ("<a>" * 200 + "</a>" * 200, "nested more than 100 deep"),
        ("<box>", "not XML: mismatched tag in line"),
    ],
)
def test_damaged_values_are_named(tmp_path: Path, content: str, message: str):
    with pytest.raises(UserError, match=message):
        load(tmp_path, model("tree", content))


def test_other_xml_is_refused(tmp_path: Path):
    (tmp_path / "x.world").write_text("<html/>", encoding="utf-8")
    with pytest.raises(UserError, match="outermost element is <html>, not <sdf>"):
        load_map(tmp_path / "x.world")
