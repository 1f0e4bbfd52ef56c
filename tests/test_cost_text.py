"""Costs as text."""

import pytest

from aero_viz.cost_text import cost_text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (6.929e-09, "0.000"), (-0.0123, "-0.012"), (0.5, "0.5"), (412.36, "412.4"), (9999.4, "9999"),
     (10660.4, "10660"), (1.9033669e6, "1903367")],
)  # fmt: skip
def test_a_cost_has_four_digits_and_no_power_of_ten(value: float, text: str):
    assert cost_text(value) == text
