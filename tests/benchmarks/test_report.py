import importlib
import io
import pkgutil
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from steadypose.benchmarks import provenance, studies, systems
from steadypose.benchmarks.machine import ROOT, describe
from steadypose.benchmarks.provenance import WORLD, UncommittedError, code_digest, ships, stale
from steadypose.benchmarks.report import Args, StaleError, fill, main, page
from steadypose.benchmarks.results import Table, load, save, show
from steadypose.benchmarks.stale import STALE

TABLE = Table("speed", "Speed, ms", ["method", "p50", "a|b"], [["raw", "1.0", "2"], ["ours", "0.5", "3"]], "A note.")
TEXT = "# Title\n<!-- results:speed -->\nold\n<!-- /results -->\ntail\n"


def test_a_saved_table_stands_in_the_readme_and_filling_twice_changes_nothing(tmp_path: Path) -> None:
    save(
        "latency", ["--quick", str(tmp_path / "input")], [TABLE], {"rows": [1, {"none": float("nan")}]}, WORLD, tmp_path
    )
    results = load(tmp_path)
    assert results["latency"]["rows"] == [1, {"none": None}]
    assert str(tmp_path) not in (tmp_path / "latency.json").read_text()

    readme = tmp_path / "README.md"
    readme.write_text(TEXT)
    main(Args(readme, tmp_path / "page.md", tmp_path))
    once = readme.read_text()
    assert "| ours | 0.5 | 3 |" in once
    assert "| method | p50 | a\\|b |" in once
    assert "`python -m steadypose.benchmarks.systems.latency --quick input`" in once
    assert "old" not in once
    assert once.startswith("# Title\n")
    assert once.endswith("<!-- /results -->\ntail\n")
    main(Args(readme, tmp_path / "page.md", tmp_path))
    assert readme.read_text() == once


def test_a_marker_without_a_result_is_an_error_that_names_those_there_are(tmp_path: Path) -> None:
    save("latency", [], [TABLE], {}, WORLD, tmp_path)
    with pytest.raises(KeyError, match=r"results:other.*speed"):
        fill("<!-- results:other -->\n<!-- /results -->", load(tmp_path))


def test_blocks_do_not_swallow_each_other(tmp_path: Path) -> None:
    save("latency", [], [TABLE], {}, WORLD, tmp_path)
    filled = fill(TEXT + "between\n" + TEXT, load(tmp_path))
    assert filled.count("| ours |") == 2
    assert "between" in filled


def test_a_result_is_stale_when_weights_or_settings_have_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save("latency", [], [TABLE], {}, WORLD, tmp_path)
    save("hgvae", [], [replace(TABLE, name="levels")], {}, ("hgvae weights",), tmp_path)
    results = load(tmp_path)
    assert stale(results["latency"]) == stale(results["hgvae"]) == []
    assert stale({}) == ["weights", "settings"]
    changed = ships() | {"mixture weights": "others"}
    monkeypatch.setattr(provenance, "ships", lambda: changed)
    assert (stale(results["latency"]), stale(results["hgvae"])) == (["mixture weights"], [])
    with pytest.raises(StaleError, match=r"systems\.latency.*mixture weights"):
        fill(TEXT, results, {})
    assert "**stale: measured with other mixture weights**" in fill(TEXT, results, {"latency": "the reason"})
    assert "stale" not in fill("<!-- results:levels -->\n<!-- /results -->", results, {})


def test_what_a_bench_says_it_depends_on_is_something_that_ships() -> None:
    for package in (studies, systems):
        for name in (module.name for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}.")):
            assert set(getattr(importlib.import_module(name), "DEPENDS_ON", ())) <= set(ships()), name


def test_weights_that_do_not_ship_change_no_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "WEIGHTS", tmp_path)
    digests = []
    for name, weights in (("hgvae-default", b"1"), ("hgvae-research", b"2"), ("hgvae-default.faults", b"3")):
        (tmp_path / f"{name}.safetensors").write_bytes(weights)
        digests.append(ships.__wrapped__()["hgvae weights"])
    assert digests[0] == digests[1] != digests[2]


def test_what_no_commit_can_make_again_is_refused_among_the_results_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provenance, "uncommitted", lambda: ["prior/clean/fuse.py"])
    with pytest.raises(UncommittedError, match=r"fuse\.py.*--out"):
        save("latency", [], [TABLE], {}, WORLD)
    assert save("latency", [], [TABLE], {}, WORLD, tmp_path).is_file()


def test_a_result_is_stale_when_the_code_that_made_it_has_changed(tmp_path: Path) -> None:
    save("latency", [], [TABLE], {}, (), tmp_path)
    result = load(tmp_path)["latency"]
    assert "benchmarks.results" in result["code"]
    assert stale(result) == []
    result["code"]["benchmarks.results"] = "other"
    result["code"]["prior.clean.gone"] = "was there"
    assert stale(result) == ["code (benchmarks.results, prior.clean.gone)"]
    del result["code"]
    assert stale(result) == ["code (not recorded)"]


def test_only_what_runs_counts_as_code(tmp_path: Path) -> None:
    texts = ["x = 1", '"""Text."""\nx = 1  # a comment\n', 'def f():\n    """Text."""\n', "def f():\n    return 1\n"]
    digests = []
    for number, text in enumerate(texts):
        (tmp_path / f"{number}.py").write_text(text)
        digests.append(code_digest(tmp_path / f"{number}.py"))
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


def test_every_stale_result_is_listed_with_a_reason_and_no_other() -> None:
    assert {name for name, result in load().items() if stale(result)} == set(STALE)


def test_readme_and_page_hold_what_was_measured() -> None:
    results = load()
    readme = (ROOT / "README.md").read_text()
    assert fill(readme, results) == readme
    assert page(results) == (ROOT / "docs" / "results.md").read_text()


def test_the_machine_is_described() -> None:
    machine = describe()
    assert machine["cpu"]
    assert int(machine["cores"]) >= 1
    assert float(machine["memory_gb"]) > 0
    assert set(machine) >= {"load_1min", "python", "torch", "commit", "date"}


def test_show_prints_every_cell() -> None:
    console = Console(width=100, file=io.StringIO())
    with console.capture() as capture:
        show(TABLE, console)
    text = capture.get()
    assert all(cell in text for row in TABLE.rows for cell in row)
    assert "A note." in text
