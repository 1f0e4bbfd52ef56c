"""What holds for every stage: one that is not active is as if it did not exist, and one is easily added."""

import ast
import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import aero_planner
from aero_planner import Planner, PlannerConfig, registry
from aero_planner.array_memory import array_specs
from aero_planner.arrays import CloudArrays, PlannerInputs, PlannerOutputs, Workspace
from aero_planner.composition import Composition
from aero_planner.device.kernel_tuning import CPU, CUDA, KernelTuning
from aero_planner.kernels.terms import write_terms
from aero_planner.stage import Stage
from tests.planner.stages.sequence import config_with, description, digest, recorded, sequence

ROOT = Path(__file__).parents[3]
NAMES = tuple(registry.STAGES)
STAGES: dict[str, Stage] = {name: registry.load_stage(name) for name in NAMES}


def others(name: str) -> tuple[str, ...]:
    return tuple(other for other in NAMES if other != name)


def run(code: str, *arguments: str, path: Path | None = None) -> str:
    """Return what Python code prints in a process of its own, which may also import from `path`."""
    paths = [str(ROOT), *filter(None, [str(path or ""), os.environ.get("PYTHONPATH", "")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


# A stage that is not active.

WITHOUT = """
import sys
from aero_planner import registry
device, missing = sys.argv[1], sys.argv[2].split()
for name in missing:
    del registry.STAGES[name]
from aero_planner import Planner, PlannerConfig
assert not set(missing) & set(PlannerConfig.sections())
from aero_planner.device.kernel_tuning import CPU, CUDA
from tests.planner.stages.sequence import config_with, description, digest, sequence
active = registry.names("stages")
print(description(active, CPU), description(active, CUDA))
if not active:
    print(digest(sequence(Planner(config_with(active), device=device, seed=3))))
"""
"""What a planner for which some stages do not exist records; its plans, if there are no stages at all."""


@pytest.mark.parametrize("name", NAMES)
def test_a_stage_that_is_not_active_is_as_if_it_did_not_exist(name: str):
    """The launches, their kernels and the arrays are the same, so that the plans are."""
    expected = [description(others(name), tuning) for tuning in (CPU, CUDA)]
    assert run(WITHOUT, "cpu", name).split() == expected
    assert expected != [description(NAMES, tuning) for tuning in (CPU, CUDA)] or name == "memory"


def test_without_active_stages_plans_are_bit_for_bit_as_if_there_were_none(device: str):
    planner = Planner(config_with(()), device=device, seed=3)
    assert run(WITHOUT, device, " ".join(NAMES)).split()[-1] == digest(sequence(planner))
    assert digest(sequence(Planner(config_with(NAMES), device=device, seed=3))) != digest(sequence(planner))


@pytest.mark.parametrize("tuning", [CPU, CUDA], ids=["cpu", "cuda"])
@pytest.mark.parametrize("name", NAMES)
def test_a_stage_that_is_not_active_records_and_allocates_nothing(name: str, tuning: KernelTuning):
    (on, shapes), (off, other_shapes) = (recorded(config_with(active), tuning) for active in (NAMES, others(name)))
    package = f"aero_planner.stages.{name}."
    own = [kernel for kernel in on if kernel.func.__module__.startswith(package)]
    assert len(off) == len(on) - len(own) and bool(own) == bool(STAGES[name].launches)
    assert not [kernel.key for kernel in off if kernel.func.__module__.startswith(package)]
    declared = [group for group in (STAGES[name].arrays, STAGES[name].outputs) if group is not None]
    assert set(shapes) - set(other_shapes) == {array for group in declared for array in array_specs(group)}


def test_the_arrays_of_a_stage_can_be_read_while_it_is_active(device: str):
    planner = Planner(config_with(NAMES), device=device)
    assert set(planner.arrays_of("way_out")) == {
        "places", "place_count", "place_goal", "place_nearest", "place_idle", "goal_hidden", "nearest_place"
    }  # fmt: skip
    assert {"scan", "dynamic_count"} < set(planner.arrays_of("moving_obstacles"))
    planner.configure(config_with(()))
    with pytest.raises(ValueError, match=r"stage 'way_out' is not active; stages\.active lists none"):
        planner.arrays_of("way_out")


@pytest.mark.parametrize("tuning", [CPU, CUDA], ids=["cpu", "cuda"])
@pytest.mark.parametrize("batch", [1, 8])
@pytest.mark.parametrize("model", registry.names("models"))
def test_no_kernel_takes_more_than_14_arguments(tuning: KernelTuning, batch: int, model: str):
    kernels, _ = recorded(config_with(NAMES).replace({"vehicle.model": model}), tuning, batch=batch)
    composition = Composition.of(config_with(NAMES))
    counts = {kernel.key: len(kernel.adj.args) for kernel in [*kernels, write_terms(tuning, composition)]}
    assert len(counts) > 25 and max(counts.values()) <= 14, counts


def test_no_kernel_of_any_module_takes_more_than_14_arguments():
    for module in pkgutil.walk_packages(aero_planner.__path__, "aero_planner."):
        if module.name.split(".")[1] in ("kernels", "stages", "device", "costs", "models", "reference"):
            content = vars(importlib.import_module(module.name)).values()
            counts = {kernel.key: len(kernel.adj.args) for kernel in content if isinstance(kernel, wp.Kernel)}
            assert max(counts.values(), default=0) <= 14, counts


# What the core knows.

CORE = [
    "planner.py", "pipeline.py", "arrays.py", "recorder.py", "composition.py", "history.py", "cloud_launches.py",
    "sweep_memory.py", "plan_outputs.py", "cost_terms.py", "array_memory.py", "launch_sequence.py", "sampled_noise.py",
    "config/planner_config.py", "config/sections", "kernels", "device", "costs", "models",
]  # fmt: skip


def core_modules() -> list[Path]:
    package = Path(aero_planner.__file__).parent
    return [path for name in CORE for path in (sorted((package / name).glob("*.py")) or [package / name])]


def words_of(tree: ast.AST) -> set[str]:
    """Return the modules that code imports, its texts, and the names whose fields it reads, with the fields."""
    words: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                words |= {alias.name for alias in names}
            case ast.ImportFrom(module=module, names=names):
                words |= {f"{module}.{alias.name}" for alias in names}
            case ast.Constant(value=str(text)):
                words.add(text)
            case ast.Attribute():
                words.add(ast.unparse(node))
    return words


@pytest.mark.parametrize("path", core_modules(), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_the_core_knows_no_stage(path: Path):
    """It imports none, names none, reads no parameter of one, and has none of its arrays."""
    words = words_of(ast.parse(path.read_text()))
    assert not [word for word in words if word.startswith("aero_planner.stages")]
    core = {name for kind in (PlannerInputs, PlannerOutputs, Workspace, CloudArrays) for name in array_specs(kind)}
    for name, stage in STAGES.items():
        declared = [kind for kind in (stage.arrays, stage.outputs) if kind is not None]
        arrays = {array for kind in declared for array in array_specs(kind)}
        parameters = {info.name for info in PlannerConfig.parameters() if info.section == name}
        known = {f"config.{name}", f"views.{name}", f"self._config.{name}", f"hooks.{name}"}
        known |= {f"{owner}.{parameter}" for owner in ("c", "params", "params[b]") for parameter in parameters}
        known |= {f"{name}.{parameter}" for parameter in parameters} | arrays | (set(STAGES) - core)
        assert not known & words, f"{path.name} knows of {name}"
        assert not [word for word in words if any(word.endswith(f".{array}") for array in arrays)]


def test_live_parameters_have_names_of_their_own():
    """Kernels read them by name, whatever their section."""
    names = [info.name for info in PlannerConfig.parameters() if info.live]
    assert len(names) == len(set(names))


# A new stage.

SHY = {
    "__init__.py": '"""Stays away from a place."""',
    "parameters.py": """
from dataclasses import dataclass
from aero_planner.parameters import ParameterSection, live

@dataclass(frozen=True)
class Parameters(ParameterSection, section="shy"):
    q_shy: float = live(50.0, "1/m", 0.0, 1e4, "Weight of being near the place.", label="Shyness")
    distance_shy: float = live(2.0, "m", 0.0, 10.0, "Distance that the drone keeps from it.", label="Distance")
""",
    "stage.py": """
from dataclasses import dataclass
from typing import Any
import numpy as np
import warp as wp
from aero_planner.array_memory import array
from aero_planner.costs import CostTerm, End
from aero_planner.device.params import Params
from aero_planner.stage import Hooks, Stage

@wp.struct
class Shyness:
    plans: wp.array(dtype=int)
    place: wp.array(dtype=wp.vec3)
    position: wp.array(dtype=wp.vec3)

@dataclass(eq=False)
class Arrays:
    plans: wp.array = array(wp.int32, "B", "", "Number of plans so far.", kept="plans")
    place: wp.array = array(wp.vec3, "B", "m", "The place: where the drone first was.", kept="plans")

@dataclass(eq=False)
class Outputs:
    shyness: wp.array = array(wp.float32, "B Z", "", "Number of plans, twice.")

@wp.kernel
def remember(position: wp.array(dtype=wp.vec3), views: Shyness, out: wp.array2d(dtype=float)):
    b = wp.tid()
    if views.plans[b] == 0:
        views.place[b] = position[b]
    views.plans[b] = views.plans[b] + 1
    for i in range(out.shape[1]):
        out[b, i] = float(views.plans[b])

@wp.func
def shy_cost(e: End, views: Any, c: Any) -> float:
    return c.q_shy * wp.length(e.p - views.shy.place[e.b])

@wp.func
def keep_away(d: float, x: wp.vec3, time: float, b: int, views: Any, c: Any) -> float:
    return wp.min(d, wp.max(wp.length(x - views.shy.place[b]) - c.distance_shy, 0.0))

def _remember(r):
    arrays = r.stage_arrays("shy")
    out = r.arrays.of_stages["shy"][1].shyness
    inputs = [r.inputs.position, r.view("shy")]
    return [[[r.record(remember, (r.sizes.B,), inputs=inputs, outputs=[out])]]]

STAGE = Stage(
    name="shy", label="Shyness", arrays=Arrays, outputs=Outputs, view=Shyness, symbols=lambda rows, columns: {"Z": 2},
    reports={"shyness": lambda values, config, batched: values["shyness"] if batched else values["shyness"][0]},
    hooks=Hooks(clearance=keep_away), terms=(CostTerm("shyness", "shyness", terminal=shy_cost),),
    launches={"start": _remember},
)
""",
}

PLAN_SHYLY = """
import sys
import shy
from aero_planner import registry
registry.add("stages", "shy", shy if sys.argv[2] == "module" else "shy")
import numpy as np
from aero_planner import Planner, PlannerConfig
from tests.planner.cases import random_case
config = PlannerConfig().replace({"sampling.samples": 16, "stages.active": "shy", "costs.distance_max": 4.0})
assert config.shy.q_shy == 50.0 and config.find("shy.q_shy").label == "Shyness"
assert "shy" in PlannerConfig().stages.names
planner, case = Planner(config, device=sys.argv[1]), random_case(0, count=0)
plan = case.plan(planner)
np.testing.assert_array_equal(plan.shyness, [1.0, 1.0])
ends = np.linalg.norm(plan.positions[:, -1] - case.position, axis=1)
terms = planner.cost_terms(range(len(plan.kinds)))
shyness = terms.values[:, [term.name for term in terms.terms].index("shyness"), -1]
np.testing.assert_allclose(shyness, 50.0 * ends, rtol=1e-4)
np.testing.assert_allclose(terms.stage2_cost, plan.stage2_cost, rtol=1e-5)
distance = np.linalg.norm(plan.positions[:, 1:] - case.position, axis=-1)
np.testing.assert_allclose(plan.clearance, np.clip(distance - 2.0, 0.0, 4.0), atol=1e-4)
planner.configure(config.replace({"shy.distance_shy": 0.0, "shy.q_shy": 0.0}))
history = planner.history()
assert history.arrays["plans"].tolist() == [1] and np.allclose(history.arrays["place"][0], case.position)
free = random_case(0, count=0).plan(planner)
assert planner.history().arrays["plans"].tolist() == [2] and not np.array_equal(free.controls, plan.controls)
planner.restore(history)
assert planner.history().arrays["plans"].tolist() == [1]
planner.reset()
assert planner.history().arrays["plans"].tolist() == [0]
off = Planner(config.replace({"stages.active": ""}), device=sys.argv[1])
try:
    case.plan(off).shyness
except AttributeError as error:
    print(error)
"""


@pytest.mark.parametrize("part", ["module", "name"])
def test_a_stage_is_added_by_one_folder_and_one_line(device: str, tmp_path: Path, part: str):
    (tmp_path / "shy").mkdir()
    for name, code in SHY.items():
        (tmp_path / "shy" / name).write_text(code)
    assert run(PLAN_SHYLY, device, part, path=tmp_path) == "a plan has no attribute 'shyness'"


ALTITUDE = """
from dataclasses import dataclass
from typing import Any
import warp as wp
from aero_planner.costs import CostTerm, Step
from aero_planner.parameters import ParameterSection, live

@dataclass(frozen=True)
class Parameters(ParameterSection, section="altitude"):
    q_altitude: float = live(7.0, "1/m", 0.0, 1e3, "Weight of the height.")

@wp.func
def height(s: Step, c: Any) -> float:
    return c.q_altitude * wp.abs(s.p[2])

TERM = CostTerm("altitude", "altitude", running=height, parameters=Parameters)
"""

PLAN_LOW = """
import sys
from aero_planner import registry
registry.add("cost_terms", "altitude", "altitude:TERM")
import numpy as np
from aero_planner import Planner, PlannerConfig
from tests.planner.cases import random_case
off = PlannerConfig.preset("paper").replace({"sampling.samples": 16, "altitude.q_altitude": 0.0})
config, case = off.replace({"altitude.q_altitude": 7.0}), random_case(0, count=0)
planner = Planner(config, device=sys.argv[1])
plan = case.plan(planner)
terms = planner.cost_terms([2], [(2, 5)])
values = terms.values[:, [term.name for term in terms.terms].index("altitude")]
np.testing.assert_allclose(values, 7.0 * np.abs(terms.positions[:, :, 2]), rtol=1e-5)
np.testing.assert_allclose(terms.stage2_cost[0], plan.stage2_cost[2], rtol=1e-5)
np.testing.assert_allclose(terms.stage1_cost[1], plan.stage1_cost[2, 5], rtol=1e-5)
assert not np.array_equal(case.plan(Planner(off, device=sys.argv[1])).controls, plan.controls)
try:
    registry.add("cost_terms", "late", None)
except ValueError as error:
    print(error)
"""


def test_a_cost_term_is_added_by_one_line(device: str, tmp_path: Path):
    (tmp_path / "altitude.py").write_text(ALTITUDE)
    expected = "'late' comes too late: add it before anything imports aero_planner.config or Planner."
    assert run(PLAN_LOW, device, path=tmp_path) == expected


CLASH = """
from dataclasses import dataclass
from aero_planner import registry
from aero_planner.costs import CostTerm
from aero_planner.parameters import ParameterSection, live

@dataclass(frozen=True)
class Parameters(ParameterSection, section="altitude"):
    dt: float = live(7.0, "1/m", 0.0, 1e3, "Another dt.")

registry.add("cost_terms", "altitude", CostTerm("altitude", "altitude", parameters=Parameters))
try:
    registry.add("stages", "memory", "memory")
except ValueError as error:
    print(error)
try:
    from aero_planner.device.params import Params
except ValueError as error:
    print(error)
"""


def test_parts_that_clash_are_refused():
    assert run(CLASH).splitlines() == [
        "stages has 'memory' already; give another name.",
        "sampling.dt and altitude.dt have the same name; kernels read live parameters by it: rename one of them.",
    ]


BUILT_ON = """
import dataclasses
from aero_planner import registry
from aero_planner.costs.terms import goal_position_cost
from aero_planner.models.acceleration import ACCELERATION
from aero_planner.models.ctbr import CTBR

registry.add("models", "mine", dataclasses.replace(ACCELERATION, name="mine", label="Mine"))
from aero_planner import PlannerConfig
print(PlannerConfig().replace({"vehicle.model": "mine"}).vehicle.model)
"""


def test_what_is_brought_may_build_on_what_ships():
    """Models and terms that ship do not import the configuration, which imports what is brought."""
    assert run(BUILT_ON) == "mine"


# The history.


@pytest.mark.parametrize("active", [NAMES, ()], ids=["all", "none"])
def test_the_history_makes_the_next_plans_repeatable(device: str, active: tuple[str, ...]):
    """In the same planner, and in another one. It holds all arrays that are declared as state."""
    config = config_with(active)
    planner, other = (Planner(config, device=device, seed=3) for _ in range(2))
    sequence(planner, ticks=3)
    history = planner.history()
    groups = [Workspace, *(STAGES[name].arrays for name in active)]
    specs = {array: spec for group in groups if group is not None for array, spec in array_specs(group).items()}
    assert set(history.arrays) == {array for array, spec in specs.items() if spec.kept == "plans"}
    first = sequence(planner, ticks=3)
    planner.restore(history)
    assert digest(sequence(planner, ticks=3)) == digest(first)
    other.restore(history)
    for name, array in other.history().arrays.items():
        np.testing.assert_array_equal(array, history.arrays[name], err_msg=name)
    assert digest(sequence(other, ticks=3)) == digest(first)
    other.reset()
    assert digest(sequence(other, ticks=3)) != digest(first)


def test_a_history_with_other_stages_resets_the_planner(device: str):
    donor = Planner(config_with(NAMES), device=device, seed=3)
    planner, fresh = (Planner(config_with(()), device=device, seed=3) for _ in range(2))
    sequence(donor, ticks=2)
    sequence(planner, ticks=2)
    planner.restore(donor.history())
    assert digest(sequence(planner, ticks=2)) == digest(sequence(fresh, ticks=2))
