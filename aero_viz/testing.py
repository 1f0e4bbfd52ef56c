"""A plug-in of pytest: parameters are flown in every run of the tests, and one that flies worse than before fails.

pytest finds it by its entry point. A test takes the fixture `check_flights`; `pytest --aero-viz-update` stores how the
parameters fly now, as the baseline of later runs.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

# Every run of pytest imports this module where the package is installed; the fixture imports the rest.
if TYPE_CHECKING:
    from aero_planner.config import DroneConfig
    from aero_viz.evaluation.batching import FlightOptions
    from aero_viz.statistics import PairedComparison

_UPDATE = "--aero-viz-update"
_FEWEST = 6
"""Fewest flights of which a sign test at the 5 % level can tell that they are worse."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the flag that stores baselines."""
    group = parser.getgroup("aero-viz", "flights with AERO-Viz")
    group.addoption(_UPDATE, action="store_true", help="store the flights of check_flights as their new baselines")


@dataclass(frozen=True)
class StoredFlight:
    """A flight of a baseline."""

    seed: int
    arrived: bool
    reason: str | None
    flight_time_s: float


@pytest.fixture
def check_flights(request: pytest.FixtureRequest) -> Callable[..., PairedComparison]:
    """Return a function that flies a configuration, and fails the test if it flies worse than the stored baseline.

    Its arguments are those of `FlightCheck`.
    """
    checked: set[Path] = set()

    def check(world: str, config: str | Path | DroneConfig = "default", **options: Any) -> PairedComparison:
        flights = FlightCheck(world, config, folder=request.path.parent, **options)
        name = flights.name or re.sub(r"[^\w.]+", "-", request.node.name).strip("-")
        path = flights.folder / "baselines" / f"{name}.json"
        if path in checked:
            raise ValueError(f"{path} is the baseline of an earlier check of this test; give this one a name.")
        checked.add(path)
        return flights.run(path, update=bool(request.config.getoption(_UPDATE)))

    return check


