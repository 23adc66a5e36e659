"""Readers on malformed input.

Inputs are whole ones, damaged: bits flipped, bytes taken out, doubled and exchanged, numbers replaced by extreme ones;
so most get past the first check. Each must be read, or refused with the reader's own error, within `SLOW_S`, and the
process must not grow. Where atheris is installed, ``--guided`` lets it look for new ways through the code.
"""

from __future__ import annotations

import io
import random
import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress

from steadypose import PACKAGE
from steadypose.benchmarks.provenance import require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.benchmarks.systems.motion_files import AMC, ASF, BVH, amass
from steadypose.msgs.codec import DecodeError, decode, encode
from steadypose.msgs.recording import RecordingError, RecordingReader
from steadypose.msgs.topics import POSE_RAW
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sources.csv import CsvError, CsvSource
from steadypose.nodes.sources.npz import NpzError, NpzSource
from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.mocap.amc import read_amc, read_asf
from steadypose.prior.mocap.bvh import read_bvh
from steadypose.prior.mocap.clip import MotionError
from steadypose.prior.mocap.files import read_amass

DEPENDS_ON = ()

SLOW_S = 5.0
"""that a reader may take for an input of some kilobytes"""
NUMBERS = (b"nan", b"inf", b"-1", b"0", b"1e999", b"1e-320", b"9" * 40, b"0x1", b"", b"{", b"}", b'"', b"\n", b"\0")
TURN_S = 5.0
"""of each reader in its turn"""
QUICK_INPUTS = 20_000


@dataclass(frozen=True)
class Args:
    """Damaged inputs to every reader of files and messages. Ctrl-C ends it with what there is by then."""

    inputs: int = 10_000_000
    """of all readers together, each of which has as much time"""
    only: tuple[str, ...] = ()
    """these readers alone"""
    seed: int = 0
    """of the damage"""
    guided: float = 0.0
    """seconds for which atheris looks for ways through the code of one reader instead"""
    quick: bool = False
    """a few inputs, to see that it works; nothing is written unless --out says where"""
    out: Path | None = None
    """folder for the JSON file; benchmarks/results unless --quick"""


@dataclass(frozen=True)
class Target:
    """A reader, what it reads, and the errors that it may answer with."""

    seeds: list[bytes]
    read: Callable[[bytes], object]
    errors: tuple[type[Exception], ...]


def mutate(seed: bytes, random_: random.Random) -> bytes:
    """A damaged copy."""
    content = bytearray(seed)
    for _ in range(random_.choice((1, 1, 1, 2, 4, 16))):
        size = len(content)
        at, length = random_.randrange(size + 1), random_.choice((1, 2, 4, 8, 64))
        match random_.randrange(7):
            case 0 if size:
                content[min(at, size - 1)] ^= 1 << random_.randrange(8)
            case 1:
                content[at : at + length] = b""
            case 2:
                content[at:at] = content[at : at + length]
            case 3:
                other = random_.randrange(size + 1)
                content[at : at + length] = content[other : other + length]
            case 4:
                content[at : at + length] = random_.choice(NUMBERS)
            case 5:
                content[at : at + length] = random_.choice((b"\0", b"\xff", b"\x7f", b"\x80")) * length
            case _:
                del content[at:]
    return bytes(content)


