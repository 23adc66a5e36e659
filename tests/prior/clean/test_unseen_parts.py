import numpy as np

from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.occluded import _of_unseen_parts


def test_a_part_of_which_nothing_was_ever_observed_is_less_certain_than_the_completion_says() -> None:
    never = np.zeros((2, 22), dtype=bool)
    for part in ("left_hip", "right_hip", "spine1", "spine2", "left_knee"):
        never[0, J[part]] = True
    never[1, J["left_hip"]] = True
    factors = _of_unseen_parts(never)
    assert factors[0, J["left_hip"]] == factors[0, J["spine1"]] == 2.0
    assert factors[0, J["left_knee"]] == 1.0, "its ankle and foot were observed"
    assert (factors[1] == 1.0).all()
