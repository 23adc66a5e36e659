import dataclasses
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from steadypose.msgs.topics import DIAGNOSTICS, POSE_WORLD, TOPICS
from steadypose.nodes.extras import EXTRAS
from steadypose.nodes.graph import topology
from steadypose.nodes.graph.launch import Launch, bundled, check_weights_of, find, in_launch_file
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.topology import NODES, POSE_NODES, NodeDeclaration, load, publishers
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.recorder import RecorderSettings
from steadypose.nodes.sources.registry import SOURCES, InputSettings, open_input
from steadypose.nodes.sources.source import LiveSource, SourceContext
from steadypose.prior.clean.settings import PriorSettings


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str) -> Path:
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return path

    return write


def test_an_empty_file_is_a_launch_and_the_projects_own_are_found_by_name(write) -> None:
    launch = Launch.read(write(""))
    assert launch.nodes == ["pose_input", "prior", "trajectory"]
    assert launch.settings(InputSettings).rate == 1.0
    assert launch.transport.endpoint("prior").startswith("ipc://")
    for name in ("replay", "kiosk"):
        recording = Path(Launch.read(name).settings(InputSettings).recording)
        assert recording.parent.resolve() == bundled("sim_data").resolve()


@pytest.mark.parametrize(("text", "expected"), [
    ("[inptu]", "did you mean 'input'"),
    ("[input]\nrecordin = 'x'", "did you mean 'recording'"),
    ("[input]\nrate = 'fast'", "expected float such as 1.0, got 'fast'"),
    ("input = 3", "expected a section"),
    ("nodes = ['priro']", "did you mean 'prior'"),
    ("nodes = ['prior', 'prior']", "nodes names 'prior' 2 times: expected each node once"),
    ("nodes = [['prior']]", r"nodes: expected each to be a text, got \['prior'\]"),
    ("nodes = []", "nodes: expected one or more of pose_input, prior"),
    ("[recorder]\ntopics = ['pose/row']", "did you mean 'pose/raw'"),
    ("[transport.endpoints]\nprio = 'tcp://127.0.0.1:1'", "did you mean 'prior'"),
    ("[transport.endpoints]\nprior = 7101", r"\[transport\] endpoints: expected each to be a text, got 7101"),
    (
        "[transport.endpoints]\nprior = 'tcp://127.0.0.1:7'\nweb = 'tcp://127.0.0.1:7'",
        r"\[transport.endpoints\] web: expected an address of its own, got tcp://127.0.0.1:7, as for prior",
    ),
    ("[transport]\nqueue = 0", "queue: expected 1 frame or more, got 0"),
    ("[input]\nrate = nan", "rate: expected a finite number such as 1.0, got nan"),
    (f"[input]\nrate = 1{400 * '0'}", "input.rate: expected an integer of at most 64 bits, got one of 1329"),
    (f"[input.calibration]\nsize = [1, 1{400 * '0'}]", "input.calibration.size: expected an integer of at most 64"),
    (f"[input]\nrate = 1{5000 * '0'}", "is not TOML: Exceeds the limit"),
    ("[input]\nrate = -1.0", r"rate: expected 0 \(as fast as possible\) or more, got -1"),
    ("[input.calibration]\nposition = ['a', 1, 2]", "position: expected each to be a float, got 'a'"),
    ("[input.calibration]\nposition = [1.0, 2.0]", r"input\.calibration"),
    ("[input.calibration]\nposition = [1.0, 2.0, 3.0]", r"input\.calibration"),
    ("[input.calibration]\nposition = [0.0, 0.0, 1.0]\norientation = [0.0, 0.0, 0.0, 2.0]", r"input\.calibration"),
    ("[input.calibration]\nposition = [nan, 0.0, 1.0]\norientation = [0.0, 0.0, 0.0, 1.0]", r"input\.calibration"),
    ("[input.calibration]\nsize = [640, 360]", r"input\.calibration"),
    ("[input.calibration]\nsize = [6, 3]\nfocal = [0.0, 5.0]\ncentre = [3.0, 1.0]", r"input\.calibration"),
    ("[input.webcam]\nbodies = 0", "bodies: expected 1 to 64, got 0"),
    ("[viewer]\nport = 65536", "port: expected 1 to 65535, got 65536"),
    ("[vmc]\nport = 0", "port: expected 1 to 65535, got 0"),
    ("[vmc]\nhost = ''", "host: expected an address"),
    ("[web]\nport = 65536", r"\[web\] port: expected"),
    ("[web]\nhost = ''", r"\[web\] host: expected"),
    ("[web]\ntoken = 'short'", r"\[web\] token: expected"),
    ("[web]\ntoken = 'with spaces, and so on'", r"\[web\] token: expected"),
    ("[ros2]\nworld_frame = ''", "without a slash"),
    ("[ros2]\nworld_frame = '/map'", "without a slash"),
    ("[recorder]\nkeep_mb = 10\nsplit_mb = 10", "expected two parts or more, 20, got 10"),
    ("[recorder]\nsync_s = -1", "sync_s: expected 0 or more"),
    ("[input.ros2]\ntype = 'Image'", "expected MarkerArray or PoseArray, got 'Image'"),
    ("[input.ros2]\nup = 'x'", "expected z, y or -y"),
    ("[input.webcam]\ncamera = -1", r"\[input\.webcam\] camera: expected"),
    ("[input.webcam]\nfield_of_view = 60.0", r"\[input\.webcam\] field_of_view, in radians: expected"),
    ("[input.oak]\nconfidence = 50", "confidence: expected 0 to 1, got 50"),
    ("[input.oak]\nfps = -1", "fps: expected 0 "),
    ("[input]\nsource = 'oka'", r"source: expected .*oak.*, got 'oka' \(did you mean 'oak'"),
    ("[input", "is not TOML"),
    ("delay = 2", r"delay is in no section: expected \[prior\] delay"),
    ("[input]\nloop = 'yes'", "loop: expected true or false, got 'yes'"),
    ("[prior]\ndelya = 2", r"^\[prior\] has no setting 'delya' \(did you mean 'delay'"),
    ("[prior.gate]\njmup = 2", r"^\[prior.gate\] has no setting 'jmup' \(did you mean 'jump'"),
    ("[prior]\ndelay = 40", "delay: expected 0 to 16, got 40"),
    ("[prior]\nbias_sigma = 20", "bias_sigma: expected 0 to 1, got 20"),
    ("[prior.gate]\nmin_confidence = 50", "min_confidence: expected 0 to 1, got 50"),
    ("[events]\nfaces = 30", "faces: expected 0 to 3.14159, got 30"),
    ("[trajectory]\nnetwrok = true", r"^\[trajectory\] has no setting 'netwrok' \(did you mean 'network'"),
])  # fmt: skip
def test_what_is_wrong_is_named_with_what_would_be_right(write, text: str, expected: str) -> None:
    with pytest.raises(LaunchError, match=expected):
        Launch.read(write(text))


