"""``python -m steadypose.benchmarks.systems.fuzz``: readers on malformed input.

    python -m steadypose.benchmarks.systems.fuzz --seconds 600
    python -m steadypose.benchmarks.systems.fuzz --seconds 60 --only codec recording

Inputs are whole ones, damaged: bits flipped, bytes taken out, doubled and exchanged, numbers replaced by extreme ones;
so most get past the first check. Each must be read, or refused with the reader's own error, within `SLOW_S`, and the
process must not grow. Where atheris is installed, ``--guided`` lets it look for new ways through the code.
"""

from __future__ import annotations

import argparse
import io
import json
import random
import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType

import numpy as np

from steadypose import PACKAGE
from steadypose.benchmarks.systems.motion_files import AMC, ASF, BVH, amass
from steadypose.msgs.codec import DecodeError, decode, encode
from steadypose.msgs.recording import RecordingError, RecordingReader
from steadypose.msgs.topics import POSE_RAW
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sources.csv import CsvError, CsvSource
from steadypose.nodes.sources.npz import NpzError, NpzSource
from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.motion.amc import read_amc, read_asf
from steadypose.prior.motion.bvh import read_bvh
from steadypose.prior.motion.clip import MotionError
from steadypose.prior.motion.npz import read_amass

SLOW_S = 5.0
"""that a reader may take for an input of some kilobytes"""
NUMBERS = (b"nan", b"inf", b"-1", b"0", b"1e999", b"1e-320", b"9" * 40, b"0x1", b"", b"{", b"}", b'"', b"\n", b"\0")
SETTLED = 1000
"""inputs after which memory is first measured: caches are full by then"""


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


def fuzz(name: str, target: Target, seconds: float, random_: random.Random) -> dict[str, object]:
    """Damage and read inputs for this long; returns the outcome."""
    ended, counts = time.monotonic() + seconds, Counter[str]()
    slowest, settled_mb, bad = 0.0, 0.0, []
    while (now := time.monotonic()) < ended:
        content = mutate(random_.choice(target.seeds), random_)
        try:
            target.read(content)
            counts["read"] += 1
        except target.errors:
            counts["refused"] += 1
        except Exception as error:
            counts["undocumented"] += 1
            if len(bad) < 3:
                bad.append({"error": traceback.format_exception_only(error)[-1].strip(), "input": content.hex()[:400]})
        slowest = max(slowest, time.monotonic() - now)
        if counts.total() == SETTLED:
            settled_mb = _most_mb()
    grown = _most_mb() - settled_mb if settled_mb else 0.0
    return {"inputs": counts.total(), **counts, "slowest_s": round(slowest, 3), "grown_mb": round(grown, 1), "bad": bad}


def _most_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def guided(name: str, target: Target, seconds: float) -> None:
    """Coverage-guided fuzzing with atheris, which ends the process."""
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="for all readers together")
    parser.add_argument("--only", nargs="+", default=[], help="these readers alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--guided", action="store_true", help="by coverage, with atheris; one reader")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        chosen = {k: t for k, t in targets(Path(folder)).items() if not arguments.only or k in arguments.only}
        share, failed = arguments.seconds / len(chosen), False
        for name, target in chosen.items():
            if arguments.guided:
                guided(name, target, share)
            found = fuzz(name, target, share, random.Random(arguments.seed))
            failed |= bool(found["bad"]) or float(str(found["slowest_s"])) > SLOW_S
            print(json.dumps({"reader": name, **found}), flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
