import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from llvmlite import ir
from numba.core import event, types
from numba.extending import intrinsic

from steadypose.prior import loop_cache
from steadypose.prior.compiled import njit
from steadypose.prior.loop_cache import LOOPS

ADDED = 2.0


def add(x):
    return x + ADDED


def add_more(x):
    return x + ADDED + 1


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where entries are kept for this test."""
    loop_cache.writable.cache_clear()
    loop_cache.announce.cache_clear()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("STEADYPOSE_UNCACHED", raising=False)
    yield loop_cache.folders()[0]
    loop_cache.writable.cache_clear()


def compiles(work: Callable[[], Any]) -> int:
    """How many functions numba compiles for this."""
    with event.install_recorder("numba:compile") as recorded:
        work()
    return sum(made.is_start for _, made in recorded.buffer)


def entry(folder: Path) -> Path:
    (file,) = folder.iterdir()
    return file


def test_what_one_has_compiled_another_loads(folder: Path) -> None:
    assert compiles(lambda: njit(cache=True)(add)(1.0)) == 1
    again = njit(cache=True)(add)
    assert compiles(lambda: again(1.0)) == 0
    assert again(1.0) == 3.0
    assert entry(folder).stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("damage", [
    lambda data: b"",
    lambda data: data[:-1],
    lambda data: bytes(len(data)),
    lambda data: data[:-9] + b"x" + data[-8:],
], ids=["empty", "cut off", "zeros", "a byte"])  # fmt: skip
def test_a_damaged_entry_is_compiled_anew(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    njit(cache=True)(add)(1.0)
    whole = entry(folder).read_bytes()
    entry(folder).write_bytes(damage(whole))
    assert njit(cache=True)(add)(1.0) == 3.0
    assert compiles(lambda: njit(cache=True)(add)(1.0)) == 0


def test_the_doctor_removes_what_is_damaged_and_the_mark_that_all_is_there(folder: Path) -> None:
    njit(cache=True)(add)(1.0)
    damaged = entry(folder)
    loop_cache.mark_complete(folder, {damaged.name})
    assert loop_cache.is_complete()
    assert loop_cache.remove_damaged() == 0
    damaged.write_bytes(b"")
    assert loop_cache.remove_damaged() == 1
    assert not loop_cache.is_complete()
    assert not damaged.exists()


def test_it_is_compiled_anew_when_anything_that_it_is_made_of_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    def digest(function: Callable[..., Any], **options: Any) -> str:
        return loop_cache.digest(njit(cache=True, **options)(function))

    inner = njit(cache=True)(add)

    def calls(x):
        return inner(x)

    first = digest(add), digest(calls)
    assert first == (digest(add), digest(calls))
    assert digest(add, fastmath=True) != first[0]
    assert digest(add_more) != first[0]
    monkeypatch.setitem(globals(), "ADDED", 3.0)
    inner = njit(cache=True)(add)
    assert digest(add) != first[0]
    assert digest(calls) != first[1]


def test_it_is_compiled_anew_when_instructions_that_it_writes_itself_change() -> None:
    def digest(constant: int) -> str:
        @intrinsic
        def write(_: Any) -> Any:
            return types.intp(), lambda context, builder, signature, arguments: ir.IntType(64)(constant)

        def calls():
            return write()  # pyright: ignore[reportCallIssue]

        return loop_cache.digest(njit(cache=True)(calls))

    assert digest(1) == digest(1)
    assert digest(1) != digest(2)


def test_where_nothing_can_be_written_it_is_said_once_and_all_works(tmp_path: Path, folder: Path, caplog) -> None:
    (tmp_path / "cache").write_text("in the way")
    with caplog.at_level(logging.WARNING):
        assert [njit(cache=True)(function)(1.0) for function in (add, add_more)] == [3.0, 4.0]
    assert sum("cannot be kept" in line for line in caplog.messages) == 1
    assert not loop_cache.is_complete()


def test_a_folder_that_others_may_write_to_is_not_read(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    njit(cache=True)(add)(1.0)
    folder.chmod(0o777)
    loop_cache.writable.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert compiles(lambda: njit(cache=True)(add)(1.0)) == 1
    assert "cannot be kept" in caplog.text


def test_beside_the_package_first_then_in_the_users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    beside, in_cache = loop_cache.folders()
    assert beside.is_relative_to(loop_cache.PACKAGE)
    assert in_cache.is_relative_to(tmp_path)


def test_all_are_there_until_a_source_changes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    njit(cache=True)(add)(1.0)
    loop_cache.mark_complete(folder, {entry(folder).name})
    assert loop_cache.is_complete()
    monkeypatch.setattr(loop_cache, "_sources", lambda: "others")
    assert not loop_cache.is_complete()


USES = """
import sys
import numpy as np
from steadypose.prior.body.kinematics import from_rotation_vectors
from steadypose.prior.clean.exchanged import distances
print(distances(np.zeros((1, 1, 3)), np.ones((1, 1, 3)))[0, 0], from_rotation_vectors(np.zeros(3)).trace())
print(*(name for name in sys.modules if name in ("numba.np.arrayobj", "numba.cpython.unicode")))
"""


@pytest.mark.slow
def test_what_is_compiled_is_loaded_without_the_modules_of_a_compiler(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    outputs = [
        subprocess.run([sys.executable, "-c", USES], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    assert [output.stdout.split("\n")[0] for output in outputs] == [f"{np.sqrt(3.0)} 3.0"] * 2
    assert "numba.np.arrayobj" in outputs[0].stdout
    assert outputs[1].stdout.split("\n")[1] == ""


pytestmark = pytest.mark.slow

SCRIPT = """
import sys
sys.path[:0] = sys.argv[1:]
import numpy as np
from numba.core import event
from conftest import walk
from steadypose.nodes.graph.loops import compile_from_the_end
from steadypose.prior.clean.pipeline import PriorPipeline, load_loops
from steadypose.prior.clean.settings import PriorSettings

load_loops(PriorSettings())
pipeline = PriorPipeline(PriorSettings())
with event.install_recorder("numba:compile") as compiled:
    for index, frame in enumerate(walk(50, bodies=3)):
        if 20 <= index < 35:
            for body in frame.bodies:
                body.positions[[7, 8, 10, 11, 20, 21]] = np.nan
        frame.bodies = frame.bodies[: 1 if index >= 45 else 3]
        pipeline.process(frame)
print(sorted({str(made.data["dispatcher"]) for _, made in compiled.buffer}))
compile_from_the_end()
"""


@pytest.mark.timeout(900)  # compiles all loops
def test_no_loop_is_left_for_a_frame_to_wait_for(tmp_path: Path) -> None:
    cold = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}  # what an earlier run compiled would hide what is missing
    root = Path(__file__).parents[2]
    paths = [str(root), str(root / "src"), str(root / "tests" / "nodes")]
    ran = subprocess.run([sys.executable, "-c", SCRIPT, *paths], env=cold, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == "[]"
    (folder,) = (tmp_path / "steadypose").iterdir()
    assert len(list(folder.iterdir())) == LOOPS
