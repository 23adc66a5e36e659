"""The simulated scenes. Each function returns the motions of all people of one scene, from a random generator.

People move on the world's floor. The camera is near the origin and looks along +x, so a person who faces it has a yaw
of pi. People are 2 to 4 m away.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.capsules import random_offsets
from steadypose.prior.body.skeleton import J
from steadypose.prior.sim.gait import RATE, Key, Plan, Stand, Turn, Walk, minimum_jerk, plan, track
from steadypose.prior.sim.motion import SIDES, SIGN, ArmAction, Intent, Motion, Side, perform

_FACING_CAMERA = np.pi


def _person(rng: np.random.Generator) -> Floats:
    return random_offsets(rng, rng.uniform(1.55, 1.90))


def _during(times: Floats, start: float, end: float, blend: float) -> Floats:
    """(T,) 0, then 1 from ``start + blend`` to ``end - blend`` seconds, then 0."""
    return minimum_jerk((times - start) / blend) - minimum_jerk((times - end + blend) / blend)


def idle(rng: np.random.Generator) -> list[Motion]:
    """Stand in front of the camera, shift weight, look around, look at a watch."""
    ground = plan((2.6, 0.1), _FACING_CAMERA + 0.2, [Stand(16.0)])
    intent = Intent(ground)
    t = ground.times
    to_one_leg = _during(t, 1.5, 6.5, 1.2) - _during(t, 8.0, 14.5, 1.4)
    intent.shift[:, 1] = 0.045 * to_one_leg
    intent.torso[:, 0] = np.radians(-3.0) * to_one_leg
    glances = [Key(1, 2, [0.6, 0.0]), Key(4, 5, [-0.4, 0.1]), Key(6.6, 7.4, [0.35, 0.45]), Key(9.6, 10.6, [0.0, 0.0])]
    intent.gaze = track(t, [0.0, 0.0], glances)
    intent.arms["left"] = [
        ArmAction(_during(t, 6.5, 10.2, 1.1), np.array([0.48, -0.25, -0.35]), np.array([-0.2, 0.7, -1.0]), "shoulder")
    ]
    return [perform(intent, _person(rng), rng)]


def walk_turn(rng: np.random.Generator) -> list[Motion]:
    """Walk a loop through the room with turns to both sides, stop, turn about on the spot and walk back."""
    parts = [
        Stand(1.0),
        Walk([(2.7, -0.9), (2.2, 0.0), (2.8, 0.8), (3.7, 0.7)], 1.0),
        Stand(0.6),
        Turn(np.radians(-150), 2.5),
        Stand(0.4),
        Walk([(2.6, 0.6), (2.0, -0.1), (2.6, -0.8), (3.4, -0.5), (3.5, 0.3), (2.6, 0.3)], 1.15),
        Stand(0.5),
        Turn(np.radians(120), 2.0),
        Stand(0.5),
        Turn(np.radians(-70), 1.3),
        Stand(1.0),
    ]
    ground = plan((3.7, -0.7), _FACING_CAMERA, parts)
    return [perform(Intent(ground), _person(rng), rng)]


def reach(rng: np.random.Generator) -> list[Motion]:
    """Reach with either hand, and both, to shelves high, level and low, and put things aside."""
    targets: list[tuple[Side, float, tuple[float, float, float]]] = [
        ("right", 0.8, (0.55, -0.15, 0.35)),
        ("left", 3.5, (0.50, 0.30, 0.05)),
        ("right", 6.2, (0.40, 0.25, 0.55)),
        ("left", 9.0, (0.55, 0.10, -0.40)),
        ("right", 11.9, (0.15, -0.65, 0.10)),
        ("left", 14.7, (0.60, 0.05, 0.25)),
        ("right", 15.0, (0.60, -0.05, 0.25)),
    ]
    ground = plan((2.5, 0.0), _FACING_CAMERA - 0.3, [Stand(18.6)])
    offsets = _person(rng)
    intent = Intent(ground)
    t = ground.times
    for side, start, nominal in targets:
        _reach_for(intent, offsets, side, start, np.array(nominal) + rng.normal(0, 0.03, 3), t)
    return [perform(intent, offsets, rng)]


def _reach_for(intent: Intent, offsets: Floats, side: Side, start: float, target: Floats, t: Floats) -> None:
    """Add a reach to ``target`` (metres from the pelvis, heading frame), a hold, and the return, 3 s in total.

    Targets beyond the arm's length are reached by leaning, bending the knees and turning the trunk.
    """
    sign = SIGN[side]
    weight = _during(t, start, start + 3.0, 1.0)
    # the trunk starts a little before the hand and returns a little later
    body = _during(t, start - 0.15, start + 3.15, 1.15)
    arm = float(np.linalg.norm(offsets[[J["left_elbow"], J["left_wrist"]]], axis=1).sum())
    trunk = offsets[[J[n] for n in ("spine1", "spine2", "spine3", "left_collar", "left_shoulder")]].sum(axis=0)
    shoulder = trunk * [1.0, sign, 1.0]
    beyond = max(0.0, float(np.linalg.norm(target - shoulder)) - 0.9 * arm)
    across = np.clip(0.5 * np.arctan2(target[1] - 0.6 * shoulder[1], max(target[0], 0.2)), -0.5, 0.5)
    lean = np.clip(beyond / trunk[2], 0.0, 0.8) * (1.0 if target[0] > 0.3 else 0.3)
    low = max(0.0, 0.1 - target[2])
    intent.torso[:, 1] += body * (lean + 0.35 * low)
    intent.torso[:, 2] += body * across
    intent.torso[:, 0] += body * np.clip(-0.5 * (target[1] - shoulder[1]), -0.15, 0.15)
    intent.tilt += body * 0.8 * low
    sway = [0.05 * np.sign(target[0] - 0.2) - 0.10 * low, 0.25 * target[1] * beyond, -0.35 * low]
    intent.shift += body[:, None] * np.array(sway)
    gaze = np.array([np.arctan2(target[1], max(target[0], 0.3)), np.clip(-target[2] + 0.35, -0.4, 0.7)])
    intent.gaze += body[:, None] * gaze * 0.5
    # targets are fixed to the plan, which stands still, not to the pelvis, which leans
    frame = round(start * RATE)
    heading, (x, y) = intent.plan.yaw[frame], intent.plan.xy[frame]
    c, s = np.cos(heading), np.sin(heading)
    height = -float(offsets[[J["left_hip"], J["left_knee"], J["left_ankle"], J["left_foot"]], 2].sum())
    world = np.array([x + c * target[0] - s * target[1], y + s * target[0] + c * target[1], height + target[2]])
    intent.arms[side].append(ArmAction(weight, world, np.array([-0.6, 0.5 * sign, -0.8]), "world"))


def sit_rise(rng: np.random.Generator) -> list[Motion]:
    """Walk to a chair, turn, sit down, sit and shift, rise, sit again, rise and walk off."""
    seat = 0.45
    parts = [
        Stand(0.6), Walk([(2.9, 0.5)], 0.9), Stand(0.2), Turn(np.radians(55), 1.3), Stand(12.2),
        Walk([(2.4, -0.5)], 0.8), Stand(0.8),
    ]  # fmt: skip
    ground = plan((3.4, -0.8), np.radians(111.0), parts)
    offsets = _person(rng)
    intent = Intent(ground)
    t = ground.times
    begin = float(t[ground.moves[1].stop])
    legs = offsets[[J["left_hip"], J["left_knee"], J["left_ankle"], J["left_foot"]], 2].sum()
    hips_above_seat = 0.09
    drop = seat + hips_above_seat - float(offsets[J["left_hip"], 2]) + float(legs)
    back = -0.92 * float(np.linalg.norm(offsets[J["left_knee"]]))
    seated: Floats = np.zeros(len(t))
    bowed: Floats = np.zeros(len(t))
    for down, up, fast in ((begin + 0.3, begin + 5.7, 1.0), (begin + 7.6, begin + 10.2, 0.85)):
        take = 1.7 * fast
        seated += minimum_jerk((t - down) / take) - minimum_jerk((t - up) / take)
        # people bow before the pelvis moves back, and are upright again once seated; the reverse to rise
        for moment in (down - 0.1, up - 0.35):
            bowed += _during(t, moment, moment + 1.15 * take, 0.55 * take)
    intent.shift = seated[:, None] * np.array([back, 0.0, 0.0])
    # knees are already bent when the seat is touched: the downward motion lags behind the backward one
    intent.shift[:, 2] = drop * np.maximum(seated, 0.0) ** 1.15
    intent.tilt = np.radians(22.0) * bowed - np.radians(6.0) * seated
    intent.torso[:, 1] = np.radians(24.0) * bowed + np.radians(4.0) * seated
    fidget = _during(t, begin + 2.2, begin + 5.4, 0.9)
    intent.torso[:, 2] += 0.35 * fidget
    intent.gaze[:, 0] += 0.5 * fidget
    rest = minimum_jerk((seated - 0.45) / 0.5)
    for side in SIDES:
        lap, elbow = np.array([0.27, SIGN[side] * 0.13, 0.13]), np.array([-0.8, SIGN[side] * 0.45, -0.6])
        intent.arms[side] = [ArmAction(rest, lap, elbow, "pelvis")]
    chin = np.array([0.42, 0.05, -0.25])
    intent.arms["left"].append(ArmAction(fidget * rest, chin, np.array([-0.2, 0.9, -0.7]), "shoulder"))
    return [perform(intent, offsets, rng)]


def wave_hidden_arm(rng: np.random.Generator) -> list[Motion]:
    """Wave with one hand while the other is behind the back; then turn side-on, so that the body hides an arm."""
    parts = [Stand(9.2), Turn(np.radians(80), 1.8), Stand(3.8), Turn(np.radians(-80), 1.8), Stand(5.8)]
    ground = plan((2.4, -0.1), _FACING_CAMERA + 0.1, parts)
    intent = Intent(ground)
    t = ground.times
    intent.arms["right"] = [_behind_back(t, -1.0, 0.6, 8.9), _wave(rng, t, -1.0, 10.9, 14.8)]
    intent.arms["left"] = [_wave(rng, t, 1.0, 2.2, 8.4), _behind_back(t, 1.0, 16.8, 21.9)]
    intent.arms["right"].append(_wave(rng, t, -1.0, 17.0, 22.0))
    intent.torso[:, 0] = np.radians(3.0) * (_during(t, 2.2, 8.4, 1.2) - _during(t, 17, 22, 1.2))
    return [perform(intent, _person(rng), rng)]


def _wave(rng: np.random.Generator, t: Floats, sign: float, start: float, end: float) -> ArmAction:
    """Hand up beside the head, swept from side to side about the elbow."""
    beat = 2 * np.pi * rng.uniform(1.3, 1.7) * (t - start)
    ample = 0.22 * _during(t, start + 0.6, end - 0.5, 0.6)
    hold = np.array([0.30, sign * 0.36, 0.42])
    sweep = np.stack([0 * t, sign * ample * np.sin(beat), -0.25 * ample * np.sin(beat) ** 2], axis=-1)
    return ArmAction(_during(t, start, end, 1.1), hold + sweep, np.array([-0.35, 0.75 * sign, -0.9]), "shoulder")


def _behind_back(t: Floats, sign: float, start: float, end: float) -> ArmAction:
    """Hand to the small of the back, around the hip rather than through it."""
    around = np.array([-0.28, sign * 0.42, -0.72])
    behind = np.array([-0.36, -sign * 0.30, -0.55])
    keys = [Key(start + 0.5, start + 1.5, behind), Key(end - 1.5, end - 0.5, around)]
    return ArmAction(
        _during(t, start, end, 0.95), track(t, around, keys), np.array([-0.7, 1.0 * sign, -0.2]), "shoulder"
    )


def crossing(rng: np.random.Generator) -> list[Motion]:
    """Two people walk past each other, one hiding the other from the camera, turn about, and pass again."""

    def there_and_back(x: float, y: float, speed: float, wait: float, turn: float) -> Plan:
        away = np.pi / 2 if y < 0 else -np.pi / 2
        parts: list[Stand | Walk | Turn] = [Stand(wait)]
        for here, pace in ((y, speed), (-y, 1.08 * speed)):
            parts += [Walk([(x + 0.1 * np.sign(here), 0.0), (x, -here)], pace), Stand(0.5), Turn(turn, 2.8), Stand(0.5)]
        return plan((x, y), away, parts)

    near = there_and_back(2.2, -0.95, 0.95, 0.8, np.pi)
    far = there_and_back(3.2, 1.3, 1.15, 0.5, -np.pi)
    return _together(rng, near, far)


def hidden_crossing(rng: np.random.Generator) -> list[Motion]:
    """One stops in the middle of the view; another walks up behind, stays hidden for a second, and walks on or back."""
    near, far = rng.uniform(1.9, 2.3), rng.uniform(2.8, 3.3)
    side, other = rng.choice([-1.0, 1.0], size=2)
    turns_back = rng.random() < 0.3

    def visit(x: float, y: float, wait: float, stay: float, back: bool) -> Plan:
        pace = rng.uniform(0.8, 1.2)
        parts: list[Stand | Walk | Turn] = [Stand(wait), Walk([(x, 0.0)], pace), Stand(stay)]
        parts += [Turn(np.pi, 1.6)] if back else []
        return plan((x, y), -np.sign(y) * np.pi / 2, [*parts, Walk([(x, y if back else -y)], pace), Stand(3.0)])

    return _together(
        rng,
        visit(near, side * rng.uniform(0.8, 1.0), 0.5, rng.uniform(3.5, 4.5), back=False),
        visit(far, other * rng.uniform(1.2, 1.5), rng.uniform(1.0, 1.5), rng.uniform(0.0, 0.4), turns_back),
    )


def _together(rng: np.random.Generator, *plans: Plan) -> list[Motion]:
    """Perform each plan with another body, as long as the shortest lasts."""
    motions = [perform(Intent(p), _person(rng), rng) for p in plans]
    times = np.arange(int(min(m.times[-1] for m in motions) * RATE) + 1) / RATE
    return [m.at(times) for m in motions]


def leave_reenter(rng: np.random.Generator) -> list[Motion]:
    """Walk out of view to one side, come back, come too near, back off, leave to the other side and return."""
    parts = [
        Stand(1.0), Turn(np.radians(-90), 1.5), Walk([(2.6, 2.5)], 1.15), Stand(0.3), Turn(np.radians(180), 2.6),
        Walk([(2.5, 1.2), (1.9, 0.2), (1.1, 0.0)], 1.0), Stand(0.8), Turn(np.radians(-150), 2.4),
        Walk([(2.3, -0.8), (2.5, -2.4)], 1.2), Stand(0.3), Turn(np.radians(180), 2.6), Walk([(2.6, -0.2)], 1.1),
        Stand(1.2),
    ]  # fmt: skip
    ground = plan((2.6, 0.2), _FACING_CAMERA, parts)
    return [perform(Intent(ground), _person(rng), rng)]


SCRIPTS: Mapping[str, Callable[[np.random.Generator], list[Motion]]] = {
    f.__name__: f for f in (walk_turn, reach, sit_rise, wave_hidden_arm, crossing, hidden_crossing, leave_reenter, idle)
}
"""Every scene by name."""
