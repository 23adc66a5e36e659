import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, get_args

import numpy as np
import pytest
from rich.console import Console

from steadypose.benchmarks import output, provenance, results
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.evaluate import Name, evaluate
from steadypose.benchmarks.provenance import ROOT, UncommittedError, code, definitions, machine, measured, ships, stale
from steadypose.benchmarks.report import ERRORS, STALE, Args, fill, main, overview, pages, ratios
from steadypose.benchmarks.results import PICTURES, Result, Table, load, save, show
from steadypose.benchmarks.studies import PREPARED, SENSORS, STUDIES
from steadypose.benchmarks.systems import SYSTEMS

TABLE = Table(
    "speed", "Speed, ms", ["method", "p50", "a|b"], [["raw", "1.0", "2"], ["steadypose", "0.5", "3"]], "A note."
)
COMMAND = ["steadypose", "evaluate", "latency", "--quick"]
TEXT = "# Title\n<!-- results:speed -->\nold\n<!-- /results -->\ntail\n"


PAPER: Any = SimpleNamespace(
    __name__="steadypose.benchmarks.studies.hidden_joints", DEPENDS_ON=("humor weights", "prior.fit")
)
"""A study, as far as `save` looks at it."""


def saved(folder: Path, name: str = "latency", table: Table = TABLE, study: Any = PAPER) -> dict[str, Any]:
    save(name, COMMAND, [table], {"rows": [1, {"none": float("nan")}]}, study, folder)
    return load(folder)[name]


def test_a_saved_table_stands_in_every_block_of_the_readme_and_filling_twice_changes_nothing(tmp_path: Path) -> None:
    assert saved(tmp_path)["rows"] == [1, {"none": None}]
    readme = tmp_path / "README.md"
    readme.write_text(f"{TEXT}between\n{TEXT}")
    main(Args(readme, tmp_path, tmp_path))
    once = readme.read_text()
    assert once.count("| steadypose | 0.5 | 3 |") == 2
    assert "| method | p50 | a\\|b |" in once
    assert "`steadypose evaluate latency --quick`" in once
    assert "old" not in once
    assert once.startswith("# Title\n")
    assert "<!-- /results -->\ntail\nbetween\n# Title" in once
    main(Args(readme, tmp_path, tmp_path))
    assert readme.read_text() == once
    with pytest.raises(KeyError, match=r"results:other.*speed"):
        fill("<!-- results:other -->\n<!-- /results -->", {"latency": saved(tmp_path)})


def test_a_stale_table_has_its_reason_and_a_finished_study_its_commit(tmp_path: Path) -> None:
    results = {"latency": saved(tmp_path), "hgvae": saved(tmp_path, "hgvae", replace(TABLE, name="levels"))}
    results["hgvae"]["frozen"] = "abc1234"
    levels = "<!-- results:levels -->\n<!-- /results -->\n"
    assert "stale" not in fill(TEXT, results, {})
    assert "**stale: the reason**" in fill(TEXT, results, {"latency": "the reason"})
    assert "code is at commit abc1234" in fill(levels, results, {})
    assert "**stale: the reason**" in pages(results, {"latency": "the reason"})["speed-and-faults.md"]


def test_a_page_shows_a_studys_pictures_and_refuses_a_result_that_no_chapter_names(tmp_path: Path) -> None:
    result = saved(tmp_path) | {"pictures": ["noise_levels"]}
    written = pages({"latency": result})
    assert set(written) == {"index.md", "speed-and-faults.md"}
    assert "[Latency](speed-and-faults.md#latency)" in written["index.md"]
    assert "![noise levels](../images/noise_levels.png)" in written["speed-and-faults.md"]
    with pytest.raises(KeyError, match=r"new_study.*chapter"):
        pages({"new_study": result})
    shown = {stem for one in load().values() for stem in one.get("pictures", ())}
    assert shown == {path.stem for path in PICTURES.glob("*_*.png")}, "each is there"


def record(method: str, delay: int, position: float, acceleration: float, condition: str = "2 cm") -> dict[str, Any]:
    return {"method": method, "delay": delay, "condition": condition,
            "position_mm": position, "acceleration_mm": acceleration}  # fmt: skip


