import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from steadypose import PACKAGE

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The wrapper in a checkout that is installed already, with a command that tells where it runs and of what."""
    root = tmp_path / "the checkout"
    (root / ".venv" / "bin").mkdir(parents=True)
    for name in ("steadypose", "setup-environment.sh", "pyproject.toml", "uv.lock"):
        shutil.copy(ROOT / name, root)
    command = root / ".venv" / "bin" / "steadypose"
    command.write_text('#!/bin/sh\npwd\nprintf "%s|" "$@"\n')
    command.chmod(0o755)
    (root / ".venv" / ".installed-oak-ros2-view-web").touch()
    return root


@pytest.mark.parametrize("through", ["path", "link", "PATH"])
def test_the_wrapper_runs_where_the_caller_stands(checkout: Path, tmp_path: Path, through: str) -> None:
    elsewhere = tmp_path / "else where"
    elsewhere.mkdir()
    program, environment = str(checkout / "steadypose"), dict(os.environ)
    if through == "link":
        (elsewhere / "pose").symlink_to(checkout / "steadypose")
        program = "./pose"
    elif through == "PATH":
        program, environment["PATH"] = "steadypose", f"{checkout}:{environment['PATH']}"
    printed = subprocess.check_output([program, "clean", "a b.npz", "out/"], cwd=elsewhere, env=environment, text=True)
    assert printed == f"{elsewhere}\nclean|a b.npz|out/|"


@pytest.mark.parametrize("version", [(3, 9), (3, 14), None])
def test_a_python_that_cannot_be_used_is_not_taken(checkout: Path, tmp_path: Path, version: tuple[int, int] | None):
    shutil.rmtree(checkout / ".venv")
    names = tmp_path / "bin"
    names.mkdir()
    for tool in ("sh", "dirname", "readlink", "tr"):
        (names / tool).symlink_to(shutil.which(tool) or tool)
    stub = names / "python3"
    stub.write_text(
        "#!/bin/sh\nexit 127\n"
        if version is None
        else f'#!/bin/sh\nexec "{sys.executable}" -c "import sys; sys.version_info = {(*version, 0)}; $2"\n'
    )
    stub.chmod(0o755)
    done = subprocess.run(
        [checkout / "steadypose", "run"], env={"PATH": str(names)}, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert "needs Python 3.10 to 3.13" in done.stderr


def test_where_ros_is_sourced_its_python_is_taken(checkout: Path, tmp_path: Path) -> None:
    names = tmp_path / "bin"
    names.mkdir()
    for name in ("python3", "python3.11"):
        (names / name).symlink_to(sys.executable)
    script = 'root=. && . ./setup-environment.sh && basename "$(find_python)"'
    for ros, taken in (({}, "python3.11"), ({"ROS_DISTRO": "jazzy"}, "python3")):
        environment = {"PATH": f"{names}:/usr/bin:/bin"} | ros
        assert subprocess.check_output(["sh", "-c", script], cwd=checkout, env=environment, text=True) == f"{taken}\n"


def test_a_wheel_holds_one_package_with_all_that_running_takes(tmp_path: Path) -> None:
    builder = pytest.importorskip("hatchling.builders.wheel", reason="hatchling is not installed").WheelBuilder
    wheel = next(iter(builder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])))
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert "steadypose" in tops
    assert all(top == "steadypose" or top.endswith(".dist-info") for top in tops)
    wanted = [
        *(f"launch/{path.name}" for path in (PACKAGE / "launch").glob("*.toml")),
        *(f"launch/views/{path.name}" for path in (PACKAGE / "launch" / "views").iterdir()),
        *(f"msgs/msg/{path.name}" for path in (PACKAGE / "msgs" / "msg").glob("*.msg")),
        *(f"prior/weights/{path.name}" for path in (PACKAGE / "prior" / "weights").glob("*.safetensors")),
        *(str(path.relative_to(PACKAGE)) for path in (PACKAGE / "sim_data" / "walk_turn").iterdir()),
        "sim_data/manifest.json",
        "nodes/cli.py",
    ]
    assert {f"steadypose/{name}" for name in wanted} <= set(names)
    assert len([name for name in names if name.endswith(".mcap")]) == 1
    assert not [name for name in names if "/benchmarks/" in name or "__pycache__" in name]
    assert Path(wheel).stat().st_size < 30e6, "of which 11 MB are the HM-VAE of 64 frames, for complete --optimise"


MESSAGES_ALONE = """
import sys
blocked = ("numba", "scipy", "torch", "matplotlib", "rich", "tyro", "cv2", "depthai", "safetensors")
sys.modules.update(dict.fromkeys(blocked))
import steadypose.msgs.codec, steadypose.msgs.security, steadypose.msgs.recording, steadypose.msgs.transport
from steadypose import PACKAGE
from steadypose.msgs.recording import RecordingReader
with RecordingReader(PACKAGE / "sim_data" / "walk_turn") as recording:
    print(sum(1 for _ in recording.messages(["pose/raw"])) > 100)
"""


def test_messages_take_numpy_rosbags_mcap_and_pyzmq_alone() -> None:
    done = subprocess.run([sys.executable, "-c", MESSAGES_ALONE], capture_output=True, text=True, timeout=60)
    assert done.stdout == "True\n", done.stderr
