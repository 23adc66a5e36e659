"""Programs in processes of their own."""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

SOURCES = Path(__file__).parents[2] / "src"


@contextmanager
def another_python(
    script: str, folder: Path, *arguments: str, python: Sequence[str] = (sys.executable,),
    environment: Mapping[str, str] | None = None,
) -> Iterator[subprocess.Popen[str]]:  # fmt: skip
    file = folder / f"script{len(list(folder.glob('script*.py')))}.py"
    file.write_text(script)
    environment = {**(os.environ if environment is None else environment), "PYTHONPATH": str(SOURCES)}
    with subprocess.Popen([*python, file, *arguments], env=environment, stdout=subprocess.PIPE, text=True) as it:
        try:
            yield it
        finally:
            it.kill()