def test_numbers_and_brackets_without_end_are_no_setting(write) -> None:
    for digits in (400, 5000):
        with pytest.raises(LaunchError, match=r"\[prior\] delay: expected int such as 4, got '10"):
            Launch.read(write(""), [f"prior.delay=1{digits * '0'}"])
    for text in ("x = " + "[" * 5000, "[[" * 5000, "x = " + "{a=" * 5000):
        with pytest.raises(LaunchError):
            Launch.read(write(text))
    with pytest.raises(LaunchError, match=r"input\.rate: lists or tables within lists"):
        Launch.read(write(""), ["input.rate=" + "[" * 5000])
    for nothing in ("input.rate", "=3", "input.rate.x=3"):
        with pytest.raises(LaunchError):
            Launch.read(write("[input]\nrate = 1"), [nothing])


def test_a_missing_file_names_those_there_are() -> None:
    with pytest.raises(LaunchError, match="did you mean 'replay'"):
        find("repaly")
    with pytest.raises(LaunchError, match=r"no launch file at web.tml \(did you mean 'web'"):
        find("web.tml")
    with pytest.raises(LaunchError, match="no launch file at"):
        find("/nowhere/x.toml")


def test_paths_start_at_the_file_and_overrides_win(write, tmp_path: Path) -> None:
    path = write("[input]\nrecording = 'walk'\nrate = 2")
    launch = Launch.read(path, ["input.rate=0", "prior.refine.enabled=false", "recorder.directory=/somewhere/out"])
    assert launch.settings(InputSettings).recording == str(tmp_path / "walk")
    assert launch.settings(InputSettings).rate == 0.0
    assert not launch.settings(PriorSettings).refine.enabled
    assert launch.settings(RecorderSettings).directory == "/somewhere/out"


