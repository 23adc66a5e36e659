import hashlib
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from steadypose.prior.models.weights import _PARTS, WEIGHTS, WeightsError, load_weights


def model_of(path: Path) -> str:
    return "faults" if ".faults" in path.suffixes else path.stem.partition("-")[0].removesuffix("64")


@pytest.mark.parametrize("path", sorted(WEIGHTS.glob("*.safetensors")), ids=lambda path: path.stem)
def test_weights_that_ship_are_those_of_one_model_alone(path: Path, tmp_path: Path) -> None:
    arrays, _ = load_weights(str(path), model_of(path))
    assert all(array.dtype == np.float32 for array in arrays.values())
    copy = tmp_path / f"{path.name.partition('.')[0]}.safetensors"
    copy.write_bytes(path.read_bytes())
    for other in set(_PARTS) - {"faults", model_of(path)}:
        with pytest.raises(WeightsError, match=f"expected weights of {other}"):
            load_weights(str(copy), other)


def test_a_missing_file_a_damaged_one_and_one_without_configuration_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no weights 'own' for correction: .*; there are kinect_v2"):
        load_weights("own", "correction")
    path = tmp_path / "contacts-own.safetensors"
    path.write_bytes(b"\xff" * 100)
    with pytest.raises(WeightsError, match="expected weights as"):
        load_weights(str(path), "contacts")
    save_file({"head.weight": np.zeros(1), "unit.weight": np.zeros(1)}, path)
    with pytest.raises(WeightsError, match="no configuration"):
        load_weights(str(path), "contacts")


def test_the_digests_that_go_with_each_release_are_of_all_weights() -> None:
    lines = [line.split() for line in (WEIGHTS / "SHA256SUMS").read_text().splitlines()]
    listed = {name: digest for digest, name in lines}
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in WEIGHTS.glob("*.[sj]*")}
    assert listed == found, "in prior/weights: sha256sum *.safetensors *.json > SHA256SUMS"
