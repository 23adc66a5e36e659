"""Sentences that quote a figure quote the committed result: its cell, rounded as the sentence has it."""

import re

import pytest

from steadypose.benchmarks.provenance import ROOT
from steadypose.benchmarks.results import load

Cell = tuple[str, str, str, str]
FIT, CLEAN = "HuMoR, as it ships", "steadypose live, delay 8"
OF_BANK = "of: whole-body bank"
GAPS = (5, 15, 30, 45)
SENTENCES: list[tuple[str, str, list[Cell]]] = [
    (
        "README.md",
        r"(?s)error is (\S+) \(95 % interval over people: \S+\) in\sindependent noise .*? (\S+) \(\S+\) without "
        r"delay\. In time-correlated noise of 2 cm .*? it is (\S+) ",
        [
            ("fidelity", "fidelity-sources-4", "2 cm: steadypose", OF_BANK),
            ("fidelity", "fidelity-sources-0", "2 cm: steadypose", OF_BANK),
            ("noisy_joints", "noisy_joints-sources-4", "correlated 2 cm: steadypose", OF_BANK),
        ],
    ),
    (
        "README.md",
        r"with COCO's joints, in independent noise of 2 cm, the mean error is (\S+) mm instead of (\S+) ",
        [("layouts", "layouts", f"{layout}, all observed: steadypose", "all, mm") for layout in ("coco17", "smpl22")],
    ),
    (
        "README.md",
        r"\(AMD EPYC\), `prior` takes (\S+) ms and `trajectory` (\S+) ms per frame of one person",
        [("latency", "compute", "1", f"{node}, wall, p50") for node in ("prior", "trajectory")],
    ),
    ("README.md", r"comes (\S+) ms \(p99 (\S+) ms\)", [("latency", "live", "1", column) for column in ("p50", "p99")]),
    ("README.md", r"process every frame of (\d+) people", [("latency", "live", "16", "bodies answered")]),
    (
        "docs/fit.md",
        r"in 4 cm of noise is (\S+) mm, of `clean` with 8 frames of delay ([\d.]+); of what is hidden below 0.9 m\s"
        r"(\d+) mm, of `clean` (\d+),",
        [("humor", f"humor-{table}", method, column)
         for table, column in (("noisy", "all, mm"), ("hidden", "hidden, mm")) for method in (FIT, CLEAN)],
    ),
    (
        "docs/fit.md",
        r"joints to (\d+) mm, with points of a depth camera to (\d+)\.",
        [("humor", "humor-detector", FIT, "all, mm"), ("humor", "humor-depth", FIT, "all, mm")],
    ),
    (
        "docs/fit.md",
        r"a fit has (\S+) mm, `clean` ([\d.]+); without the transition model (\S+) mm more .*? always kept: "
        r"(\S+) mm more",
        [("humor_credit", "humor_credit", f"4 cm of noise: {method}", column) for method, column in (
            ("as it ships", "mean over people"), ("`clean`, from which fits start", "mean over people"),
            ("no CVAE", "more than as it ships"), ("stage 3 always", "more than as it ships"))],
    ),
    (
        "docs/fit.md",
        r"It takes (\S+) s of processor time for 3 s of one body, from key points (\S+) s, with points (\S+) s\.",
        [("humor", f"humor-{table}", FIT, "s a clip") for table in ("noisy", "detector", "depth")],
    ),
    (
        "docs/fit.md",
        r"\(\[median\]\(results/rotations-world-events\.md#rotations\) (\S+) and (\S+) degrees\)",
        [("rotations", "rotations", f"correlated, 2 cm: {method}", "17 joints")
         for method in ("`steadypose fit`, offline", "steadypose")],
    ),
    (
        "docs/events.md",
        r"\((\d+) events\), F1 is (\S+) and the median delay is 0\.27 s .*? LAFAN1; (\d+) events\), F1 is (\S+),",
        [(study, study.replace("_", "-"), "all", column) for study in ("events", "event_mocap")
         for column in ("labels", "F1")],
    ),
    (
        "docs/oak.md",
        r"off by (\d+) mm in the median and (\d+) mm at the 95th percentile\. With the median depth of 7 × 7 pixels "
        r"instead, it is (\d+) and (\d+) mm .*? left out, (\d+) to (\d+) % get a",
        [
            *(("depth_lifting", "depth_lifting", f"{method}, 3, 1.5", column)
              for method in ("steadypose", "median of 7 x 7 pixels") for column in ("error, mm: seen", "p95")),
            ("depth_lifting", "depth_lifting", "steadypose, 2, 0", "hidden given, %"),
            ("depth_lifting", "depth_lifting", "steadypose, 4, 0", "hidden given, %"),
        ],
    ),
    (
        "docs/server.md",
        r"takes (\S+) ms of processor time a frame for one client, (\S+) ms for four and (\S+) ms for eight\.",
        [("scale", "scale", f"{clients}", "prior, p50") for clients in (1, 4, 8)],
    ),
    ("docs/server.md", r", and (\d+) % of the frames of 32 ", [("scale", "scale_live", "32", "answered, %")]),
    *(
        (
            "docs/complete.md",
            rf"\| {row} " + r"\| (\S+); (\S+) " * len(GAPS) + r"\|",
            [("interpolation", "interpolation", f"{method}, {gap}", column)
             for gap in GAPS for column in ("of slerp's", "of lerp's")],
        ) for row, method in (
            ("`complete`, L2Q; L2P", "complete"), ("natural cubic spline", "cubic spline, joints given")
        )
    ),
    (
        "docs/retarget.md",
        r"a frame takes (\S+) ms of processor time \(p99 (\S+)\), joints leave their range by (\S+) rad, and a "
        r"standing foot slips by up to (\S+) mm .*? No foot sinks more than (\S+) mm",
        [("retarget", "retarget", "all", column) for column in (
            "cpu, p50, ms", "cpu, p99, ms", "worst breach of a range, rad", "standing foot, at most, mm",
            "foot below the floor, at most, mm")],
    ),
    (
        "docs/complete.md",
        r"needs the extra `train` and takes (\S+) s per window\.",
        [("completion", "completion-search", "legs, complete --optimise", "s a window")],
    ),
    (
        "docs/complete.md",
        r"keeps (\S+) to (\S+) times the true acceleration, instead of (\S+) to (\S+)\.",
        [("interpolation", "interpolation-search", f"{method}, {gap}", "acceleration, of the true")
         for method in ("HM-VAE searched from there", "completer") for gap in (45, 5)],
    ),
    (
        "docs/complete.md",
        r"hidden parts is (\S+) to (\S+) of that of the most similar training window",
        [("completion", "completion", part, "complete, of nearest")
         for part in ("all but pelvis, chest, head, wrists, ankles", "legs")],
    ),
]  # fmt: skip
"""Page, sentence with a group for each figure, and where each is: result, table, first cells of the row, column."""


@pytest.mark.parametrize(("page", "sentence", "cells"), SENTENCES)
def test_a_sentence_quotes_the_result(page: str, sentence: str, cells: list[Cell]) -> None:
    found = re.search(sentence, " ".join((ROOT / page).read_text().split()))
    assert found, f"{page}: expected a sentence like {sentence}; if it was rewritten, so must this list be"
    for quoted, (result, table, method, column) in zip(found.groups(), cells, strict=True):
        measured = next(t for t in load()[result]["tables"] if t["name"] == table)
        row = next(r for r in measured["rows"] if method in (", ".join(map(str, r[:n])) for n in (1, 2, 3)))
        value = float(row[measured["columns"].index(column)].split()[0])  # an interval may follow
        digits = len(quoted.partition(".")[2])
        assert abs(value - float(quoted)) <= 0.5 * 10**-digits + 1e-9, f"{page}: {quoted}, {result}.json has {value}"
