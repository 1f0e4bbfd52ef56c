import pytest

from aero_planner.config import VehicleConfig
from aero_planner.onboard.connections import open_lidar, open_link
from aero_planner.onboard.settings import OnboardConfig

FREE = OnboardConfig().replace({"mavlink.url": "udpin:127.0.0.1:0", "lidar.host": "127.0.0.1", "lidar.port": 0})


def test_a_name_without_an_address_is_blamed_on_its_own_setting():
    config = FREE.replace({"mavlink.goal_senders": "vehicle,255@nosuch.invalid", "lidar.sensor": "nosuch.invalid"})
    with pytest.raises(OSError, match=r"^can't find the address of nosuch\.invalid \(mavlink\.goal_senders\): .*;"):
        open_link(config, VehicleConfig())
    with pytest.raises(OSError, match=r"^can't find the address of nosuch\.invalid \(lidar\.sensor\): .*; correct"):
        open_lidar(config)


def test_names_with_an_address_are_accepted():
    config = FREE.replace({"mavlink.goal_senders": "255@localhost", "lidar.sensor": "localhost"})
    open_link(config, VehicleConfig()).close()
    open_lidar(config).close()


def test_a_connection_that_cannot_be_opened_is_blamed_on_the_url():
    config = FREE.replace({"mavlink.url": "udpout:nosuch.invalid:14540"})
    with pytest.raises(OSError, match=r"udpout:nosuch\.invalid:14540 \(mavlink\.url\): .* or correct the URL"):
        open_link(config, VehicleConfig())
