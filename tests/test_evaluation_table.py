"""Rows: bounds are judged rightly, the table and the JSON say the same."""

import json

import pytest

from workbench.evaluation_table import Row, all_hold, at_least, at_most, format_table, told, within, write_json


def test_bounds_are_inclusive_and_nan_never_holds():
    assert at_most("a", 1.0, "mm", 1.0).holds and not at_most("a", 1.01, "mm", 1.0).holds
    assert at_least("a", 50, "x", 50).holds and not at_least("a", 49.9, "x", 50).holds
    assert within("a", 0.5, "", 0, 1).holds and not within("a", 1.5, "", 0, 1).holds
    nan = float("nan")
    assert not any(
        row.holds for row in (at_most("a", nan, "", 1), at_least("a", nan, "", 1), within("a", nan, "", 0, 1))
    )


def test_a_told_figure_judges_nothing():
    assert told("baseline", 3.0, "ms").holds is None
    assert all_hold([told("baseline", 3.0, "ms"), at_most("a", 0, "", 1)])
    assert not all_hold([at_most("a", 2, "", 1)])


def test_table_and_json_carry_every_row(tmp_path):
    rows = [at_most("mean error", 0.12, "mm", 0.2), at_most("max", 4.0, "mm", 3.0), told("MLP", 98.0, "ms")]
    table = format_table(rows)
    assert all(row.metric in table for row in rows) and "NO" in table
    write_json(tmp_path / "deep" / "out.json", "fields", rows)
    read = json.loads((tmp_path / "deep" / "out.json").read_text())
    assert read["name"] == "fields" and [Row(**row) for row in read["rows"]] == rows
    assert not list((tmp_path / "deep").glob("*.part"))


def test_a_row_is_frozen():
    with pytest.raises(AttributeError):
        told("a", 1.0, "").value = 2.0  # type: ignore[misc]
