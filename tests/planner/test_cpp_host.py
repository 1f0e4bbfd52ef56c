import dataclasses
import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from numpy.typing import ArrayLike

from aero_planner import Goal, Planner, PlanStatus, VehicleState
from aero_planner.deploy.export import makes_graphs, parse_architecture
from aero_planner.onboard.bundle_export import export_bundle
from aero_planner.onboard.flight_config import load_flight_config

pytestmark = pytest.mark.skipif(not makes_graphs(), reason="this Warp makes no graphs for the C++ host")

SOURCES = Path(__file__).parents[2] / "planner" / "cpp"
POINTS = 4200
"""Room for points in the exported graph: 3000 of the newest sweeps, and a fifth of the 6000 of the older ones."""

Outcome = subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example of the C++ host, built from scratch."""
    missing = [tool for tool in ("cmake", "c++") if shutil.which(tool) is None]
    if missing:
        message = f"the C++ host was not tested: {', '.join(missing)} not found; install cmake and a C++ compiler"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    build = tmp_path_factory.mktemp("build")
    options = [f"-DPython3_EXECUTABLE={sys.executable}", "-DCMAKE_COMPILE_WARNING_AS_ERROR=ON"]
    for command in (["cmake", "-S", str(SOURCES), "-B", str(build), *options], ["cmake", "--build", str(build)]):
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    return build / "aero_example"


@pytest.fixture(scope="module")
def processor(device: str) -> str:
    """The folder of a bundle's graph for the device."""
    return "cpu" if device == "cpu" else f"sm_{wp.get_device(device).arch}"


@pytest.fixture(scope="module", name="bundle")
def bundle_with_graph(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, bundle_config: Path, processor: str
) -> Path:
    """A bundle with the graph for the device."""
    if processor == "cpu":
        return request.getfixturevalue("bundle")
    path = tmp_path_factory.mktemp("bundle") / "bundle"
    manifest = export_bundle(path, config=bundle_config, architectures=[parse_architecture(processor)])
    assert manifest["graphs"] == [processor]
    return path


@pytest.fixture
def ask(example: Path, tmp_path: Path, device: str) -> Callable[..., Outcome]:
    """Run the example; its answers are then in the file `answers`."""

    def run(bundle: Path, requests: bytes, *, device: str = device) -> Outcome:
        (tmp_path / "requests").write_bytes(requests)
        command = [str(example), str(bundle), device, str(tmp_path / "requests"), str(tmp_path / "answers")]
        return subprocess.run(command, capture_output=True, text=True)

    return run


def record(
    state: VehicleState, goal: Sequence[float], points: np.ndarray, age: float = 0.0, ground: float = -np.inf
) -> bytes:
    acceleration = np.full(3, np.nan) if state.acceleration is None else state.acceleration
    floats = [state.position, state.velocity, state.quaternion, acceleration, goal, [age], [ground]]
    parts = [np.asarray(part, dtype=np.float32).tobytes() for part in floats]
    assert state.time is not None
    head = struct.pack("<d", float(np.asarray(state.time))) + b"".join(parts) + struct.pack("<i", len(points))
    return head + np.asarray(points, dtype=np.float32).tobytes()


def state_of(position: ArrayLike, velocity: ArrayLike, time: float = 0.0) -> VehicleState:
    return VehicleState(position, velocity, (1.0, 0.1, 0.0, 0.2), (0.5, 0.0, -0.5), time)


FALLING = dataclasses.replace(state_of((0, 0, 2), (1, 0, 0)), acceleration=(0.0, 0.0, -np.inf))


@pytest.fixture(scope="module")
def bundle_without_stages(tmp_path_factory: pytest.TempPathFactory, bundle_config: Path, processor: str) -> Path:
    """A bundle of the paper with few samples, and with one stage that is not carried from plan to plan."""
    folder = tmp_path_factory.mktemp("paper")
    text = bundle_config.read_text() + "preset: paper\nsampling:\n  samples: 16\nstages:\n  active: memory\n"
    (folder / "paper.yaml").write_text(text)
    architectures = [] if processor == "cpu" else [parse_architecture(processor)]
    path = folder / "bundle"
    export_bundle(path, config=folder / "paper.yaml", architectures=architectures, cpu=processor == "cpu")
    return path