@pytest.mark.parametrize("name", sorted(file.stem for file in bundled("launch").glob("*.toml")))
def test_a_copied_launch_file_means_the_same(name: str, tmp_path: Path) -> None:
    copied = tmp_path / "mine.toml"
    copied.write_bytes(find(name).read_bytes())
    assert Launch.read(copied) == Launch.read(name)
    assert Launch.read(copied).transport.lossless == (name == "replay"), "a camera waits for nobody"


def test_the_users_own_file_comes_before_a_bundled_stream(write, tmp_path: Path) -> None:
    launch = write("[input]\nrecording = 'walk_turn'")
    assert Launch.read(launch).settings(InputSettings).recording == str(bundled("sim_data", "walk_turn"))
    (tmp_path / "walk_turn").mkdir()
    assert Launch.read(launch).settings(InputSettings).recording == str(tmp_path / "walk_turn")
    with pytest.raises(LaunchError, match=r"the bundled stream is 'walk_turn', without a folder"):
        open_input(Launch.read(write("[input]\nrecording = 'sim_data/walk_turn'")))


def test_weights_are_looked_for_before_anything_starts(write, tmp_path: Path) -> None:
    check_weights_of(Launch.read(write("[prior.refine]\nweights = 'mine.safetensors'")))  # a stage that is off
    launch = Launch.read(write("[prior.smooth]\nweights = 'mine.safetensors'"))
    assert launch.settings(PriorSettings).smooth.weights == str(tmp_path / "mine.safetensors")
    with pytest.raises(LaunchError, match=r"no weights '.*mine.safetensors' for mixture"):
        check_weights_of(launch)
    with pytest.raises(LaunchError, match=r"no weights 'defualt' for contacts: .* there are default"):
        check_weights_of(Launch.read(write("[trajectory]\ncontact_weights = 'defualt'")))


def test_an_abbreviated_setting_is_completed_and_a_wrong_one_refused() -> None:
    as_they_are = ["nodes=['prior']", "prior.gate={}", "input.options.port=7", "transport.queue=4"]
    assert in_launch_file("replay", ["delay=2", *as_they_are]) == ["prior.delay=2", *as_they_are]
    for wrong, near in {"prior.delya": "prior.delay", "priro.delay": "prior.delay", "input.rat": "input.rate"}.items():
        with pytest.raises(LaunchError, match=rf"--set {wrong}: no such setting \(did you mean '{near}'"):
            in_launch_file("replay", [f"{wrong}=2"])


def test_who_must_hear_whom(write) -> None:
    launch = Launch.read(write("nodes = ['pose_input', 'prior', 'trajectory', 'recorder', 'viewer']"))
    assert launch.reliable_subscribers("pose_input") == {"prior", "recorder"}
    assert launch.reliable_subscribers("prior") == {"trajectory", "recorder"}
    assert launch.reliable_subscribers("trajectory") == {"recorder"}
    assert launch.reliable_subscribers("recorder") == frozenset()
    live = Launch.read(write("[transport]\nlossless = false"))
    assert live.reliable_subscribers("pose_input") == frozenset(), "a camera waits for nobody"


@pytest.mark.parametrize("name", NODES)
def test_a_declaration_names_what_exists(name: str) -> None:
    declared = NODES[name]
    node = load(declared.node)
    assert issubclass(node, Node)
    assert node.name == name
    if declared.settings:
        assert dataclasses.is_dataclass(load(declared.settings))
        assert declared.section
    assert declared.extra in {"", *EXTRAS}
    assert not declared.preflight or callable(load(declared.preflight))
    for publisher, topics in declared.subscribes.items():
        assert set(topics) <= {*NODES[publisher].publishes, DIAGNOSTICS}, f"{name} of {publisher}"


