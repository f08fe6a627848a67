"""Rows of `workbench evaluate`: figure and bound in -> printed table, JSON out."""

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One measured figure: what, how much, in what unit, the bound it has to keep (as text) and whether it does.

    `bound` is "" and `holds` is None for a figure that is only told (a baseline, a region of a larger figure).
    """

    metric: str
    value: float
    unit: str
    bound: str = ""
    holds: bool | None = None


def at_most(metric: str, value: float | int, unit: str, bound: float | int) -> Row:
    """A figure that must not exceed `bound` (same unit); NaN fails."""
    return Row(metric, float(value), unit, f"<= {bound:g}", bool(value <= bound))


def at_least(metric: str, value: float | int, unit: str, bound: float | int) -> Row:
    """A figure that must reach `bound` (same unit); NaN fails."""
    return Row(metric, float(value), unit, f">= {bound:g}", bool(value >= bound))


def within(metric: str, value: float | int, unit: str, low: float | int, high: float | int) -> Row:
    """A figure that must lie in [low, high] (same unit); NaN fails."""
    return Row(metric, float(value), unit, f"{low:g} .. {high:g}", bool(low <= value <= high))


def told(metric: str, value: float | int, unit: str) -> Row:
    """A figure without a bound: a baseline or a detail."""
    return Row(metric, float(value), unit)


def all_hold(rows: Iterable[Row]) -> bool:
    """No row breaks its bound."""
    return all(row.holds is not False for row in rows)


def format_table(rows: Iterable[Row]) -> str:
    """Rows as an aligned text table (one string, for the caller to print)."""
    mark = {True: "yes", False: "NO", None: ""}
    cells = [("metric", "value", "unit", "bound", "holds")]
    cells += [(row.metric, _number(row.value), row.unit, row.bound, mark[row.holds]) for row in rows]
    widths = [max(len(line[column]) for line in cells) for column in range(5)]
    lines = []
    for metric, value, unit, bound, holds in cells:
        line = f"{metric:<{widths[0]}}  {value:>{widths[1]}}  {unit:<{widths[2]}}  {bound:<{widths[3]}}  {holds}"
        lines.append(line.rstrip())
    lines.insert(1, "-" * (sum(widths) + 8))
    return "\n".join(lines)


def to_json(name: str, rows: Iterable[Row]) -> str:
    """`{"name", "rows": [{"metric", "value", "unit", "bound", "holds"}, ...]}`; a value that is not finite is null."""
    entries = [asdict(row) | {"value": row.value if math.isfinite(row.value) else None} for row in rows]
    return json.dumps({"name": name, "rows": entries}, indent=1)


def write_json(path: str | Path, name: str, rows: Iterable[Row]) -> None:
    """Write `to_json` to `path`; the folder is made, the file appears whole or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(to_json(name, rows), encoding="utf-8")
    part.replace(path)


def _number(value: float) -> str:
    if not math.isfinite(value):
        return str(value)
    if value == 0 or 0.001 <= abs(value) < 100_000:
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:,.0f}"
    return f"{value:.2e}"
