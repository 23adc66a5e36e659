"""Writes the measured tables into the README, between its markers, and all of them onto one page, after an overview.

The text between ``<!-- results:NAME -->`` and ``<!-- /results -->`` is replaced by table NAME of
``benchmarks/results/*.json``. Results listed in `STALE` are marked with the reason. The overview is one table over the
studies that compare methods: how often, and where, steadypose is worse than the best baseline.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import tyro
from rich.console import Console

from steadypose.benchmarks.provenance import RESULTS, ROOT
from steadypose.benchmarks.results import load

_CORRELATED = "measured before joints in time-correlated noise were denoised by HG-VAE and a narrower Gaussian"
_NARROW = "measured before the Gaussian of postures was narrower in time-correlated noise: joints in it are now nearer"
STALE: dict[str, str] = {
    **dict.fromkeys(("ablations", "hidden_joints", "humor"), _NARROW),
    **dict.fromkeys(("latency", "restart", "scale"), _CORRELATED),
    "soak": "measured before the steady stage and the fast matrix products, on which its losses depend little",
}  # fmt: skip
"""Results that are kept although what they measured has changed since, each with the reason. A test compares this list
with the code (`provenance.stale`)."""

_BLOCK = re.compile(r"(<!-- results:(?P<name>[\w-]+) -->\n).*?(<!-- /results -->)", re.DOTALL)


HOW = """# Results

Every table and picture of `benchmarks/results/*.json`, written by `python -m steadypose.benchmarks.report`. Under each
table stand the command that makes it, the machine, the commit and the day. *Stale* marks what was measured before the
pipeline's output, weights or the study changed, with the reason why it still stands; the code of a *finished study* is
gone from here. Positions are in millimetres, accelerations in mm/frame² at 30 Hz; a delay is in frames of 30 Hz.
Baselines are tuned on every third of the clips that are scored, with other noise; steadypose runs as it ships and has
nothing to tune.
"""

CHAPTERS = {
    "Observed joints": {
        "fidelity": "Independent noise",
        "noisy_joints": "Noise of several kinds",
        "kinect_vicon": "Kinect",
        "mediapipe": "MediaPipe",
        "layouts": "Layouts",
        "camera_rates": "Camera rates",
        "streaming": "Streaming",
        "ablations": "What each part brings",
    },
    "Joints that are not observed": {
        "hidden_joints": "Hidden joints",
        "counter": "Behind a counter",
        "completion": "Completion",
        "interpolation": "Gaps",
        "interpolation_paths": "The root in gaps",
    },
    "Rotations, world, events": {
        "rotations": "Rotations",
        "heading": "Heading",
        "world": "World",
        "simulated": "Bundled streams",
        "contacts": "Contacts",
        "factor_graph": "Factor graph",
        "retarget": "Retargeting",
        "events": "Events",
        "event_mocap": "Events in motion capture",
        "identity": "Identity",
    },
    "Speed and faults": {
        "latency": "Latency",
        "scale": "Scale",
        "restart": "Restart",
        "soak": "Soak",
        "memory": "Memory",
        "fuzz": "Damaged input",
        "web_page": "Browser",
    },
    "Sensors and files": {
        "calibration": "Calibration",
        "depth_lifting": "Depth lifting",
        "importers": "Importers",
    },
    "The papers": {
        "hgvae": "HG-VAE",
        "hgvae_training": "HG-VAE, trained in variants",
        "reconstruction": "HM-VAE",
        "humor": "HuMoR",
        "humor_credit": "What HuMoR brings to a fit",
    },
}
"""A page each: results by name, each with its title."""


@dataclass(frozen=True)
class Args:
    """Write the measured tables into the README and the pages of results."""

    readme: Path = ROOT / "README.md"
    """File with the markers."""
    pages: Path = ROOT / "docs" / "results"
    """Folder of pages, which are written anew."""
    results: Path = RESULTS
    """Folder of the JSON files."""


def markdown(table: Mapping[str, Any], result: Mapping[str, Any], reason: str | None = None) -> str:
    """Format a table as Markdown, with its note, command and machine, and the reason if it is stale."""
    machine, command = result["machine"], result["command"]
    cells = [table["columns"], ["---", *["---:"] * (len(table["columns"]) - 1)], *table["rows"]]
    lines = [f"**{table['title']}**", ""]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in cells]
    lines += ["", table["note"]] if table["note"] else []
    source = f"{machine['cpu']}, {machine['cores']} cores; commit {machine['commit']}, {machine['date']}"
    source += f"; **stale: {reason}**" if reason else ""
    source += f"; a finished study, whose code is at commit {result['frozen']}" if "frozen" in result else ""
    return "\n".join([*lines, "", f"<sub>`{command}` · {source}</sub>", ""])


def fill(text: str, results: Mapping[str, Mapping[str, Any]], reasons: Mapping[str, str] = STALE) -> str:
    """Replace every block between markers. Raises KeyError if a marker names a table that no result has."""
    tables = {t["name"]: markdown(t, r, reasons.get(name)) for name, r in results.items() for t in r["tables"]}

    def block(match: re.Match[str]) -> str:
        name = match["name"]
        if name not in tables:
            raise KeyError(f"marker results:{name}: expected one of {', '.join(tables) or 'none: run a study'}")
        return f"{match[1]}{tables[name]}{match[3]}"

    return _BLOCK.sub(block, text)


def slug(title: str) -> str:
    """Return a title as a file's name and as an anchor."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def pages(results: Mapping[str, Mapping[str, Any]], reasons: Mapping[str, str] = STALE) -> dict[str, str]:
    """Return the pages by file name: an index with the overview, and all tables and pictures of each chapter.

    Raises:
        KeyError: No chapter names a result.
    """
    titles = {name: title for chapter in CHAPTERS.values() for name, title in chapter.items()}
    if unnamed := results.keys() - titles.keys():
        raise KeyError(f"results {', '.join(sorted(unnamed))}: name them in a chapter of benchmarks/report.py")
    written, contents = {}, []
    for chapter, studies in CHAPTERS.items():
        measured = {title: (name, results[name]) for name, title in studies.items() if name in results}
        if not measured:
            continue
        file = f"{slug(chapter)}.md"
        contents.append(f"| [{chapter}]({file}) | {', '.join(f'[{t}]({file}#{slug(t)})' for t in measured)} |\n")
        parts = [f"# {chapter}\n\nWhat was measured, and how to read it, is on the [first page](index.md).\n"]
        for title, (name, result) in measured.items():
            parts.append(f"\n## {title}\n")
            parts += [f"\n{markdown(table, result, reasons.get(name))}" for table in result["tables"]]
            parts += [f"\n![{stem.replace('_', ' ')}](../images/{stem}.png)\n" for stem in result.get("pictures", ())]
        written[file] = "".join(parts)
    written["index.md"] = f"{HOW}\n| chapter | studies |\n| --- | --- |\n{''.join(contents)}{overview(results, titles)}"
    return written


