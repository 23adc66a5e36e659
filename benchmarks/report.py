"""Writes the tables of the last results into the README, between markers.

Where a line reads ``<!-- results:NAME -->``, the text up to ``<!-- /results -->`` is replaced by table NAME of
``benchmarks/results/*.json``. A table that was measured with other weights or settings than those that ship is refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.provenance import stale
from steadypose.benchmarks.results import RESULTS, load

_BLOCK = re.compile(r"(<!-- results:(?P<name>[\w-]+) -->\n).*?(<!-- /results -->)", re.DOTALL)


@dataclass(frozen=True)
class Args:
    """Write the measured tables into a Markdown file."""

    file: Path = ROOT / "README.md"
    """holds the markers"""
    results: Path = RESULTS
    """holds the JSON files"""
    stale: bool = False
    """write stale tables too, and say of each that it is"""


class StaleError(ValueError):
    """A table was measured with what no longer ships; the message says which, and how to make them anew."""


def markdown(table: Mapping[str, Any], result: Mapping[str, Any]) -> str:
    """A table as Markdown, with its note, the command that makes it, the machine, and what has changed since."""
    machine, command = result["machine"], result["command"]
    cells = [table["columns"], ["---", *["---:"] * (len(table["columns"]) - 1)], *table["rows"]]
    lines = [f"**{table['title']}**", ""]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in cells]
    lines += ["", table["note"]] if table["note"] else []
    source = f"{machine['cpu']}, {machine['cores']} cores; commit {machine['commit']}, {machine['date']}"
    if changed := stale(result):
        source += f"; **stale: measured with other {' and '.join(changed)}**"
    return "\n".join([*lines, "", f"<sub>`{command}` · {source}</sub>", ""])


def fill(text: str, results: Mapping[str, Mapping[str, Any]], allow_stale: bool = False) -> str:
    """The text with every block between markers replaced.

    Raises:
        KeyError: a marker names a table that no result holds.
        StaleError: one of them holds no longer, and that is not allowed.
    """
    tables = {t["name"]: markdown(t, r) for r in results.values() for t in r["tables"]}
    wanted = {match["name"] for match in _BLOCK.finditer(text)}
    old = [r for r in results.values() if stale(r) and wanted & {t["name"] for t in r["tables"]}]
    if old and not allow_stale:
        raise StaleError(
            "measured with other weights or settings than those that ship; run again, or pass --stale to have them "
            "marked:\n" + "\n".join(f"  {r['command']}  ({', '.join(stale(r))})" for r in old)
        )

    def block(match: re.Match[str]) -> str:
        name = match["name"]
        if name not in tables:
            raise KeyError(f"marker results:{name}: expected one of {', '.join(tables) or 'none: run a benchmark'}")
        return f"{match[1]}{tables[name]}{match[3]}"

    return _BLOCK.sub(block, text)


def main(args: Args) -> None:
    """Rewrite the file in place."""
    try:
        args.file.write_text(fill(args.file.read_text(), load(args.results), args.stale))
    except StaleError as error:
        raise SystemExit(str(error)) from error
    Console().print(f"wrote the tables of {args.file}")


if __name__ == "__main__":
    main(tyro.cli(Args))
