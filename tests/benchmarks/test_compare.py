import importlib
import importlib.util
import json

import numpy as np
import pytest

from benchmarks.compare import LIBRARIES, main
from benchmarks.comparison.problem import make_problem, problem_config

PACKAGES = {"pytorch-mppi": "pytorch_mppi", "jax-mppi": "jax_mppi"}


def present(library: str) -> bool:
    return importlib.util.find_spec(PACKAGES[library]) is not None


@pytest.mark.parametrize("points", [1, 2000])
@pytest.mark.parametrize("library", LIBRARIES)
def test_libraries_find_the_same_costs(library: str, points: int):
    """Every library has the same costs, with a cloud and with a single point."""
    if not present(library):
        pytest.skip(f"{library} is not installed: its costs are not compared; see the extra `bench`")
    problem = make_problem(problem_config((5, 3), 8), points)
    costs = importlib.import_module(LIBRARIES[library]).nominal_costs(problem)
    np.testing.assert_allclose(costs, problem.nominal_cost, rtol=2e-5)


def test_the_problem_is_the_planners():
    problem = make_problem(problem_config((5, 3), 8), 2000)
    assert problem.guides.shape == (15, 26, 3) and problem.nominal.shape == (15, 25, 4)
    assert 50 < len(problem.cloud) < 2000
    low, high = problem.limits
    assert (problem.nominal >= np.array(low, "f4")).all() and (problem.nominal <= np.array(high, "f4")).all()
    np.testing.assert_array_equal(problem.guides[:, 0], np.tile(problem.state[:3], (15, 1)))


def test_a_missing_library_is_reported_and_the_others_run(device: str, capsys: pytest.CaptureFixture[str]):
    assert main(["--points", "2000", "--repeat", "1", "--samples", "16", "--device", device, "--json"]) == 0
    output = capsys.readouterr()
    cases = json.loads(output.out)["cases"]
    assert set(cases) == {"15 x 16", "1 x 240"}
    for rows in cases.values():
        assert set(rows) == {"aero-planner", *filter(present, LIBRARIES)}
        assert rows["aero-planner"]["ratio"] == 1.0
    for library in LIBRARIES:
        assert (f"{library} is left out" in output.err) != present(library)
    assert output.err.count("\n") == sum(not present(library) for library in LIBRARIES)