@pytest.mark.parametrize("of", ["bundle", "bundle_without_stages"])
def test_its_plans_equal_those_of_python(
    ask: Callable[..., Outcome], request: pytest.FixtureRequest, of: str, tmp_path: Path, device: str
):
    bundle: Path = request.getfixturevalue(of)
    random = np.random.default_rng(4)
    config, _ = load_flight_config(bundle / "config.yaml")
    # A graph avoids the ground even if the configuration does not.
    planner = Planner(config.replace({"costs.use_ground": True}), device=device, seed=0)
    requests, expected, seen = b"", [], set()
    for tick in range(10):
        # A box around the drone leaves no way out; a cloud that is two seconds old is stale.
        low, high = ([-1, -1, -1], [1, 1, 1]) if tick == 7 else ([1.5, -8, -3], [10, 8, 4])
        points = random.uniform(low, high, (int(random.integers(0, POINTS + 1)), 3)).astype(np.float32)
        points[::50] = np.nan
        state = state_of(random.normal(size=3), random.normal(size=3), 0.05 * tick)
        if tick == 8:
            state = dataclasses.replace(state, acceleration=None)
        goal, age = [20.0, float(random.normal()), 1.0], 2.0 if tick == 4 else 0.0
        ground = -np.inf if tick % 2 else float(random.normal(-1.0, 0.3))
        plan = planner.plan(state, Goal(goal), points, cloud_age=age, ground_height=ground)
        seen.add(plan.status)
        requests += record(state, goal, points, age, ground)
        outputs = planner.outputs
        arrays = (planner.command, outputs.controls, outputs.positions, outputs.stage2_cost)
        expected.append((int(plan.status), plan.best, [array.numpy()[0].copy() for array in arrays]))
    planner.close()
    assert seen == set(PlanStatus)

    done = ask(bundle, requests)
    assert done.returncode == 0, done.stderr
    instances, steps = len(config.kinds), config.sampling.steps
    assert done.stdout.startswith(f"{instances} instances, {steps} steps, up to {POINTS} points, loaded in ")
    answers, at = (tmp_path / "answers").read_bytes(), 0
    for status, best, arrays in expected:
        assert struct.unpack_from("<ii", answers, at) == (status, best)
        at += 8
        for array in arrays:
            answer = np.frombuffer(answers, np.float32, array.size, at).reshape(array.shape)
            np.testing.assert_allclose(answer, array, rtol=1e-5, atol=1e-5)
            at += answer.nbytes
    assert at == len(answers)


def edit_target(line: int, text: str) -> Callable[[Path], None]:
    def act(graph: Path) -> None:
        lines = (graph / "target.txt").read_text().splitlines()
        lines[line] = text
        (graph / "target.txt").write_text("\n".join(lines))

    return act


def cut(graph: Path) -> None:
    path = graph / "planner.wrp"
    path.write_bytes(path.read_bytes()[:5000])


def lose_state(graph: Path) -> None:
    (graph / "state.txt").unlink()


def edit_state(line: str) -> Callable[[Path], None]:
    def act(graph: Path) -> None:
        (graph / "state.txt").write_text((graph / "state.txt").read_text() + line)

    return act


def lose_kernels(graph: Path) -> None:
    for path in graph.glob("planner_modules/*"):
        path.unlink()


REQUEST = record(state_of((0, 0, 2), (1, 0, 0)), (20, 0, 2), np.zeros((0, 3)))


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (shutil.rmtree, "target.txt can't be read; give the folder of a bundle made by 'aero-planner export'"),
        (edit_target(0, "1.14.0"), "the bundle is for Warp 1.14.0, this program for"),
        (edit_target(1, "100"), "the graph is not that of a planner for one drone"),
        (edit_target(1, "many"), "the graph is not that of a planner for one drone"),
        (lambda graph: (graph / "planner.wrp").unlink(), "planner.wrp can't be loaded"),
        (cut, "planner.wrp can't be loaded"),
        (lose_state, "state.txt can't be read; export the bundle again"),
        (edit_state("drag float16 0.0\n"), "state.txt names the type 'float16'"),
        (edit_state("absent float32 0.0\n"), "the graph is not that of a planner for one drone"),
        (lose_kernels, "copy the whole bundle"),
    ],
)
def test_a_bundle_that_does_not_fit_is_reported(
    ask: Callable[..., Outcome], bundle: Path, processor: str, tmp_path: Path, damage: Callable[[Path], object],
    problem: str,
):  # fmt: skip
    broken = shutil.copytree(bundle, tmp_path / "broken")
    damage(broken / "graph" / processor)
    done = ask(broken, REQUEST)
    assert done.returncode == 2 and problem in done.stderr


