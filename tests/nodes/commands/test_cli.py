import ast
import subprocess
import sys
from io import BytesIO, TextIOWrapper
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from steadypose.nodes.cli import COMMANDS, USAGE_ERROR, main
from steadypose.nodes.extras import install_command
from steadypose.nodes.graph.launch import bundled
from steadypose.prior.models.weights import WEIGHTS


def python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_help_lists_every_command_and_imports_almost_nothing() -> None:
    out = python(
        "import sys; from steadypose.nodes.cli import main; main(['--help']);"
        "print(*(m for m in ('torch', 'numpy', 'tyro', 'rich', 'zmq') if m in sys.modules), sep='', end='')"
    )
    for name, (_, what) in COMMANDS.items():
        assert f"  {name}" in out
        assert what in out
    assert out.endswith("`steadypose help uninstall`.\n"), "and none of those modules"


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_s_help_has_an_example(name: str) -> None:
    place, _ = COMMANDS[name]
    file = place.removeprefix("steadypose.").replace(".", "/") if "." in place else f"nodes/commands/{place}"
    written = ast.parse((Path(__file__).parents[3] / f"{file}.py").read_text()).body
    (command,) = [it for it in written if isinstance(it, ast.FunctionDef) and it.name == name.replace("-", "_")]
    assert f" steadypose {name}" in (ast.get_docstring(command) or "").partition("Try:")[2]


def test_help_explains_upgrading_uninstalling_and_each_command(capsys, monkeypatch) -> None:
    monkeypatch.setattr("sys.prefix", "/somewhere/else")
    manual = (Path(__file__).parents[3] / "docs" / "library.md").read_text()
    for topic in ("upgrade", "uninstall"):
        assert main(["help", topic]) == 0
        printed = capsys.readouterr().out
        for command in ("pip install --upgrade", "pip uninstall steadypose"):
            assert command in printed
            assert command in manual
    with pytest.raises(SystemExit):
        main(["help", "keys"])
    assert "usage: steadypose keys" in capsys.readouterr().out
    assert main(["help", "upgrad"]) == USAGE_ERROR
    assert "no help on 'upgrad' (did you mean 'upgrade'?)" in capsys.readouterr().err


def test_what_a_terminal_would_obey_or_the_encoding_of_stdout_lacks_is_escaped(tmp_path: Path, monkeypatch, capsys):
    assert main(["run", "--input", "no\x1b[2J\nwhere"]) == USAGE_ERROR
    assert r"no\x1b[2J\x0awhere does not exist" in capsys.readouterr().err
    with TextIOWrapper(written := BytesIO(), "ascii") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        assert main(["keys", str(tmp_path / "grüße")]) == 0
        assert rb"gr\xfc\xdfe/own.key" in written.getvalue()


@pytest.mark.parametrize(("arguments", "expected"), [
    (["clean", "{idle}", "{tmp}/out", "--set", "reconstruct.weights={tmp}/text.safetensors"], "as .safetensors"),
    (["complete", "{idle}", "{tmp}/out", "--weights", "{weights}/contacts-default.safetensors"], "of completer"),
    (["simulate", "{tmp}/out", "--manifest", "{tmp}/list.json"], "expected JSON with an object 'streams'"),
    (["simulate", "{tmp}/out", "--manifest", "{tmp}/entry.json"], "walk: expected an object with keys"),
    *(
        pytest.param(*row, marks=pytest.mark.slow)
        for row in (
            (["fit", "{tmp}/cut.npz", "{tmp}/out.npz"], "cannot be read as .npz"),
            (["train", "hmvae", "--data", "{tmp}/text.npz"], "that 'steadypose prepare' writes"),
            (["train", "hmvae", "--data", "{tmp}/other.npz"], "it lacks"),
            (["train", "hmvae", "--weights", "kinect_v2"], "expected default or research for hmvae, got kinect_v2"),
            (["train", "mixture", "--weights", "research"], "expected default for mixture, got research"),
            (["train", "mixture", "--data", "{tmp}"], "expected motion capture of"),
            (["train", "correction", "--data", "{tmp}/text.npz"], "text.npz: expected an .npz archive"),
            (["evaluate", "kinect_vicon", "--quick", "--mocap", "{tmp}"], "the folder that holds ui_prmd.npz"),
            (["evaluate", "fidelity", "--quick", "--data", "{tmp}/other.npz"], "it lacks"),
        )
    ),
])  # fmt: skip
def test_other_files_are_refused_in_a_line(capsys, tmp_path: Path, arguments: list[str], expected: str) -> None:
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "text.safetensors").write_text("hello, world")
    np.savez(tmp_path / "other.npz", a=1)
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04" + bytes(60))
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "entry.json").write_text('{"streams": {"walk": 3}}')
    places = {"idle": bundled("sim_data", "idle"), "tmp": tmp_path, "weights": WEIGHTS}
    assert main([argument.format(**places) for argument in arguments]) == USAGE_ERROR
    assert expected in " ".join(capsys.readouterr().err.split())


def test_a_bug_keeps_its_traceback(monkeypatch) -> None:
    monkeypatch.setattr("steadypose.nodes.commands.small.create_keys", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["keys", "somewhere"])


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    command = f"{sys.executable} -m steadypose.nodes.cli --help | true"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", command], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_needs_no_torch_does_not_import_it_and_what_an_extra_brings_is_named() -> None:
    lacking = {
        "torch": ("train", ["train", "hmvae"]),
        "matplotlib": ("view", ["plot", "x"]),
        "cv2": ("oak", ["calibrate", "board", "b.pdf"]),
        "depthai": ("oak", ["run", "oak"]),
    }
    code = f"""
import sys
from contextlib import redirect_stderr
from steadypose.nodes.cli import USAGE_ERROR, main
for command in ("run", "node", "keys", "echo", "info", "train"):
    try:
        main([command, "--help"])
    except SystemExit as end:
        assert end.code == 0
    assert "torch" not in sys.modules, command
for missing, (_, arguments) in {lacking}.items():
    sys.modules[missing] = None
    with redirect_stderr(sys.stdout):
        assert main(arguments) == USAGE_ERROR
    del sys.modules[missing]
"""
    printed = python(code).split("\n")
    for missing, (extra, _) in lacking.items():
        assert any(f"needs {missing}" in line and install_command(extra) in line for line in printed), printed
    assert not any("Traceback" in line for line in printed)


@pytest.mark.parametrize(
    "command", [*([it] for it in COMMANDS if it != "node"), ["calibrate", "floor"], ["calibrate", "board"]]
)
def test_help_fits_80_columns_and_breaks_between_words(command: list[str], monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    words = {word for line in lines for word in line.split()}
    assert not any("{None" in word for word in words)
    assert "None)" not in words, "no default beside the one that is described"
    first = {line.split()[0] for line in lines if line[:2] == "  " and line.strip()}
    assert not {"STR", "[STR]", "PATH"} & first, "a name says more"
    text = lines[lines.index("") :]
    for line, after in pairwise(text):
        if line[:1].strip() and after[:1].strip():
            assert len(line) + 1 + len(after.split()[0]) > 80, f"broken early: {line}"
    assert words >= {"steadypose", "options"}
    assert not any(line.strip() in ("the", "own", "any") for line in lines), "no line of a docstring shows"
    assert main(["help"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