def test_the_overview_compares_with_the_nearest_baseline_of_the_cell_that_waits_no_longer() -> None:
    records = [
        record("raw", 0, 16.0, 40.0), record("bank", 0, 10.0, 8.0), record("bank", 4, 20.0, 1.0),
        record("bank", 8, 1.0, 1.0), record("bank", 0, 1.0, 1.0, "1 cm"), record("Butterworth, offline", -1, 1.0, 1.0),
        record("HM-VAE", 4, 1.0, 1.0), record("temporal convolution", 4, 1.0, 1.0), record("steadypose", 4, 10.2, 4.0),
        record("steadypose", 0, 9.0, 8.0),
    ]  # fmt: skip
    tiny = [record("raw", 0, 0.0, 0.0), record("steadypose", 0, 0.04, 0.01)]
    assert list(ratios(tiny, "position_mm")) == [("2 cm, delay 0", 1.0, 1.0)], "next to nothing is equal"
    assert {name: pair for name, *pair in ratios(records, "position_mm")} == {
        "2 cm, delay 4": [pytest.approx(1.02), 0.5],
        "2 cm, delay 0": [0.9, 1.0],
    }
    shown = overview({"fidelity": {"records": records}}, {"fidelity": "Noise"})
    assert "| Noise | 2 | 1 | 0.96 | 1.02 (2 cm, delay 4) | 0 | 0.75 | 1.00 (2 cm, delay 0) |" in shown


def test_the_readme_says_in_how_many_cells_a_baseline_is_more_accurate() -> None:
    cells = {
        (study, name): position
        for study, error in ERRORS.items()
        for name, position, _ in ratios(load()[study]["records"], error)
    }
    worse = {cell: ratio for cell, ratio in cells.items() if ratio >= 1.005}
    assert {study for study, _ in worse} == {"mediapipe"}
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"Of {len(cells)} cells" in text
    percent = round(100 * max(worse.values()) - 100)
    assert f"is more accurate in {len(worse)}, all of MediaPipe's, by up to {percent} %" in text


def test_weights_that_do_not_ship_change_no_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "WEIGHTS", tmp_path)
    digests = []
    for name, weights in (("hgvae-default", b"1"), ("hgvae-research", b"2"), ("hgvae-default.faults", b"3")):
        (tmp_path / f"{name}.safetensors").write_bytes(weights)
        digests.append(ships.__wrapped__()["hgvae weights"])
    assert digests[0] == digests[1] != digests[2]


def test_what_no_commit_can_make_again_is_refused_among_the_results_alone(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(provenance, "uncommitted", lambda: ["prior/clean/fuse.py"])
    with pytest.raises(UncommittedError, match=r"fuse\.py.*--out"):
        save("latency", COMMAND, [TABLE], {}, PAPER)
    assert saved(tmp_path)


def test_a_result_is_stale_when_weights_or_code_have_changed_and_a_finished_one_never(tmp_path: Path, monkeypatch):
    result = saved(tmp_path)
    assert stale(result) == []
    assert {"CONDITIONS", "run", "below", "ConditionalGaussian", "RIDGE", "search"} <= {
        line.split()[0] for line in result["code"]
    }, "the study's own definitions, and those of corruption, baselines and the parameter search"
    changed = ships() | {"humor weights": "others"}
    monkeypatch.setattr(provenance, "ships", lambda: changed)
    assert stale(result) == ["humor weights"]
    result["code"] += ["NOISE 01234567", "gone 89abcdef"]
    result["measured"]["prior.fit"] = "other"
    assert stale(result) == ["humor weights", "prior.fit", "code (NOISE, gone)"]
    assert stale(result | {"frozen": "abc1234"}) == []


def test_the_outputs_root_mean_square_change_tells_whether_it_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=100_000)
    result = {"measured": {"pose/clean": output.projections([values])}, "code": []}
    for change, found in ((1e-6, []), (1e-3, ["pose/clean"])):
        now = values + change * rng.normal(size=len(values))
        monkeypatch.setattr(output, "outputs", lambda now=now: {"pose/clean": output.projections([now])})
        assert stale(result) == found


def test_only_what_changes_figures_counts_as_code(tmp_path: Path) -> None:
    texts = [
        "X = 1\nY, Z = 2, 3\n\n\ndef f(x):\n    return x\n",
        '"""Text."""\nimport os\nX = 1  # a comment\n"""Metres."""\nY, Z = 2, 3\n'
        'def f(x: int) -> int:\n    """Text."""\n    return x\n'
        "def table() -> Table:\n    return Table()\n",
        "Y, Z = 2, 3\ndef f(x):\n    return x\nX = 1\n",
        "X = 2\nY, Z = 2, 3\n\n\ndef f(x):\n    return x\n",
        "X = 1\nY, Z = 2, 3\n\n\ndef f(x):\n    return -x\n",
        "X = 1\nY, Z = 2, 4\n\n\ndef f(x):\n    return x\n",
    ]
    found = []
    for number, text in enumerate(texts):
        (tmp_path / f"{number}.py").write_text(text)
        found.append(sorted(definitions(tmp_path / f"{number}.py")))
    assert found[0] == found[1] == found[2]
    changed = [[line.rpartition(" ")[0] for line in set(found[0]) - set(other)] for other in found[3:]]
    assert changed == [["X"], ["f"], ["(Y, Z)"]]