@pytest.mark.parametrize("damage", [edit_target(2, "aarch64-unknown-linux-gnu"), edit_target(3, "sse")])
def test_a_bundle_for_another_cpu_is_reported(
    ask: Callable[..., Outcome], bundle: Path, processor: str, tmp_path: Path, damage: Callable[[Path], None]
):
    if processor != "cpu":
        pytest.skip("about the CPU only")
    broken = shutil.copytree(bundle, tmp_path / "broken")
    damage(broken / "graph/cpu")
    done = ask(broken, REQUEST)
    assert done.returncode == 2 and "the bundle is for another CPU; export it again" in done.stderr


@pytest.mark.parametrize(
    ("device", "problem"),
    [
        ("gpu", "the device is 'gpu'; it must be cpu or a GPU such as cuda:0"),
        ("cuda:0x", "the device is 'cuda:0x'; it must be cpu"),
        ("cuda:99", "cuda:99 is not available; this"),
    ],
)
def test_an_unknown_or_absent_device_is_reported(example: Path, tmp_path: Path, device: str, problem: str):
    command = [str(example), str(tmp_path), device, os.devnull, os.devnull]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and problem in done.stderr


@pytest.mark.parametrize(
    ("requests", "problem"),
    [
        (record(state_of((0, np.nan, 2), (1, 0, 0)), (20, 0, 2), np.zeros((0, 3))), "the state's position or"),
        (record(FALLING, (20, 0, 2), np.zeros((0, 3))), "the state's acceleration is not finite"),
        (record(state_of((0, 0, 2), (2e6, 0, 0)), (20, 0, 2), np.zeros((0, 3))), "not finite or beyond 1e6"),
        (record(state_of((0, 0, 2), (1, 0, 0)), (np.inf, 0, 2), np.zeros((0, 3))), "the goal's position"),
        (record(state_of((0, 0, 2), (1, 0, 0), np.inf), (20, 0, 2), np.zeros((0, 3))), "the state's time is infinite"),
        (record(state_of((0, 0, 2), (1, 0, 0)), (20, 0, 2), np.zeros((0, 3)), np.nan), "the age of the cloud"),
        (record(state_of((0, 0, 2), (1, 0, 0)), (20, 0, 2), np.zeros((0, 3)), 0.0, np.nan), "the ground height"),
        (record(state_of((0, 0, 2), (1, 0, 0)), (20, 0, 2), np.zeros((POINTS + 1, 3))), "but the graph takes 0 to"),
        (record(state_of((0, 0, 2), (1, 0, 0)), (20, 0, 2), np.zeros((5, 3)))[:-4], "ends within a record"),
        (b"", "holds no request"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # test names made of bytes would be too long
)  # fmt: skip
def test_bad_inputs_are_reported(ask: Callable[..., Outcome], bundle: Path, requests: bytes, problem: str):
    done = ask(bundle, requests)
    assert done.returncode == 2 and problem in done.stderr


@pytest.mark.parametrize("cloud", [np.zeros((0, 3)), np.full((9, 3), np.nan), np.full((9, 3), 4e3)])
def test_clouds_that_show_nothing_become_stale(
    ask: Callable[..., Outcome], bundle: Path, tmp_path: Path, cloud: np.ndarray
):
    times = (0.0, 0.3, 0.6)
    done = ask(bundle, b"".join(record(state_of((0, 0, 2), (1, 0, 0), time), (20, 0, 2), cloud) for time in times))
    assert done.returncode == 0, done.stderr
    answers = (tmp_path / "answers").read_bytes()
    statuses = [struct.unpack_from("<i", answers, k * len(answers) // len(times))[0] for k in range(len(times))]
    assert statuses == [PlanStatus.OK, PlanStatus.OK, PlanStatus.STALE_CLOUD]