@dataclass(frozen=True)
class FlightCheck:
    """Flights of a configuration, and their comparison with a baseline.

    Args:
        world: name of a scene, of which every flight has another world, or path of a world's file.
        config: name of a preset, path of a YAML file, or a configuration.
        folder: where relative paths begin, and baselines are.
        flights: number of flights, with the seeds `seed`, `seed` + 1, ..
        seed: first seed of worlds, LiDARs and planners.
        count: number of obstacles of a scene; None is its default.
        speed: speed limit [m/s]; None is that of the configuration.
        planner: name of the planner that a preset or a file configures.
        lidar: name of the LiDAR model.
        options: device, vehicle, rules and noise of the flights; its LiDAR, if there is one, replaces `lidar`.
        name: name of the baseline; empty for that of the test.
    """

    world: str
    config: str | Path | DroneConfig
    folder: Path
    flights: int = 20
    seed: int = 0
    count: int | None = None
    speed: float | None = None
    planner: str = "aero_mppi"
    lidar: str = "mid360"
    options: FlightOptions | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if self.flights < _FEWEST:
            raise ValueError(f"flights is {self.flights}; with fewer than {_FEWEST}, no test can tell what is worse.")

    def run(self, path: Path, *, update: bool) -> PairedComparison:
        """Fly, compare with the baseline in a file, and fail the test if fewer flights arrive, or later.

        Args:
            path: file of the baseline.
            update: store the flights as the baseline, and compare them with themselves.

        Raises:
            pytest.fail.Exception: the flights are worse, or there is no baseline for their conditions.
            UserError, ValueError: the world, the configuration or an option is wrong.
        """
        from aero_planner.output_files import whole_file
        from aero_viz.statistics import PairedComparison

        options = self._flight_options()
        conditions = self._conditions(options)
        stored = None if update else _read(path, conditions)
        flown = self._fly(options)
        if stored is None:
            path.parent.mkdir(exist_ok=True)
            rows = ",\n  ".join(json.dumps(dataclasses.asdict(flight)) for flight in flown)
            with whole_file(path) as file:
                file.write_text(f'{{\n"conditions": {json.dumps(conditions)},\n"flights": [\n  {rows}\n]\n}}\n')
            stored = flown
        comparison = PairedComparison.from_flights(stored, flown)
        if "A" in (comparison.better_by_arrivals, comparison.better_by_time):
            pytest.fail(f"{self._describe(comparison)}\nThe baseline is {path}; {_ACCEPT}.", pytrace=False)
        return comparison

    def _flight_options(self) -> FlightOptions:
        from aero_viz.evaluation.batching import FlightOptions
        from aero_viz.sensors import LIDARS

        options = self.options or FlightOptions()
        return options if options.lidar is not None else dataclasses.replace(options, lidar=LIDARS.load(self.lidar))

    def _conditions(self, options: FlightOptions) -> dict[str, Any]:
        """Return what two runs must have in common: everything but the configuration and the device."""
        own = {name: getattr(self, name) for name in ("world", "count", "seed", "flights")}
        flown = {name: value for name, value in dataclasses.asdict(options).items() if name != "device"}
        return json.loads(json.dumps(own | flown))

    def _fly(self, options: FlightOptions) -> Sequence[StoredFlight]:
        from aero_viz.catalog import load_world
        from aero_viz.evaluation.batching import default_batch
        from aero_viz.scenes import SCENES

        config, spec = self._load_config(), str(self._beside(SCENES.admit(self.world)))
        seeds = range(self.seed, self.seed + self.flights)
        worlds = {seed: load_world(spec, seed=seed, count=self.count) for seed in seeds}
        flown: list[StoredFlight] = []
        size = default_batch(options.device)
        for first in range(0, len(seeds), size):
            part = seeds[first : first + size]
            batch = options.build([worlds[seed] for seed in part], [config] * len(part), part, threads=None)
            for seed, result in zip(part, batch.run(), strict=True):
                flown.append(StoredFlight(seed, result.arrived, result.reason, round(result.flight_time_s, 3)))
            batch.close()
            if batch.interrupted:
                raise KeyboardInterrupt
        return flown

    def _load_config(self) -> DroneConfig:
        from aero_planner.config.file import config_from_name
        from aero_viz.planners.registry import config_type

        given = self.config
        config = (
            config_from_name(self._beside(given), config_type(self.planner)) if isinstance(given, str | Path) else given
        )
        return config if self.speed is None else config.replace({"vehicle.speed_limit": self.speed})

    def _beside(self, name: str | Path) -> str | Path:
        """Return the file of this name in the folder, if there is one, and otherwise the name."""
        path = self.folder / name
        return path if path.is_file() else name

    def _describe(self, comparison: PairedComparison) -> str:
        """Return what became worse."""
        text = (
            f"Flights through {self.world} are worse than before: {comparison.arrived_b} of {comparison.flights} "
            f"arrive instead of {comparison.arrived_a} (p = {comparison.p_arrival:.2g})"
        )
        if comparison.slower_by_s is not None:
            mean, low, high = comparison.slower_by_s
            text += f", in {mean:+.2f} s ({low:+.2f} to {high:+.2f} s, p = {comparison.p_time:.2g})"
        return f"{text}."


_ACCEPT = f"if this is intended, store it with pytest {_UPDATE}"


def _agree(stored: Any, present: Any) -> bool:
    """Return True if conditions are the same. A later version may have more parameters, at their defaults."""
    if isinstance(stored, dict) and isinstance(present, dict):
        return all(_agree(value, present.get(name)) for name, value in stored.items())
    return stored == present


def _read(path: Path, conditions: dict[str, Any]) -> Sequence[StoredFlight]:
    """Return the flights of a baseline.

    Raises:
        pytest.fail.Exception: there is none for these conditions, or it is damaged.
    """
    from aero_planner.user_file import read_user_text
    from aero_viz.input_limits import TEXT_MAX

    if not path.exists():
        pytest.fail(f"There is no baseline {path}; store one with pytest {_UPDATE}.", pytrace=False)
    try:
        content = json.loads(read_user_text(path, limit=TEXT_MAX))
        differing = [name for name, value in content["conditions"].items() if not _agree(value, conditions.get(name))]
        flights = [StoredFlight(**flight) for flight in content["flights"]]
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        pytest.fail(f"The baseline {path} is damaged ({error}); store it again with pytest {_UPDATE}.", pytrace=False)
    if differing:
        pytest.fail(
            f"The baseline {path} was flown with another {', another '.join(differing)}; {_ACCEPT}.", pytrace=False
        )
    return flights
