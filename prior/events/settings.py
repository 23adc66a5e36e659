"""``[events]`` of a launch file: the thresholds, in metres, radians, seconds and m/s."""

from __future__ import annotations

from dataclasses import dataclass, fields

from steadypose.prior.settings import check_range


@dataclass(frozen=True)
class EventSettings:
    """When something begins; it ends beyond a second, laxer threshold, so that it does not flicker.

    Chosen on simulated streams, on the validation people of Bandai-Namco and on LAFAN1's subject 1
    (``benchmarks/systems/events.py``).
    """

    confidence: float = 0.7
    """probability, by the joints' standard deviations, that a threshold is crossed, from which on it counts as such"""
    hold: float = 0.07
    """seconds for which a condition holds before it begins or ends"""
    entered: float = 0.15
    """seconds for which a body is followed before it has entered, and any of its events is published"""
    left: float = 0.2
    """seconds after which a body that is no longer followed has left"""
    near: float = 1.2
    """metres on the floor from the sensor to the pelvis: nearer is near"""
    near_margin: float = 0.2
    """metres farther than ``near`` at which one no longer is"""
    faces: float = 0.6
    """radians between where the trunk faces and the sensor"""
    faces_margin: float = 0.2
    """radians more, at which one no longer faces it"""
    stands: float = 0.85
    """height of the hips above the lower ankle, in lengths of the leg, from which on one stands"""
    stands_margin: float = 0.2
    """the same, less by which one no longer stands"""
    sits: float = 0.95
    """radians of the more upright thigh from the vertical, from which on one sits"""
    sits_margin: float = 0.25
    """radians less, at which one no longer sits"""
    lies: float = 0.65
    """metres from the lowest to the highest of head, trunk, knees and feet, under which one lies"""
    lies_margin: float = 0.15
    """metres more, at which one no longer lies"""
    fell_speed: float = 1.2
    """m/s downwards of the neck, on the way to lying, from which on it was a fall"""
    fell_within: float = 2.0
    """seconds before lying in which that counts"""
    raised: float = 0.0
    """metres of the fingertips above the neck from which on that hand is raised"""
    raised_margin: float = 0.08
    """metres less, at which it no longer is"""
    wave_swing: float = 0.45
    """radians of the forearm, from side to side, that are a swing of a wave"""
    wave_within: float = 0.8
    """seconds in which the next swing comes; without it, the wave is over"""
    point_elbow: float = 2.4
    """radians of the elbow's inner angle from which on an arm is stretched out (pi is straight)"""
    point_elbow_margin: float = 0.25
    """radians less, at which it no longer is"""
    point_lift: float = 0.9
    """radians between the arm and the vertical, up or down, from which on it points and does not hang or reach up"""
    point_speed: float = 0.4
    """m/s of a wrist, under which a stretched arm points"""
    point_hold: float = 0.15
    """seconds for which it does so before it points"""

    def __post_init__(self) -> None:
        check_range("[events] confidence", self.confidence, 0.5, 0.999)
        for setting in fields(self):
            if setting.name != "confidence":
                check_range(f"[events] {setting.name}", getattr(self, setting.name), 0.0, 60.0)
