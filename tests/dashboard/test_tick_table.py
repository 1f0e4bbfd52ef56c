"""The table of ticks: its order, its views, its columns and its size."""

import numpy as np

from aero_viz.dashboard.tick_table import CAPACITY, TickTable


def filled(times: np.ndarray) -> TickTable:
    table = TickTable({"time": 0, "x": 1})
    for time in times:
        table.put({"time": float(time), "x": 10.0 * float(time)})
    return table


def test_rows_are_in_the_order_of_time_and_a_tick_that_comes_again_is_replaced():
    table = filled(np.array([0.0, 0.2, 0.1, 0.2]))
    np.testing.assert_allclose(table.rows, [[0.0, 0.0], [0.1, 1.0], [0.2, 2.0]])
    table.put({"time": 0.1, "x": -1.0})
    np.testing.assert_allclose(table.rows[:, 1], [0.0, -1.0, 2.0])
    assert table.place_of(0.2) == 2 and len(table) == 3


def test_rows_that_were_handed_out_never_change():
    table = filled(np.arange(3) * 0.1)
    before = table.rows
    kept = before.copy()
    table.put({"time": 0.1, "x": 7.0})
    table.put({"time": 0.05, "x": 8.0})
    table.split(2)
    table.put({"time": 0.9, "x": 9.0})
    np.testing.assert_array_equal(before, kept)
    assert not before.flags.writeable and table.rows[1:, 1].tolist() == [8.0, 9.0]


def test_a_later_column_is_unknown_before():
    table = filled(np.arange(2) * 0.1)
    table.put({"time": 0.2, "x": 2.0, "new": 5.0})
    assert np.isnan(table.rows[:2, 2]).all() and table.rows[2, 2] == 5.0


def test_a_long_flight_takes_no_more_memory_and_keeps_its_end():
    table = filled(np.arange(CAPACITY + 5000) * 0.02)
    assert len(table) <= CAPACITY
    assert table.rows[-1, 0] == (CAPACITY + 4999) * 0.02
    np.testing.assert_allclose(np.diff(table.rows[:, 0]), 0.02)


def test_a_tick_before_all_others_of_a_full_table_is_kept():
    table = filled(np.arange(CAPACITY) * 0.02)
    table.put({"time": -1.0, "x": 3.0})
    assert table.rows[0, 1] == 3.0
