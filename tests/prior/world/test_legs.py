from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from steadypose.msgs.types import CONTACTS
from steadypose.prior.body.skeleton import J
from steadypose.prior.world.observe import FEET, FEET_OF_LEGS, GUESSED_S, LEG_CONTACTS, LegMemory

DT = 1 / 30


def frame(*joints: str, dt: float = DT) -> Any:
    """An observation of these joints."""
    return SimpleNamespace(observed=np.isin(np.arange(22), [J[name] for name in joints]), dt=dt)


def guessed(memory: LegMemory, *joints: str, dt: float = DT) -> set[str]:
    """The names of the joints that are guesses when these are observed."""
    return {name for name, is_guess in zip(CONTACTS, memory.update(frame(*joints, dt=dt)), strict=False) if is_guess}


LEGS = set(CONTACTS[:6])


def test_feet_are_where_they_are_said_to_be() -> None:
    assert [J[name] for name in CONTACTS[LEG_CONTACTS][FEET_OF_LEGS]] == list(FEET)
    assert {name for name in CONTACTS if "wrist" not in name} == LEGS


def test_what_was_never_observed_is_a_guess_from_the_first_frame() -> None:
    assert guessed(LegMemory(), "left_hip", "right_hip", dt=0.0) == LEGS
    assert guessed(LegMemory(), *LEGS, dt=0.0) == set()


@pytest.mark.parametrize("part", ["ankle", "foot"])
def test_an_ankle_or_toes_are_a_foot_with_its_knee_and_a_knee_is_none(part: str) -> None:
    for side in ("left", "right"):
        assert guessed(LegMemory(), f"{side}_{part}") == {name for name in LEGS if not name.startswith(side)}
    assert guessed(LegMemory(), "right_knee") == LEGS - {"right_knee"}


def test_what_is_hidden_is_a_guess_after_a_while_and_none_when_it_is_observed_again() -> None:
    memory = LegMemory()
    guessed(memory, *LEGS, dt=0.0)
    times = []
    for _ in range(100):
        times.append(guessed(memory, "left_knee", "left_ankle"))
    hidden = LEGS - {"left_knee", "left_ankle", "left_foot"}
    first = next(k for k, names in enumerate(times, 1) if names)
    assert first * DT == pytest.approx(GUESSED_S, abs=DT)
    assert all(names == hidden for names in times[first:])
    assert hidden == {"right_knee", "right_ankle", "right_foot"}
    assert guessed(memory, "right_knee") == {"right_ankle", "right_foot"}
    assert guessed(memory, "right_foot") == set()
