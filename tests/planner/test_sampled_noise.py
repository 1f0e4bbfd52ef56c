import numpy as np

from aero_planner import Planner
from aero_planner.sampled_noise import noise_of_next_plan
from tests.planner.cases import batch_of, config_of, random_case


def test_it_is_what_the_next_plan_samples(device: str):
    """In successive plans, and for drones with seeds of their own."""
    config = config_of("paper")
    planner = Planner(config, device=device, seed=[5, 2**31 + 5], batch=2)
    v, s = config.vehicle, config.sampling
    sigma = np.sqrt([s.variance_thrust, s.variance_rate_xy, s.variance_rate_xy, s.variance_rate_z])
    highest = np.array([v.thrust_max, v.rate_xy_max, v.rate_xy_max, v.rate_z_max])
    lowest = np.array([v.thrust_min, *-highest[1:]])
    drawn = []
    for _ in range(3):
        drawn.append(noise_of_next_plan(planner))
        planner.plan(*batch_of([random_case(1), random_case(2)]))
        work, shape = planner.workspace, drawn[-1].shape
        nominal = work.nominal_controls.numpy()[:, : shape[1], None]
        sampled = work.sample_controls.numpy()[..., : shape[2]].reshape(*shape[:2], *shape[3:], shape[2])
        expected = np.clip(nominal + sigma * drawn[-1], lowest, highest)
        np.testing.assert_allclose(np.moveaxis(sampled, -1, 2), expected, atol=1e-5)
    noise = np.array(drawn)
    assert abs(noise.std() - 1.0) < 0.02 and abs(noise.mean()) < 0.02
    assert not np.allclose(noise[0], noise[1]) and not np.allclose(noise[:, 0], noise[:, 1])