def test_every_study_says_what_it_depends_on_and_is_made_of_code() -> None:
    for room, names in (("studies", STUDIES), ("systems", SYSTEMS)):
        for name in names:
            module = importlib.import_module(f"steadypose.benchmarks.{room}.{name}")
            assert measured(module.DEPENDS_ON).keys() == set(module.DEPENDS_ON), name
            assert len(code(f"benchmarks.{room}.{name}")) > 10, name


def test_every_stale_result_is_listed_with_a_reason_and_readme_and_pages_hold_what_was_measured() -> None:
    assert {name for name, result in load().items() if stale(result)} == set(STALE)
    results = load()
    readme = (ROOT / "README.md").read_text()
    assert fill(readme, results) == readme
    assert pages(results) == {path.name: path.read_text() for path in (ROOT / "docs" / "results").iterdir()}


def test_a_row_is_in_one_line_however_narrow_the_console() -> None:
    row = ["1 cm: a", *(f"{k} (100–140)" for k in range(12))]
    console = Console(width=40)
    with console.capture() as capture:
        show(Table("t", "wide", ["method", *(f"column {k}" for k in range(12))], [row], "A note."), console)
    title, columns, line, note, *_ = capture.get().splitlines()
    assert (title, note) == ("wide", "A note.")
    assert columns.split("  ")[0] == "method"
    assert [cell for cell in line.split("  ") if cell.strip()] == row


def test_the_command_knows_every_protocol_and_asks_for_what_it_needs() -> None:
    assert set(get_args(Name)) == {"all", *STUDIES, *SYSTEMS}
    with pytest.raises(FileNotFoundError, match="mocap"):
        evaluate("kinect_vicon")


def test_all_is_every_protocol_in_turn_without_what_is_not_here(tmp_path: Path, capsys, monkeypatch) -> None:
    ran: list[Bench] = []
    study = SimpleNamespace(run=lambda bench: ran.append(bench) or Result([], {}))
    monkeypatch.setattr("importlib.import_module", lambda _: study)
    evaluate("all", quick=True, data=tmp_path / "nowhere.npz")
    assert len(ran) == len(STUDIES) - len(SENSORS) - len(PREPARED)
    assert len(set(map(id, ran))) == 1  # what is trained for one protocol serves the others
    said = capsys.readouterr().out
    assert "kinect_vicon: left out" in said
    assert "nowhere.npz does not exist: the people are simulated" in said


def test_every_reading_of_the_test_split_is_logged_and_no_other(tmp_path: Path, monkeypatch) -> None:
    log, data = tmp_path / "results" / "test-readings.csv", tmp_path / "prepared.npz"
    monkeypatch.setattr(results, "READINGS", log)

    # scored in part, it has been read
    monkeypatch.setattr("importlib.import_module", lambda _: SimpleNamespace(run=lambda bench: 1 / 0))

    def read(study: str, split: Literal["val", "test"]) -> None:
        with pytest.raises(ZeroDivisionError):
            evaluate(study, split, quick=True, mocap=tmp_path, data=data)

    read("world", "test")  # simulated people, as there is no prepared motion
    data.touch()
    for name in ("ui_prmd.npz", "dancedb.tar.xz"):
        (tmp_path / name).touch()
    read("world", "val")
    read("kinect_vicon", "test")  # has no split
    assert not log.exists()
    read("world", "test")
    read("rotations", "test")  # has one, beside a sensor's recordings
    found = machine()
    assert log.read_text().splitlines() == [
        "date,commit,study,what followed",
        f"{found['date']},{found['commit']},world,",
        f"{found['date']},{found['commit']},rotations,",
    ]


def test_quick_writes_only_where_it_is_told(tmp_path: Path, capsys, monkeypatch) -> None:
    study = SimpleNamespace(
        __name__="steadypose.benchmarks.studies.completion",
        DEPENDS_ON=(),
        run=lambda bench: Result([], {}, wrong=["lost"]),
    )
    monkeypatch.setattr("importlib.import_module", lambda _: study)
    assert evaluate("completion", quick=True, data=tmp_path / "nowhere.npz") == 1, "what is wrong fails the command"
    evaluate("completion", quick=True, data=tmp_path / "nowhere.npz", out=tmp_path / "out")
    assert capsys.readouterr().out.count("wrote") == 1
    assert (tmp_path / "out" / "completion.json").is_file()