def targets(folder: Path) -> dict[str, Target]:
    """All readers, by name.

    Args:
        folder: for the inputs of those that read files.
    """
    stream = next((PACKAGE / "sim_data" / "walk_turn").glob("*.mcap"))
    with RecordingReader(stream.parent) as reader:
        messages = [next(iter(reader.messages([topic]))) for topic in reader.topics]
    frames = [m for m in messages if m.topic == POSE_RAW]
    payloads = [f"{topic}\0".encode() + encode(message) for topic, _, message in messages]
    joints = SKELETONS["smpl22"].joints
    header = ",".join(f"{joint}_{axis}" for joint in joints for axis in "xyz")
    csv = f"# up: z\nstamp,{header}\n" + "\n".join(f"{k / 30}," + ",".join(["0.5"] * 66) for k in range(3))
    npz = io.BytesIO()
    np.savez(npz, positions=np.zeros((3, 22, 3)), skeleton="smpl22", fps=30.0, confidence=np.ones((3, 22)))
    skeleton = read_asf(ASF)
    assert frames

    def decoded(content: bytes) -> object:
        topic, _, payload = content.partition(b"\0")
        return decode(topic.decode(errors="replace"), payload)

    def from_file(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
        def read_file(content: bytes) -> object:
            path = folder / name
            path.write_bytes(content)
            return read(path)

        return read_file

    def from_text(read: Callable[[str], object]) -> Callable[[bytes], object]:
        return lambda content: read(content.decode("ascii", "replace"))

    def recorded(path: Path) -> None:
        with RecordingReader(path) as recording:
            for _ in recording:
                pass

    launch = b"\n".join(file.read_bytes() for file in [PACKAGE / "launch" / "replay.toml"])
    return {
        "codec": Target(payloads, decoded, (DecodeError,)),
        "recording": Target([stream.read_bytes()[:60_000]], from_file("x.mcap", recorded), (RecordingError,)),
        "launch": Target([launch], from_file("x.toml", Launch.read), (LaunchError,)),
        "npz": Target([npz.getvalue()], from_file("x.npz", lambda path: list(NpzSource(path))), (NpzError,)),
        "csv": Target([csv.encode()], from_file("x.csv", lambda path: list(CsvSource(path))), (CsvError,)),
        "bvh": Target([BVH.encode()], from_text(lambda text: read_bvh(text).positions()), (MotionError,)),
        "asf": Target([ASF.encode()], from_text(read_asf), (MotionError,)),
        "amc": Target([AMC.encode()], from_text(lambda text: read_amc(text, skeleton)), (MotionError,)),
        "amass": Target([amass()], lambda content: read_amass(io.BytesIO(content)), (MotionError,)),
    }


@dataclass
class Found:
    """What came of a reader's inputs so far.

    Attributes:
        counts: inputs by outcome: ``read``, ``refused``, ``undocumented``.
        slowest_s: the longest that an input took.
        bad: the first undocumented errors, each with its input.
    """

    counts: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    bad: list[dict[str, str]] = field(default_factory=list)


def fuzz(target: Target, found: Found, seconds: float, random_: random.Random) -> None:
    """Damage and read inputs for this long, and add up what comes of them."""
    ended = time.monotonic() + seconds
    while (now := time.monotonic()) < ended:
        content = mutate(random_.choice(target.seeds), random_)
        try:
            target.read(content)
            found.counts["read"] += 1
        except target.errors:
            found.counts["refused"] += 1
        except Exception as error:
            found.counts["undocumented"] += 1
            if len(found.bad) < 3:
                what = traceback.format_exception_only(error)[-1].strip()
                found.bad.append({"error": what, "input": content.hex()[:400]})
        found.slowest_s = max(found.slowest_s, time.monotonic() - now)


def in_turn(chosen: Mapping[str, Target], inputs: int, seed: int, progress: Progress) -> tuple[dict[str, Found], float]:
    """Every reader for `TURN_S` after the other, until there were so many inputs, or Ctrl-C.

    Returns:
        What came of them by reader, and by how many megabytes the process has grown since the first turns.
    """
    random_, found = random.Random(seed), {name: Found() for name in chosen}
    bar = progress.add_task("damaged inputs", total=inputs)
    settled_mb: float | None = None
    try:
        while (total := sum(each.counts.total() for each in found.values())) < inputs:
            settled_mb = _most_mb() if total and settled_mb is None else settled_mb
            for name, target in chosen.items():
                fuzz(target, found[name], TURN_S, random_)
                progress.update(bar, completed=sum(each.counts.total() for each in found.values()))
    except KeyboardInterrupt:
        pass
    return found, 0.0 if settled_mb is None else _most_mb() - settled_mb


def _most_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def guided(chosen: Mapping[str, Target], seconds: float) -> None:
    """Coverage-guided fuzzing of one reader with atheris, which ends the process.

    Raises:
        SystemExit: several are chosen.
    """
    if len(chosen) != 1:
        raise SystemExit(f"expected one reader with --guided, got {', '.join(chosen)}; choose it with --only")
    [(name, target)] = chosen.items()
    import atheris  # pyright: ignore[reportMissingImports, reportMissingModuleSource]

    def one(content: bytes) -> None:
        try:
            target.read(content)
        except target.errors:
            return

    for module in [m for key, m in sys.modules.items() if key.startswith(("steadypose.", "mcap.")) and m]:
        for attribute, value in list(vars(module).items()):
            if isinstance(value, FunctionType) and value.__module__ == module.__name__:
                setattr(module, attribute, atheris.instrument_func(value))  # pyright: ignore[reportAttributeAccessIssue]
    with tempfile.TemporaryDirectory() as corpus:
        for number, seed in enumerate(target.seeds):
            Path(corpus, f"{name}{number}").write_bytes(seed)
        atheris.Setup([sys.argv[0], corpus, f"-max_total_time={seconds:.0f}", "-max_len=65536"], one)
        atheris.Fuzz()


def main(args: Args) -> None:
    """Damage, read, print, write. Exit status 1 if a reader failed or was slow."""
    written = bool(args.out) or not args.quick
    if written:
        require_committed(args.out or RESULTS)
    console, began = Console(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder, Progress(console=console) as progress:
        chosen = {name: t for name, t in targets(Path(folder)).items() if not args.only or name in args.only}
        if args.guided:
            guided(chosen, args.guided)
        found, grown_mb = in_turn(chosen, QUICK_INPUTS if args.quick else args.inputs, args.seed, progress)
    table = _table(found, grown_mb, time.monotonic() - began)
    show(table, console)
    bad = {name: each.bad for name, each in found.items() if each.bad}
    if written:
        saved = save(
            "fuzz", sys.argv[1:], [table], {"bad": bad, "grown_mb": round(grown_mb, 1)}, DEPENDS_ON, args.out or RESULTS
        )
        console.print(f"wrote {saved}")
    if bad or any(each.slowest_s > SLOW_S for each in found.values()):
        console.print_json(data=bad)
        sys.exit(1)


def _table(found: Mapping[str, Found], grown_mb: float, seconds: float) -> Table:
    outcomes = ("read", "refused", "undocumented")
    rows = [
        [name, f"{each.counts.total():,}", *(f"{each.counts[k]:,}" for k in outcomes), f"{each.slowest_s:.2f}"]
        for name, each in found.items()
    ]
    total = [f"{sum(each.counts[k] for each in found.values()):,}" for k in outcomes]
    slowest = max(each.slowest_s for each in found.values())
    everything = f"{sum(each.counts.total() for each in found.values()):,}"
    return Table(
        name="fuzz",
        title="Damaged inputs of every reader",
        columns=["reader", "inputs", *outcomes, "slowest, s"],
        rows=[*rows, ["all", everything, *total, f"{slowest:.2f}"]],
        note="Whole inputs with bits flipped, bytes removed, doubled and exchanged, numbers made extreme. "
        f"Undocumented: answered with an error that is not the reader's own. In {seconds / 60:.1f} minutes the one "
        f"process grew by {grown_mb:.1f} MB.",
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
