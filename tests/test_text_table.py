import pytest

from aero_viz.text_table import format_size


@pytest.mark.parametrize(("size", "text"), [(0, "0.0 kB"), (12_340, "12.3 kB"), (3_400_000, "3.4 MB")])
def test_sizes_are_never_rounded_to_nothing(size: int, text: str):
    assert format_size(size) == text
