from pathlib import Path

import pytest
from tests import mutation

CODE = '''"""Text."""
import os

LIMIT: dict[str, int] = {"é": 1}


def of(x: int | None, y=True):
    """1 < 2"""
    if not x or x < -2.5:
        raise ValueError(f"{x + 1}")
    x += 1
    print(x, [y, os], y)
    if y:
        return None
    return pair(y, x)[:, 0] + 3
'''
CHANGES = [
    "1 -> (2)", "True -> (False)", "not x or x < -2.5 -> (not x and x < -2.5)", "not x -> (x)",
    "x < -2.5 -> (x >= -2.5)",
    "-2.5 -> (2.5)", 'raise ValueError(f"{x + 1}") -> pass', "x += 1 -> pass", "1 -> (2)",
    "print(x, [y, os], y) -> pass", "print(x, [y, os], y) -> (print(y, [y, os], x))", "[y, os] -> ([os, y])",
    "return pair(y, x)[:, 0] + 3 -> return None", "pair(y, x)[:, 0] + 3 -> (pair(y, x)[:, 0] - 3)",
    "pair(y, x) -> (pair(x, y))", "0 -> (1)", "3 -> (4)",
]  # fmt: skip


def test_every_place_that_a_test_can_hold_is_changed_once(tmp_path: Path) -> None:
    (tmp_path / "m.py").write_text(CODE)
    found = mutation.mutants(Path("m.py"), tmp_path)
    assert sorted(str(mutant).partition(": ")[2] for mutant in found) == sorted(CHANGES)
    for mutant in found:
        compile(mutant.source, "m.py", "exec")
        assert mutant.source.decode() != CODE


def test_a_copy_has_all_code_and_nothing_that_was_made(tmp_path: Path) -> None:
    for name in ("data/a.npz", "training/data/b.py", "training/__pycache__/b.pyc", ".venv/c.py", "tests/test_d.py"):
        (file := tmp_path / "from" / name).parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    mutation.copy_checkout(tmp_path / "from", to := tmp_path / "to")
    assert {str(path.relative_to(to)) for path in to.rglob("*.*") if path.is_file()} == {
        "training/data/b.py",
        "tests/test_d.py",
    }


@pytest.mark.slow
def test_tests_that_are_not_there_kill_nothing(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text("def test_it():\n    assert 1 + 1 == 2\n")
    assert mutation.passes(["test_it.py"], tmp_path)
    (tmp_path / "test_it.py").write_text("def test_it():\n    assert 1 - 1 == 2\n")
    assert not mutation.passes(["test_it.py"], tmp_path)
    (tmp_path / "test_slow.py").write_text("import pytest\npytestmark = pytest.mark.slow\n\n\ndef test_it(): ...\n")
    assert mutation.passes(["test_slow.py"], tmp_path), "left out, and so is a file of nothing else"
    with pytest.raises(ValueError, match="--tests"):
        mutation.passes(["nowhere.py"], tmp_path)