def test_every_topic_has_publishers() -> None:
    assert all(publishers(topic) for topic in TOPICS)
    assert publishers(DIAGNOSTICS) == list(POSE_NODES)


@pytest.mark.parametrize("name", SOURCES)
def test_a_declaration_of_a_source_names_what_exists(name: str) -> None:
    (opens, extra), settings = SOURCES[name], getattr(InputSettings(), name)
    assert not extra or extra in EXTRAS
    if name == "recording":
        assert settings == ""
    else:
        assert dataclasses.is_dataclass(settings)
        # a class, or a function that chooses one
        assert not isinstance(opens, type) or issubclass(opens, LiveSource)


def test_reading_a_launch_file_takes_none_of_the_nodes_libraries() -> None:
    code = (
        "import sys; import steadypose.nodes.sources.pose_input, steadypose.nodes.commands.node; "
        "from steadypose.nodes.graph.launch import Launch; "
        "[Launch.read(name) for name in ('replay', 'oak', 'webcam', 'server', 'two_cameras', 'ros2')]; "
        "print(*({'torch', 'numba', 'cv2', 'depthai', 'rclpy', 'rerun', 'matplotlib'} & sys.modules.keys()))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    before = dict(NODES)
    module = ModuleType("acme")
    monkeypatch.setitem(sys.modules, "acme", module)
    yield module
    topology._NODES.clear()
    topology._NODES.update(before)


def read(path: Path, text: str) -> Launch:
    path.write_text(text)
    return Launch.read(path)


def test_a_node_of_another_package_is_one_of_the_graph(package: Any, tmp_path: Path) -> None:
    package.ROBOT = NodeDeclaration("acme:RobotNode", subscribes={"trajectory": (POSE_WORLD,)}, section="robot")
    text = 'nodes = ["pose_input", "trajectory", "robot"]\nplugins = {robot = "acme:ROBOT"}\n[robot]\nspeed = 2'
    launch = read(tmp_path / "a.toml", text)
    assert launch.table("robot") == {"speed": 2}
    assert launch.reliable_subscribers("trajectory") == {"robot"}
    assert read(tmp_path / "a.toml", text) == launch
    assert list(NODES)[-1] == "robot"
    assert in_launch_file(tmp_path / "a.toml", ["robot.speed=3"]) == ["robot.speed=3"]


def test_a_source_of_another_package_gets_its_options(package: Any, tmp_path: Path) -> None:
    given = []

    def opens(options: dict[str, Any], context: SourceContext) -> object:
        given.append((options, context.calibration))
        return source

    source = object()
    package.opens = opens
    launch = read(tmp_path / "a.toml", '[input]\nsource = "acme:opens"\noptions = {port = 7}')
    settings = launch.settings(InputSettings)
    assert open_input(launch) is source
    assert given == [({"port": 7}, settings.calibration)]


@pytest.mark.parametrize(("text", "match"), [
    ('plugins = {robot = "acme:ROBOT"}', "robot: acme:ROBOT cannot be imported: .*install its package"),
    ('plugins = {robot = "nobody:ROBOT"}', "cannot be imported: No module named 'nobody'"),
    ('plugins = {robot = "acme"}', "expected module:name, got 'acme'"),
    ('plugins = {robot = "acme:TEXT"}', "expected a NodeDeclaration, got str"),
    ('plugins = {prior = "acme:OTHER"}', "there is a node of that name already"),
    ('[input]\nsource = "acme:opens"', r"\[input\] source: acme:opens cannot be imported"),
])  # fmt: skip
def test_what_is_no_plugin_is_said(package: Any, tmp_path: Path, text: str, match: str) -> None:
    package.TEXT, package.OTHER = "text", NodeDeclaration("acme:Node")
    with pytest.raises(LaunchError, match=match):
        open_input(read(tmp_path / "a.toml", text))
