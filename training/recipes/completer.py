"""The completer, a transformer that corrects interpolated motion, and its training: ``steadypose train completer``.

One encoder processes all frames of a window, hidden and known, as in transformers for in-betweening (Duan et al. 2022;
Qin et al. 2022, "Motion In-betweening via Two-stage Transformers"). Its output is added to an interpolation by slerp
and lerp (Oreshkin et al. 2023, "Motion In-betweening via Deep Delta-Interpolator"). In these papers, frames are known
completely or not at all. Here, any joint may be known in any frame, and the network also gates a cubic interpolation.

In training, windows of true motion lose the entries that `complete` is asked for: all frames between two ends, frames
between key frames, parts of the body, and combinations of these. In some windows, the known joints are slightly noisy.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import roma
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler, OneCycleLR

from steadypose.prior.arrays import Floats
from steadypose.prior.body.inverse_kinematics import place_joints
from steadypose.prior.body.skeleton import J, limbs
from steadypose.prior.complete.body import complete
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.fit.tensors import forward_kinematics, from_6d, to_6d
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.completer_features import (
    BENDS,
    FEATURES,
    OUTPUTS,
    SHARE_FRAMES,
    Bools,
    CompleterConfig,
    Window,
    correction_share,
    growth,
    read_window,
)
from steadypose.prior.models.line import Line
from steadypose.training.data.dataset import (
    MotionSet,
    SpeedWeightedWindows,
    describe_data,
    mirror_offsets,
    mirror_rotations,
)
from steadypose.training.loop import Recipe, Rng, TrainingOptions
from steadypose.training.networks.graph import AttentionLayer
from steadypose.training.weights import arrays_of


class Completer(nn.Module):
    """Correction of the line, before it is anchored (`line.anchored`), and gates of the bend."""

    def __init__(self, config: CompleterConfig) -> None:
        super().__init__()
        self.config = config
        self.read = nn.Linear(FEATURES, config.width)
        width, reach = config.width, config.reach
        self.layers = nn.ModuleList(
            AttentionLayer(width, config.heads, 4 * width, reach=reach, approximate="tanh")
            for _ in range(config.layers)
        )
        self.norm = nn.LayerNorm(config.width)
        self.write = nn.Linear(config.width, OUTPUTS)
        # (22, 4) local quaternions, xyzw, of the mean pose
        self.register_buffer("usual", torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(22, 1))
        self.usual: Tensor
        with torch.no_grad():
            self.write.weight.mul_(0.05)  # start near the line
            self.write.bias.zero_()
            self.write.bias[BENDS:] = 2.0

    def forward(self, features: Tensor) -> Tensor:
        """(B, T, OUTPUTS) of features (B, T, FEATURES)."""
        x = self.read(features)
        for layer in self.layers:
            x = layer(x)
        return self.write(self.norm(x))


ITERATIONS, BATCH, LEARNING_RATE = 4_000, 36_000, 1.2e-3
"""Number of steps; frames per step; largest learning rate of AdamW, from which it falls along a cosine."""

GAPS, CONTEXT = (3, 64), (2, 30)
"""Ranges of the length of a gap, and of the known context before and after it together, frames."""

SCALES = (0.85, 1.15)  # range of factors on people's sizes

TRAINED_SHARE = 20.0
"""`SHARE_FRAMES` in training. Inference uses a smaller share: the error for people unlike training is larger."""

NOISY, NOISE = 0.3, 0.015
"""Share of windows with noisy known joints, and largest standard deviation of the noise along an axis, metres."""

POSE_WEIGHT, PATH_WEIGHT, ROTATION_WEIGHT, VELOCITY_WEIGHT = 4.0, 4.0, 1.0, 10.0
"""Weights of root-relative joints and of the root, 1/m; of global rotation matrices; and of joints' steps, frames/m."""

EASY = 0.02
"""Error added to the interpolation's error in the normalisation of a window's loss, metres. The normalisation keeps
fast motion from dominating."""

_ARMS = limbs(("elbow", "wrist"), ("shoulder", "elbow", "wrist"))
_LEGS = limbs(("knee", "ankle", "foot"), ("ankle", "foot"))
_LOWER = sorted(_LEGS[0] + _LEGS[2])
_BOTH_ARMS = sorted(_ARMS[1] + _ARMS[3])
_PARTS = (*_ARMS, *_LEGS, _LOWER, _LOWER, _BOTH_ARMS, [*_BOTH_ARMS, J["head"], J["neck"]], [J["pelvis"], *_LOWER])
_ENDS = [J[name] for name in ("pelvis", "spine3", "head", "left_wrist", "right_wrist", "left_ankle", "right_ankle")]
_BETWEEN = np.setdiff1d(np.arange(22), _ENDS)