ERRORS = {
    "fidelity": "position_mm",
    "noisy_joints": "position_mm",
    "kinect_vicon": "position_mm",
    "mediapipe": "position_mm",
    "hidden_joints": "hidden_mm",
    "world": "position_mm",
}
"""The studies, and which error of a record counts."""

PRODUCT = ("steadypose", "steadypose: pose/world")
NO_BASELINE = ("truth", "HM-VAE", "steadypose", "ridge regression", "temporal convolution")
"""How names begin that are no baselines: the truth, our own variants, and what was trained on the very sensor."""

LEAST_MM = 0.05  # errors below it count as it, because a ratio of two of them says nothing, millimetres

_OVERVIEW = """
## Overview

**Cells in which steadypose is worse than the best baseline**

A cell is a condition and a delay of one study. The best baseline is the one of the least position error in that very
cell, of all that wait as long or less; filters are tuned for the cell. The ratio is steadypose's error by this
baseline's: below 1, steadypose is better. Acceleration: the ratio to the same baseline, which may be smoother. Left
out are methods trained on the very sensor (the Kinect's table has them, beside steadypose with the sensor known) and
our own HM-VAE alone. Errors below 0.05 mm count as that much.

| study | cells | position worse in | median | worst | acceleration worse in | median | worst |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
"""


def overview(results: Mapping[str, Mapping[str, Any]], titles: Mapping[str, str]) -> str:
    """Return the section, with a row for each study that there is."""
    rows = []
    for study, error in ERRORS.items():
        if study in results:
            cells = list(ratios(results[study]["records"], error))
            figures = [_summary({cell: pair[k] for cell, *pair in cells}) for k in (0, 1)]
            rows.append(f"| {titles.get(study, study)} | {len(cells)} | {figures[0]} | {figures[1]} |\n")
    return _OVERVIEW + "".join(rows) if rows else ""


def ratios(records: Sequence[Mapping[str, Any]], error: str) -> Iterator[tuple[str, float, float]]:
    """Yield each cell's name and steadypose's ``error`` and acceleration error by those of the best baseline."""
    for own in records:
        if own["method"] not in PRODUCT:
            continue
        condition = own.get("condition", own.get("camera"))
        others = [
            record
            for record in records
            if record.get("condition", record.get("camera")) == condition
            and 0 <= record["delay"] <= own["delay"]
            and not record["method"].startswith(NO_BASELINE)
            and record.get(error) is not None
        ]
        best = min(others, key=lambda record: record[error])
        name = f"delay {own['delay']}" if condition is None else f"{condition}, delay {own['delay']}"
        yield name, *(max(own[key], LEAST_MM) / max(best[key], LEAST_MM) for key in (error, "acceleration_mm"))


def _summary(found: Mapping[str, float]) -> str:
    """Return three cells: how many ratios are above 1 as printed, their median, and the worst with its name."""
    worst = max(found, key=found.__getitem__)
    worse = sum(ratio >= 1.005 for ratio in found.values())
    return f"{worse} | {median(found.values()):.2f} | {found[worst]:.2f} ({worst})"


def main(args: Args) -> None:
    results = load(args.results)
    args.readme.write_text(fill(args.readme.read_text(), results))
    for name, text in pages(results).items():
        (args.pages / name).write_text(text)
    Console().print(f"wrote the tables of {args.readme} and {args.pages}")


if __name__ == "__main__":
    main(tyro.cli(Args))
