"""Writes what was measured where people read it: tables between the README's markers, and all of them on one page.

Where the README reads ``<!-- results:NAME -->``, the text up to ``<!-- /results -->`` is replaced by table NAME of
``benchmarks/results/*.json``. A table that was measured with other weights, settings or code than those of today is
refused, unless `stale.STALE` lists it with a reason; it is then marked.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from steadypose.benchmarks.provenance import ROOT, stale
from steadypose.benchmarks.results import RESULTS, load
from steadypose.benchmarks.stale import STALE

_BLOCK = re.compile(r"(<!-- results:(?P<name>[\w-]+) -->\n).*?(<!-- /results -->)", re.DOTALL)


HOW = """# Results

Every table of `benchmarks/results/*.json`, written by `python -m steadypose.benchmarks.report`. Under each stand the
command that makes it, the machine, the commit and the day. *Stale* marks what was measured with other weights, settings
or code than those of today. Positions are in millimetres, accelerations in mm/frame² at 30 Hz; a delay is in frames of
30 Hz. Baselines are tuned on every third of the clips that are scored, with other noise; steadypose runs as it ships
and has nothing to tune.
"""


@dataclass(frozen=True)
class Args:
    """Write the measured tables into the README and docs/results.md."""

    readme: Path = ROOT / "README.md"
    """holds the markers"""
    page: Path = ROOT / "docs" / "results.md"
    """is written anew"""
    results: Path = RESULTS
    """holds the JSON files"""


class StaleError(ValueError):
    """A table was measured with what is no longer there; the message says which, and how to make them anew."""


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
    if "frozen" in result:
        source += f"; a finished study, whose code is at commit {result['frozen']}"
    return "\n".join([*lines, "", f"<sub>`{command}` · {source}</sub>", ""])


def fill(text: str, results: Mapping[str, Mapping[str, Any]], excuses: Mapping[str, str] = STALE) -> str:
    """The text with every block between markers replaced.

    Raises:
        KeyError: a marker names a table that no result holds.
        StaleError: one of them is stale, without an excuse.
    """
    tables = {t["name"]: markdown(t, r) for r in results.values() for t in r["tables"]}
    wanted = {match["name"] for match in _BLOCK.finditer(text)}
    old = [
        r
        for name, r in results.items()
        if name not in excuses and wanted & {t["name"] for t in r["tables"]} and stale(r)
    ]
    if old:
        raise StaleError(
            "measured with other weights, settings or code than today's; run again, or list in stale.py:\n"
            + "\n".join(f"  {r['command']}  ({', '.join(stale(r))})" for r in old)
        )

    def block(match: re.Match[str]) -> str:
        name = match["name"]
        if name not in tables:
            raise KeyError(f"marker results:{name}: expected one of {', '.join(tables) or 'none: run a benchmark'}")
        return f"{match[1]}{tables[name]}{match[3]}"

    return _BLOCK.sub(block, text)


def page(results: Mapping[str, Mapping[str, Any]]) -> str:
    """All tables, by benchmark."""
    parts = [HOW]
    for name, result in results.items():
        parts.append(f"\n## {name.replace('_', ' ').capitalize()}\n")
        parts += [f"\n{markdown(table, result)}" for table in result["tables"]]
    return "".join(parts)


def main(args: Args) -> None:
    """Rewrite both files in place."""
    results = load(args.results)
    try:
        args.readme.write_text(fill(args.readme.read_text(), results))
    except StaleError as error:
        raise SystemExit(str(error)) from error
    args.page.write_text(page(results))
    Console().print(f"wrote the tables of {args.readme} and {args.page}")


if __name__ == "__main__":
    main(tyro.cli(Args))
