"""Results of a study in one JSON file: tables to read, and figures for programs."""

from __future__ import annotations

import csv
import json
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table as RichTable

from steadypose.benchmarks.provenance import RESULTS, ROOT, code, machine, measured, require_committed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES = ROOT / "docs" / "images"  # folder of the studies' pictures, which docs/results/ shows
READINGS = RESULTS / "test-readings.csv"
"""Log of every scoring of the test split. A split that is read often is being used for choices: if you change something
after a reading, write the change into the last column."""

NONE = "–"  # text of a table's cell where a method has no estimate


@dataclass(frozen=True)
class Table:
    """A table of a result. The first column is text, the others are figures."""

    name: str  # name in the markers between which the table is written
    title: str  # what is measured, with units
    columns: list[str]  # headers
    rows: list[list[str]]  # cells, ready to print
    note: str = ""  # conditions that a reader must know

    @classmethod
    def of(
        cls, name: str, title: str, records: Iterable[Mapping[str, Any]], cells: Mapping[str, str], note: str = ""
    ) -> Table:
        """Build a table with a row for each record; ``cells`` are the columns' formats, such as ``{mm:.1f}``, by
        header."""
        rows = [[cell.format_map(record) for cell in cells.values()] for record in records]
        return cls(name, title, list(cells), rows, note)


@dataclass(frozen=True)
class Result:
    tables: list[Table]  # tables to read; the first is printed first
    data: dict[str, Any]  # figures for programs
    figures: Mapping[str, Figure] = field(default_factory=dict)  # plots by file name
    wrong: Sequence[str] = ()  # violated requirements, a line each; the command then fails


def show(table: Table, console: Console) -> None:
    """Print a table, each row in one line, however narrow the console."""
    grid = RichTable(box=None, pad_edge=False, header_style="bold")
    for number, column in enumerate(table.columns):
        grid.add_column(column, justify="right" if number else "left", no_wrap=True)
    for row in table.rows:
        grid.add_row(*row)
    wide = Console(width=1000)
    with wide.capture() as lines:
        wide.print(grid)
    console.print(f"{table.title}\n{lines.get()}", soft_wrap=True, markup=False, highlight=False, end="")
    if table.note:
        console.print(table.note, style="dim", highlight=False)
    console.print()


def save(
    name: str,
    command: Sequence[str],
    tables: Sequence[Table],
    data: Mapping[str, Any],
    study: ModuleType,
    directory: Path = RESULTS,
) -> Path:
    """Write ``NAME.json``: the command, the machine, what the module ``study`` measured, the tables, and ``data``.

    Raises:
        UncommittedError: see `require_committed`, which you should call before measuring.
    """
    require_committed(directory)
    path = directory / f"{name}.json"
    content = {"benchmark": name, "command": shlex.join(command), "machine": machine()}
    content |= {"measured": measured(study.DEPENDS_ON), "code": code(study.__name__.removeprefix("steadypose."))}
    content |= {"tables": [asdict(t) for t in tables], **data}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_nan_to_null(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return path


def load(directory: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Return all results by the study's name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(directory.glob("*.json"))}


def log_reading(study: str) -> None:
    """Append a line to `READINGS` before this study scores the test split, whether or not it completes."""
    now = machine()
    READINGS.parent.mkdir(parents=True, exist_ok=True)
    new = not READINGS.is_file()
    with READINGS.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(["date", "commit", "study", "what followed"])
        writer.writerow([now["date"], now["commit"], study, ""])


def _nan_to_null(value: Any) -> Any:
    """Return the value with None for NaN, which JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _nan_to_null(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_nan_to_null(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
