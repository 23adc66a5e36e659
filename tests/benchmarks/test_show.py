import json

import pytest
from rich.console import Console

from steadypose.benchmarks.results import RESULTS, Table, show

TABLES = [
    pytest.param(Table(**table), id=f"{file.stem}-{table['name']}")
    for file in sorted(RESULTS.glob("*.json"))
    for table in json.loads(file.read_text()).get("tables", [])
]


def printed(table: Table) -> list[str]:
    console = Console(width=80)
    with console.capture() as capture:
        show(table, console)
    return capture.get().splitlines()


@pytest.mark.parametrize("table", TABLES)
def test_no_figure_is_broken(table: Table) -> None:
    lines = printed(table)
    assert max(map(len, lines)) <= 80
    for cell in {cell for row in table.rows for cell in row[1:]}:
        assert any(cell in line for line in lines), cell
    assert " ".join(table.note.split()) in " ".join(" ".join(lines).split())


def test_a_group_of_methods_is_named_once() -> None:
    rows = [["1 cm: a", "1", "2"], ["1 cm: b", "3", "4"], ["2 cm: a", "5", "6"]]
    lines = [line.rstrip() for line in printed(Table("t", "of noise", ["method", "x", "y"], rows))]
    assert lines[1:-1] == ["method  x  y", "1 cm", "  a     1  2", "  b     3  4", "2 cm", "  a     5  6"]


def test_columns_that_do_not_fit_follow_below() -> None:
    table = Table(
        "t", "wide", ["method", *(f"c{k}" for k in range(12))], [["a", *("123 (100–140)" for _ in range(12))]]
    )
    heads = [line.split() for line in printed(table) if line.startswith("method")]
    assert sum(map(len, heads)) == 12 + len(heads)
