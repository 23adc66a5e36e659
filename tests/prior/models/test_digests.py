"""The digests of the weights that ship, which go with each release, are theirs."""

import hashlib

from steadypose import PACKAGE

WEIGHTS = PACKAGE / "prior" / "weights"


def test_the_digests_are_of_all_weights() -> None:
    lines = [line.split() for line in (WEIGHTS / "SHA256SUMS").read_text().splitlines()]
    listed = {name: digest for digest, name in lines}
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in WEIGHTS.glob("*.[sj]*")}
    assert listed == found, "in prior/weights: sha256sum *.safetensors *.json > SHA256SUMS"
