from rich.console import Console

from steadypose.benchmarks.results import Table, show


def test_a_row_is_in_one_line_however_narrow_the_console() -> None:
    row = ["1 cm: a", *(f"{k} (100–140)" for k in range(12))]
    console = Console(width=40)
    with console.capture() as capture:
        show(Table("t", "wide", ["method", *(f"column {k}" for k in range(12))], [row], "A note."), console)
    title, columns, line, note, *_ = capture.get().splitlines()
    assert (title, note) == ("wide", "A note.")
    assert columns.split("  ")[0] == "method"
    assert [cell for cell in line.split("  ") if cell.strip()] == row