def train_completer(options: TrainingOptions, config: CompleterConfig | None = None) -> Path:
    train, val = options.motion()
    windows, sizes = SpeedWeightedWindows(train), config or CompleterConfig()

    def network() -> Completer:
        model = Completer(sizes)
        model.usual.copy_(roma.rotmat_to_unitquat(roma.special_procrustes(train.rotations.mean(dim=0))))
        return model

    def loss_of(model: Completer, count: int, _: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        gap, context = int(rng.integers(GAPS[0], GAPS[1] + 1)), int(rng.integers(CONTEXT[0], CONTEXT[1] + 1))
        frames = gap + context
        rows = windows.sample(max(count // frames, 1), frames, (1,), rng)
        return loss(model, Truth.of(train, rows, rng), masks(len(rows), gap, context, rng), rng)

    def rise_and_fall(optimiser: Optimizer, steps: int) -> LRScheduler:
        return OneCycleLR(optimiser, LEARNING_RATE, total_steps=steps + 1, pct_start=0.04, final_div_factor=4)

    recipe = Recipe(
        "completer", network, loss_of, lambda model: evaluate_completer(model, val), ITERATIONS, BATCH, LEARNING_RATE,
        f"frames, in windows of {GAPS[0] + CONTEXT[0]} to {GAPS[1] + CONTEXT[1]},", decay=0.02, schedule=rise_and_fall,
        average=0.999,
    )  # fmt: skip
    described = f"a transformer of {sizes.layers} layers, {sizes.width} wide, over a window's frames"
    data = describe_data(options.weights, train, val)
    return recipe.train(options, described, data, calibrated=lambda model: calibrate(model, val))


@dataclass(frozen=True)
class Truth:
    """Windows of true motion."""

    rotations: Tensor  # (B, T, 22, 3, 3) local
    root: Tensor  # (B, T, 3) metres, world
    offsets: Tensor  # (B, 22, 3) metres, bones

    @classmethod
    def of(cls, motion: MotionSet, rows: NDArray[np.int64], rng: Rng | None = None) -> "Truth":
        """Select frames (B, T); with ``rng``, mirror half of the windows and scale all at random."""
        rotations, root, offsets = motion.rotations[rows], motion.positions[rows, 0], motion.offsets[rows[:, 0]]
        if rng is not None:
            half = len(rows) // 2
            # across the world's xz plane; any vertical plane would do
            flip = torch.tensor([1.0, -1.0, 1.0])
            rotations = torch.cat([mirror_rotations(rotations[:half]), rotations[half:]])
            root = torch.cat([root[:half] * flip, root[half:]])
            offsets = torch.cat([mirror_offsets(offsets[:half]), offsets[half:]])
            scale = torch.from_numpy(rng.uniform(*SCALES, (len(rows), 1, 1))).float()
            root, offsets = root * scale, offsets * scale
        return cls(rotations, root, offsets)

    def window_of(self, known: Bools, usual: Tensor, rng: Rng | None = None) -> Window:
        """Return the completer's input if these joints (B, T, 22) are known; with ``rng``, some are noisy."""
        joints = forward_kinematics(self.rotations, self.offsets[:, None], self.root)[0].double().numpy()
        if rng is not None:
            sigma = rng.uniform(0.0, NOISE, (len(joints), 1, 1, 1)) * (rng.random((len(joints), 1, 1, 1)) < NOISY)
            joints += sigma * rng.standard_normal(joints.shape)
        joints[~known] = np.nan
        return read_window(joints, self.offsets.double().numpy(), usual.double().numpy())

    def in_frame_of(self, window: Window) -> tuple[Tensor, Tensor]:
        """Return rotations (B, T, 22, 3, 3) and root (B, T, 3) in the frame of the window."""
        turn, origin = torch.from_numpy(window.turn).float(), torch.from_numpy(window.origin).float()
        rotations = self.rotations.clone()
        rotations[:, :, 0] = turn.mT[:, None] @ rotations[:, :, 0]
        return rotations, (self.root - origin[:, None]) @ turn


def masks(count: int, gap: int, context: int, rng: Rng) -> Bools:
    """(count, gap + context, 22) which joints are known in random completion tasks.

    52 % have a gap, 10 % key frames, 30 % hidden parts of the body, and 8 % both a gap and hidden parts.
    """
    frames = gap + context
    known = np.ones((count, frames, 22), dtype=bool)
    for row in known:
        kind = rng.random()
        if kind < 0.52 or kind > 0.92:
            if rng.random() < 0.03:
                before = context
            else:
                before = context - 1 if rng.random() < 0.5 else int(rng.integers(1, context))
            row[before : before + gap] = False
        elif kind < 0.62:
            step = int(rng.integers(3, 31))
            row[np.arange(frames) % step != int(rng.integers(0, step))] = False
            row[0] = True
        if kind > 0.62:
            span = slice(None)
            if rng.random() < 0.4:
                length = int(rng.integers(1, frames + 1))
                start = int(rng.integers(0, frames - length + 1))
                span = slice(start, start + length)
            if rng.random() < 0.75:
                hidden = _PARTS[int(rng.integers(len(_PARTS)))]
            elif rng.random() < 0.5:
                hidden = np.flatnonzero(rng.random(22) < rng.uniform(0.05, 0.6))
            else:
                hidden = _BETWEEN
            row[span, hidden] = False
    return known


def _anchored(values: Tensor, line: Line, tracks: slice) -> Tensor:
    """`line.anchored`, with gradients."""

    def at(frames: NDArray[np.int64]) -> Tensor:
        index = torch.from_numpy(frames[..., tracks, None]).expand_as(values)
        return values.gather(1, index)

    weight = torch.from_numpy(line.weight[..., tracks, None])
    ever = torch.from_numpy(line.ever[:, None, tracks, None])
    return values - torch.where(ever, torch.lerp(at(line.before), at(line.after), weight), 0.0)


def predict(model: Completer, window: Window) -> tuple[Tensor, Tensor]:
    """Local rotations (B, T, 22, 3, 3) and root (B, T, 3), metres, in the window's frame, with gradients."""
    line = window.line
    with torch.autocast("cpu", torch.bfloat16, enabled=model.training):
        output = model(torch.from_numpy(window.features))
    rotations, root, gates = output.float().split([BENDS - 3, 3, 23], dim=-1)
    share = torch.from_numpy(correction_share(line, TRAINED_SHARE if model.training else SHARE_FRAMES))
    bend = torch.from_numpy(window.bend) * (1.0 - share * torch.sigmoid(-gates)[..., None])
    rotations = _anchored(rotations.unflatten(-1, (22, 6)), line, slice(0, 22))
    root = _anchored(root.unflatten(-1, (1, 3)), line, slice(22, 23))[:, :, 0]
    base = torch.from_numpy(window.rotations).float()
    rotations, root = share[:, :, :22] * rotations + bend[:, :, :22], share[:, :, 22] * root + bend[:, :, 22, :3]
    return from_6d(to_6d(base) + rotations), torch.from_numpy(window.root).float() + root


def loss(model: Completer, truth: Truth, known: Bools, rng: Rng) -> tuple[Tensor, dict[str, float]]:
    """Return the absolute errors where joints are hidden, normalised by window (`EASY`), and the terms by name."""
    window = truth.window_of(known, model.usual, rng)
    rotations, root = predict(model, window)
    true, true_root = truth.in_frame_of(window)
    joints, turned = forward_kinematics(torch.stack([rotations, true]), truth.offsets[:, None])
    hidden = torch.from_numpy(~known)
    frames = hidden.any(dim=-1)
    rotations_hidden = torch.from_numpy(~window.line.known[..., :22])[..., None, None]
    missed = joints[0] - joints[1]
    world = missed + (root - true_root)[:, :, None]
    line = place_joints(window.rotations, truth.offsets[:, None].double().numpy()) + window.root[:, :, None]
    off = torch.from_numpy(line).float() - joints[1].detach() - true_root[:, :, None]
    per = frames.sum(dim=1).clamp(min=1)[:, None]
    worth = 1.0 / ((off.norm(dim=-1).mean(dim=-1) * frames).sum(dim=1, keepdim=True) / per + EASY)
    worth = worth / worth.mean() * frames.float()

    def mean(values: Tensor) -> Tensor:
        return (values * worth[:, :, None, None]).sum() / worth.sum().clamp(min=1.0) / values[0, 0].numel()

    l_pose, l_path = mean(missed.abs()), mean((root - true_root).abs()[:, :, None] * hidden[..., :1, None])
    l_rotation = mean((turned[0] - turned[1]).abs().flatten(3)) + mean(
        ((rotations - true).abs() * rotations_hidden).flatten(3)
    )
    l_velocity = mean(F.pad(world.diff(dim=1).abs(), (0, 0, 0, 0, 1, 0)))
    total = POSE_WEIGHT * l_pose + PATH_WEIGHT * l_path + ROTATION_WEIGHT * l_rotation + VELOCITY_WEIGHT * l_velocity
    return total, {"loss": total.item(), "pose mm": 1e3 * l_pose.item(), "path mm": 1e3 * l_path.item()}


PROTOCOL = (10, 1)
"""Numbers of known frames before and after a gap, in the protocol of LAFAN1 (Harvey et al. 2020)."""


@torch.no_grad()
def evaluate_completer(model: Completer, motion: MotionSet, windows: int = 192) -> dict[str, float]:
    """Errors on unseen people: ``val 15 of line`` in gaps of 15 frames (and 30), as a share of slerp's and lerp's;
    ``val legs mm`` of knees, ankles and feet never observed."""
    found = {}
    for gap in (15, 30):
        frames = sum(PROTOCOL) + gap
        known = np.ones((frames, 22), dtype=bool)
        known[PROTOCOL[0] : PROTOCOL[0] + gap] = False
        ours, line = _errors(model, motion, known, windows)
        found[f"val {gap} of line"] = float(ours[~known].mean() / line[~known].mean())
    known = np.ones((40, 22), dtype=bool)
    known[:, _LOWER] = False
    found["val legs mm"] = float(_errors(model, motion, known, windows)[0][~known].mean() * 1e3)
    return found


HIDDEN_PARTS = (_ARMS[1], _ARMS[3], _LEGS[0], _LEGS[2], [J["head"], J["neck"]], _BETWEEN.tolist())
"""Parts that are hidden to measure the errors of their joints; the first part with a joint counts."""


CALIBRATED = (15, 60)  # lengths of the gaps in which parts are hidden to measure the errors of their joints, frames


@torch.no_grad()
def calibrate(model: Completer, motion: MotionSet, windows: int = 100) -> CompleterConfig:
    """Return the configuration with the RMS errors of `complete` along an axis, measured on validation motion, equally
    on all sources.

    Each part of the body is hidden for half a second and for two seconds. Each joint's error far from the ends, and the
    distance at which it is half as large, are fitted to the growth of the errors from the ends (`growth`).
    """
    fill, before, after = PartsCompleter(LiveCompleter(model.config, arrays_of(model))), 7, 7
    rows = motion.all_windows(before + max(CALIBRATED) + after, step=5)
    source = motion.source[np.searchsorted(motion.clip_start, rows[:, 0], side="right") - 1]
    names = np.unique(source)
    rows = np.concatenate([_spread(rows[source == name], windows // len(names)) for name in names])
    offsets, truth = motion.offsets[rows[:, 0]].double().numpy(), motion.positions[rows].double().numpy()
    off, between = np.full((sum(CALIBRATED), 22), np.nan), np.empty(0)
    for gap in CALIBRATED:
        since = np.arange(1.0, gap + 1.0)
        mine, hidden = slice(len(between), len(between) + gap), slice(before, before + gap)
        between = np.append(between, 1.0 / (1.0 / since + 1.0 / since[::-1]))
        for part in (*HIDDEN_PARTS, [J["pelvis"]], [J["spine3"]]):
            observed = truth.copy()
            observed[:, hidden, part] = np.nan
            done = np.stack([complete(fill, *window).positions for window in zip(observed, offsets, strict=True)])
            found = np.sqrt(np.square(done - truth)[:, hidden].mean(axis=(0, 3)))
            off[mine, part] = np.where(np.isnan(off[mine, part]), found[:, part], off[mine, part])
    fits: list[tuple[float, Floats, float]] = []
    for half in np.arange(1.0, 31.0):
        grown = growth(between, half)[:, None]
        far = np.sqrt(np.square(off).mean(axis=0) / np.square(grown).mean())
        fits.append((float(np.abs(np.log(off / (far * grown))).mean()), far, float(half)))
    _, far, half = min(fits, key=lambda fit: fit[0])
    return replace(model.config, far_sigma=tuple(round(float(sigma), 4) for sigma in far), half_frames=half)


def _errors(model: Completer, motion: MotionSet, known: Bools, windows: int) -> tuple[Tensor, Tensor]:
    """(T, 22) mean distances of joints from the truth, metres, of prediction and line."""
    rows = _spread(motion.all_windows(len(known), step=5), windows)
    truth = Truth.of(motion, rows)
    window = truth.window_of(np.broadcast_to(known, (windows, *known.shape)).copy(), model.usual)
    rotations, root = truth.in_frame_of(window)
    aim, _ = forward_kinematics(rotations, truth.offsets[:, None], root)

    def error(rotations: Tensor, root: Tensor) -> Tensor:
        return (forward_kinematics(rotations, truth.offsets[:, None], root)[0] - aim).norm(dim=-1).mean(dim=0)

    base = torch.from_numpy(window.rotations).float(), torch.from_numpy(window.root).float()
    return error(*predict(model, window)), error(*base)


def _spread(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    return rows[np.linspace(0, len(rows) - 1, count).astype(int)]
