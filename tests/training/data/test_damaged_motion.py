import contextlib
import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib import format as npy
from tests.helpers.motion_files import AMC, ASF, bvh_text
from tests.helpers.motion_files import npz as archive

from steadypose.prior import npz
from steadypose.prior.mocap.bvh import read_bvh
from steadypose.prior.mocap.clip import MotionError
from steadypose.prior.mocap.files import read_motion
from steadypose.prior.npz import check_arrays
from steadypose.training.data.cmu import read_amc, read_asf

WORDS = [b"", b"nan", b"1e999", b"-1", b"0", b"{", b"}", b"JOINT", b"CHANNELS 99999", b"\n", b"\xff\0", b"9" * 30]
AMASS: dict[str, Any] = {"poses": np.zeros((3, 66)), "trans": np.zeros((3, 3)), "mocap_framerate": 30.0}
READERS: dict[str, tuple[str | bytes, Callable]] = {
    "bvh": (bvh_text(), lambda text: read_bvh(text).positions()),
    "asf": (ASF, read_asf),
    "amc": (AMC, lambda text: read_amc(text, read_asf(ASF))),
    "amass": (archive(**AMASS).getvalue(), lambda content: read_motion("a.npz", content)),
}


@pytest.mark.parametrize("kind", READERS)
@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_a_damaged_file_is_read_or_is_a_motion_error(kind: str, data: st.DataObject) -> None:
    content, read = READERS[kind]
    damaged = bytearray(content.encode() if isinstance(content, str) else content)
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(damaged)))
        end = data.draw(st.integers(start, min(start + 20, len(damaged))))
        damaged[start:end] = data.draw(st.one_of(st.sampled_from(WORDS), st.binary(max_size=8)))
    whole = damaged.decode("ascii", "replace") if isinstance(content, str) else bytes(damaged)
    with contextlib.suppress(MotionError):
        read(whole)


@pytest.mark.parametrize(("kind", "pattern", "instead", "message"), [
    ("bvh", ".*", "", "no MOTION up to the end on line 1$"),
    ("bvh", "CHANNELS 6.*", "", "no MOTION up to the end on line 4$"),
    ("bvh", "HIERARCHY", "", "expected HIERARCHY"),
    ("bvh", "OFFSET 1 2 3", "OFFSET 1 two 3", "line 4: a number in the hierarchy"),
    ("bvh", r"\}\nMOTION", "MOTION", "line 18: .* braces"),
    ("bvh", "JOINT.*MOTION", "MOTION", "line 5: the hierarchy is cut short"),
    ("bvh", r"HIERARCHY.*MOTION", "HIERARCHY\nMOTION", "line 1: the hierarchy is cut short"),
    ("bvh", "Xrotation", "Wrotation", "unknown channels"),
    ("bvh", "Frames: 1", "Frames: 2", "expected 2 frames of 12 numbers, found 12 .* on line 23; .* cut short"),
    ("bvh", "Frames: 1", "Frames: 0", "expected 0 frames of 12 numbers, found 12 .* on line 23$"),
    ("bvh", "Frame Time", "Frame Rate", "'Frame Time: S' after MOTION, found 'Frames: 1 Frame Rate: 0.04'"),
    ("bvh", "Time: 0.04", "Time: 0", "frame time above zero"),
    ("bvh", r"\d\n$", "x", "number in the motion"),
    ("asf", "angle deg", "angle rad", "degrees"),
    ("asf", ":hierarchy", ":other", "section ':hierarchy'"),
    ("asf", "RX RY RZ", "RX RY RY", "six freedoms"),
    ("asf", "root femur", "root thigh", "not known"),
    ("asf", "length 7.0", "length long", "expected numbers"),
    ("asf", "length 7.0", "", "bone cannot be read"),
    ("amc", ".*", "", "expected frames"),
    ("amc", "tibia 0", "", "cut or mixed"),
    ("amc", "tibia", "fibula", "bone 'tibia': expected 1 angles"),
    ("amc", "tibia 0", "fibula 0", "same place"),
    ("amc", "tibia 40", "tibia x", "bone 'tibia'"),
    ("amc", "root", "boot", "move 'root'"),
])  # fmt: skip
def test_what_is_no_motion_is_refused_in_words(kind: str, pattern: str, instead: str, message: str) -> None:
    content, read = READERS[kind]
    with pytest.raises(MotionError, match=message):
        read(re.sub(pattern, instead, str(content), flags=re.S))


@pytest.mark.parametrize(("arrays", "message"), [
    ({"trans": None}, "expected arrays trans"),
    ({"mocap_framerate": None}, "mocap_framerate"),
    ({"poses": np.zeros((3, 9))}, "66 or more"),
    ({"poses": np.zeros((2, 156))}, "66 or more"),
])  # fmt: skip
def test_what_amass_would_not_hold_is_refused_in_words(arrays: dict[str, Any], message: str) -> None:
    given = {name: array for name, array in (AMASS | arrays).items() if array is not None}
    with pytest.raises(MotionError, match=message):
        read_motion("a.npz", archive(**given).getvalue())


def bomb(shape: tuple[int, ...]) -> io.BytesIO:
    """An array that says to be larger than it is."""
    header, file = io.BytesIO(), io.BytesIO()
    npy.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("poses.npy", header.getvalue() + bytes(100))
        archive.writestr("trans.npy", header.getvalue() + bytes(100))
    file.seek(0)
    return file


def test_an_array_is_no_larger_than_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MotionError, match=r"poses: expected \(100000, 66\) float64, found \d+ bytes"):
        read_motion("a.npz", bomb((100_000, 66)).getvalue())
    monkeypatch.setattr(npz, "MAX_BYTES", 2**22)
    large = tmp_path / "large.npz"
    with zipfile.ZipFile(large, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("x.npy", "w") as entry:
        entry.write(bytes(2**22 + 1))
    assert large.stat().st_size < 2**16
    with pytest.raises(ValueError, match=f"x: .* bytes: expected at most {2**22}; cut it into parts"):
        check_arrays(large)


def test_many_arrays_are_together_no_larger_than_their_file_may_become(tmp_path: Path) -> None:
    several, many = tmp_path / "several.npz", tmp_path / "many.npz"
    arrays: dict[str, Any] = {f"a{n}": np.zeros(2**21) for n in range(5)}
    np.savez_compressed(several, **arrays)  # 80 MiB in 80 kB
    with pytest.raises(ValueError, match=r"bytes that become 83.*: expected at most 100 times as many"):
        check_arrays(several)
    np.savez(several, **arrays)
    check_arrays(several)
    clips: dict[str, Any] = {f"a{n}": np.zeros(1) for n in range(4000)}
    np.savez(many, **clips)  # as many clips as data sets come with
    check_arrays(many)
    with zipfile.ZipFile(many, "w") as archive:
        for n in range(npz.MAX_ARRAYS + 1):
            archive.writestr(f"{n}.npy", b"")
    with pytest.raises(ValueError, match="20001 arrays: expected at most 20000"):
        check_arrays(many)
