"""The protocol of a planner."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import DroneConfig, ParameterInfo, PlannerConfig
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import CandidatePlan, Plan


class PlannerError(RuntimeError):
    """A planner could not plan. It ends the flight with its text, but not the session."""


class Planner(ABC):
    """Plans from observations, one drone at a time. A derived class needs `plan` and, for parameters, a `Config`.

    Everything in the workbench that takes a configuration makes the planner of its class. A configuration knows its
    planner from `Config.planner`; unless that is given, it is the derived class, which must lie in the module of
    `Config` if flights run in other processes.

    Args:
        config: parameters; None is the default.
        device: Warp device that the planner may use.
        seed: seed of whatever is random. Same seed, observations and history: same plans.
    """

    Config: ClassVar[type[DroneConfig]] = DroneConfig
    """Class of the configuration, whose sections hold the planner's parameters."""
    samples: bool = False
    """True if plans should hold samples, where the planner has any."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "Config" not in vars(cls):
            cls.Config = type(
                "Config", (cls.Config,), {"__module__": cls.__module__, "__qualname__": f"{cls.__qualname__}.Config"}
            )
        if "planner" not in vars(cls.Config):
            cls.Config.planner = f"{cls.__module__}:{cls.__qualname__}"
        if "listing" not in vars(cls.Config) and cls.Config.planner != PlannerConfig.planner:
            cls.Config.listing = f"aero-viz parameters --planner {cls.Config.planner}"

    def __init__(self, config: DroneConfig | None = None, *, device: str = "cpu", seed: int = 0) -> None:
        self.config = self.Config() if config is None else config
        """Configuration in use."""
        self.device, self.seed = device, seed

    @classmethod
    def parameters(cls) -> tuple[ParameterInfo, ...]:
        """Return every parameter; sliders, flags and files derive from them."""
        return cls.Config.parameters()

    @abstractmethod
    def plan(self, observation: Observation) -> Plan:
        """Plan once.

        Raises:
            Exception: of any kind; it ends the flight with its text, see `attempt`.
        """

    def attempt(self, observation: Observation) -> Plan:
        """Return `plan(observation)`.

        Raises:
            PlannerError: it failed, for whatever reason.
        """
        try:
            return self.plan(observation)
        except PlannerError:
            raise
        except Exception as error:
            raise PlannerError(f"The planner failed: {type(error).__name__}: {error}") from error

    def configure(self, config: DroneConfig) -> None:
        """Use another configuration from the next plan on; raises ValueError if it cannot be used."""
        self.config = config

    def history(self) -> Any:
        """Return the state that the next plan builds on, which never changes; None if there is none."""
        return None

    def restore(self, history: Any) -> None:
        """Continue from `history`, which may be that of another planner: then start over."""
        return None

    def reset(self, *, seed: int | None = None) -> None:
        """Start over, with another seed if one is given."""
        self.seed = self.seed if seed is None else seed

    def judge(self, plan: Plan) -> NDArray[np.bool_] | None:
        """Return which candidates of the last plan are safe, shape [M]; None if that is unknown."""
        return plan.is_safe if isinstance(plan, CandidatePlan) else None

    def interrupt(self) -> None:
        """End a plan that waits for something, from any thread; the planner is closed afterwards."""
        return None

    def close(self) -> None:
        """Release processes, threads and device memory."""
        return None
