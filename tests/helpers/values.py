"""The values that steps of the pipeline take, made by hand, and what the whole pipeline answers."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from tests.helpers.bodies import stream

from steadypose.msgs.types import CleanBody, JointState, PoseClean, PoseRaw
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.clean.frame import Estimate, Gated, Observation
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings


def clean(messages: Iterable[PoseRaw], **settings: Any) -> tuple[list[PoseClean], PriorPipeline]:
    """All answers of the prior with these settings, and the prior."""
    pipeline = PriorPipeline(PriorSettings.from_dict(settings))
    cleaned = [answer for message in messages for answer in pipeline.process(message)]
    return cleaned + pipeline.flush(), pipeline


def clean_bodies(positions: np.ndarray, **settings: Any) -> list[CleanBody]:
    """The answers to one body (T, 22, 3)."""
    return [answer.bodies[0] for answer in clean(stream(positions), **settings)[0]]


def observation(positions: np.ndarray, stamp_s: float = 0.0, confidence: np.ndarray | None = None) -> Observation:
    """Of bodies (S, 22, 3) that are all there."""
    return Observation(
        stamp_s=stamp_s, positions=positions,
        confidence=np.ones(positions.shape[:2]) if confidence is None else confidence,
        present=np.ones(len(positions), dtype=bool), sensor_position=np.zeros(3),
        layout_sigma=np.zeros(positions.shape[:2]),
    )  # fmt: skip


def gated(positions: np.ndarray, stamp_s: float = 0.0) -> Gated:
    """Bodies (S, 22, 3) that are all there, as they came."""
    faulty = np.zeros(positions.shape[:2], dtype=bool)
    return Gated(observation(positions, stamp_s), positions, np.zeros(len(positions)), faulty)


def estimate(positions: np.ndarray, sigma: float = 0.01) -> Estimate:
    """Of bodies (S, 22, 3) that are observed, each joint to ``sigma`` metres."""
    count = len(positions)
    turns, bones = np.tile(np.eye(3), (count, 22, 1, 1)), np.tile(REST_OFFSETS, (count, 1, 1))
    state = np.full((count, 22), JointState.REFINED, dtype=np.uint8)
    return Estimate(0.0, positions, turns, bones, np.full((count, 22), sigma), state)
