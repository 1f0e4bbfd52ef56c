"""Fixtures for the tests of the rig."""

import pytest

from tests.rig.companion import Companion


@pytest.fixture
def make_companion():
    companions = []

    def make_companion(**options):
        companions.append(Companion(**options))
        return companions[-1]

    yield make_companion
    for companion in companions:
        companion.autopilot.close()
        companion.socket.close()
