"""Training of the transition model: ``steadypose train humor`` (HuMoR, section 3.2 and appendix B.2)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from steadypose.prior.body.kinematics import CONTACT_JOINTS, LOAD_SPEED, REST_SPEED, label_contacts
from steadypose.prior.body.skeleton import J
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet, roll_out, sample, transitions
from steadypose.prior.fit.humor_state import State, canonical, choose, features, pose_features, stack, states_of
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.dataset import MotionSet, describe_data, mirror_offsets, mirror_rotations
from steadypose.training.loop import Recipe, Rng, TrainingOptions

ITERATIONS, BATCH, LEARNING_RATE = 6_000, 128, 7e-4  # number of steps; sequences per step; initial learning rate
STEPS = 10  # number of steps of a training sequence
SCALES = (0.9, 1.1)  # range of factors on people's sizes
MIN_SPEED = 0.1  # speed added to the feet's speed in the sampling weight of a sequence, m/s

KL_WEIGHT, KL_SHARE = 4e-4, 0.25
"""Weight of the KL divergence, as in the official code (summed over the latent; all other terms are means), and share
of the training over which it grows from 0."""

JOINTS_WEIGHT, ROTATIONS_WEIGHT = 100.0, 10.0
"""Weights of squared joint errors (m²) and of squared entries of rotation matrices, relative to the weight 1 of
velocities ((m/s)²). The paper's decoder predicts velocities separately; here they are differences, 30 times a joint's
error. With the paper's weights of 1, an error of a rollout decays within half a minute; with these, within a third of a
second."""

CONTACT_WEIGHT, STILL_WEIGHT = 0.01, 0.01
"""Weights of the contacts' cross-entropy, and of the squared velocity of resting joints."""

TRUE_UNTIL, OWN_FROM = 0.15, 0.35
"""Scheduled sampling: share of the training until which each step starts from the true state, and share from which each
step starts from the previous step's output. Between them, the choice is random."""

MIN_SCALE = 0.02
"""Least standard deviation of a feature, because some are constant, such as the root's position in its own frame."""

_MIRRORED_CONTACTS = [1, 0, 3, 2, 5, 4, 7, 6]
_STATES_OF_MIXTURE = 40_000

MIN_VARIANCE, MIXTURE_ITERATIONS = 1e-3, 100
"""Variance added to each standardised feature in the mixture of initial states, because joints on rigid bones have
fewer degrees of freedom than coordinates; and largest number of expectation-maximisation iterations."""


@dataclass(frozen=True)
class Sequences:
    """Sequences of states, drawn from motion."""

    motion: MotionSet  # N frames of prepared motion
    load: Tensor  # (N, 8) whether `CONTACT_JOINTS` bear load
    rest: Tensor  # (N, 8) whether they rest
    starts: np.ndarray  # (M,) frames at which a sequence may start
    chances: np.ndarray  # (M,) probabilities of these starts

    @classmethod
    def of(cls, motion: MotionSet) -> Sequences:
        ends = zip(motion.clip_start, motion.clip_start[1:], strict=False)
        clips = [motion.positions[a:b].numpy() for a, b in ends]
        load, rest = (
            torch.from_numpy(np.concatenate([label_contacts(clip, FPS, speed) for clip in clips]))
            for speed in (LOAD_SPEED, REST_SPEED)
        )
        rows = motion.all_windows(STEPS + 2, 1)
        feet = motion.positions[:, [J["left_ankle"], J["right_ankle"]]]
        moved = np.concatenate([[0.0], feet.diff(dim=0).norm(dim=-1).mean(dim=1).double().cumsum(0).numpy()])
        chances = MIN_SPEED + (moved[rows[:, -1]] - moved[rows[:, 0]]) * FPS / (STEPS + 1)
        return cls(motion, load, rest, rows[:, 0], chances / chances.sum())

    def draw(self, count: int, steps: int, rng: Rng) -> Batch:
        """Draw random sequences of ``steps + 1`` states, with varied builds, half of them mirrored."""
        first = rng.choice(self.starts, size=count, p=self.chances)
        return self.at(first[:, None] + np.arange(steps + 2), rng)

    def at(self, rows: np.ndarray, rng: Rng | None = None) -> Batch:
        """Return the sequences of these frames (B, T), augmented if ``rng`` is given."""
        motion = self.motion
        root, rotations = motion.positions[rows, 0], motion.rotations[rows]
        offsets, load, rest = motion.offsets[rows[:, 0]], self.load[rows], self.rest[rows]
        if rng is not None:
            half = len(rows) // 2
            size = torch.from_numpy(rng.uniform(*SCALES, (len(rows), 1, 1))).float()
            root, offsets = root * size, offsets * size
            root[:half] *= root.new_tensor([1.0, -1.0, 1.0])
            rotations[:half], offsets[:half] = mirror_rotations(rotations[:half]), mirror_offsets(offsets[:half])
            for labels in (load, rest):
                labels[:half] = labels[:half][..., _MIRRORED_CONTACTS]
        contacts = torch.cat([load, rest], dim=-1).float()
        return Batch(states_of(root, rotations, offsets), offsets, contacts[:, 2:])


@dataclass(frozen=True)
class Batch:
    """B sequences of T steps."""

    states: State  # (B, T + 1)
    offsets: Tensor  # (B, 22, 3) metres
    contacts: Tensor  # (B, T, 16) labels of load, then of rest, after each step


def train_humor(options: TrainingOptions) -> Path:
    train, val = options.motion(flat=True)
    config = HumorConfig()
    sequences = Sequences.of(train)
    described = f"transitions of HuMoR: latent of {config.latent}, layers of {config.hidden}, {config.components} "
    return recipe_of(config, sequences, Sequences.of(val)).train(
        options, described + "Gaussians of initial states", describe_data(options.weights, train, val),
        started_anew=lambda model: _fit_statistics(model, sequences, options.seed),
    )  # fmt: skip


def recipe_of(config: HumorConfig, train: Sequences, val: Sequences) -> Recipe[HumorNet]:
    """Return the recipe of a configuration on some motion. The ablations use it too."""

    def loss_of(model: HumorNet, count: int, done: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        return transition_loss(model, train.draw(count, STEPS, rng), done, rng)

    return Recipe(
        "humor", lambda: HumorNet(config), loss_of, lambda model: evaluate_humor(model, val),
        ITERATIONS, BATCH, LEARNING_RATE, f"sequences of {STEPS} steps",
    )  # fmt: skip


@torch.no_grad()
def _fit_statistics(model: HumorNet, sequences: Sequences, seed: int) -> None:
    """Fit the parameters without gradients: mean and scale of features, and the mixture of initial states."""
    rng = np.random.default_rng(seed)
    states = sequences.draw(_STATES_OF_MIXTURE, 0, rng).states[:, 0]
    inputs = features(canonical(states, states))
    model.mean.copy_(inputs.mean(dim=0))
    model.scale.copy_(inputs.std(dim=0).clamp(min=MIN_SCALE))
    fit_initial(model, model.standardise(inputs), seed)


def fit_initial(model: HumorNet, inputs: Tensor, seed: int) -> None:
    """Fit the model's mixture of initial states (HuMoR, section 3) by expectation-maximisation, to standardised
    features (N, `FEATURES`) of states in their canonical frames."""
    from sklearn.mixture import GaussianMixture  # in the extra `train`, and slow to import

    mixture = GaussianMixture(
        model.config.components, reg_covar=MIN_VARIANCE, max_iter=MIXTURE_ITERATIONS, random_state=seed
    ).fit(pose_features(inputs).double().numpy())
    model.mixture_log_weights.copy_(torch.from_numpy(np.log(np.asarray(mixture.weights_))))
    model.mixture_means.copy_(torch.from_numpy(mixture.means_))
    model.mixture_precisions.copy_(torch.from_numpy(mixture.precisions_cholesky_))


def transition_loss(model: HumorNet, batch: Batch, done: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
    """Compute equation 7: reconstruction, KL divergence and regularisers, with scheduled sampling of the states.

    ``done`` is the progress of the training, 0 to 1; ``rng`` selects the steps that start from the true state. Returns
    the loss, and its terms by name.
    """
    own = float(np.clip((done - TRUE_UNTIL) / (OWN_FROM - TRUE_UNTIL), 0.0, 1.0))
    true = batch.states[:, :-1]
    before = _own_states(model, batch, own, rng) if own > 0.0 else true
    origin, target = canonical(before, before), canonical(batch.states[:, 1:], true)
    inputs, next_inputs = model.standardise(features(origin)), model.standardise(features(target))
    prior, posterior = model.prior_latent(inputs), model.posterior_latent(inputs, next_inputs)
    predicted, logits = model.decode(origin, inputs, posterior.sample(), batch.offsets.unsqueeze(1))
    l_root = (predicted.root - target.root).square().mean()
    l_rotation = (predicted.rotations - target.rotations).square().mean()
    l_joint = (predicted.joints - target.joints).square().mean()
    l_velocity = (predicted.velocity - target.velocity).square().mean()
    l_kl = posterior.kl(prior).mean()
    kl_weight = KL_WEIGHT * min(done / KL_SHARE, 1.0)
    loss = JOINTS_WEIGHT * (l_joint + l_root) + ROTATIONS_WEIGHT * l_rotation + l_velocity + kl_weight * l_kl
    terms = {"L_velocity": l_velocity.item(), "KL, nats": l_kl.item()}
    if model.config.contacts:
        l_contact = F.binary_cross_entropy_with_logits(logits, batch.contacts)
        resting = torch.sigmoid(logits[..., len(CONTACT_JOINTS) :])
        still = (resting * predicted.velocity[..., list(CONTACT_JOINTS), :].square().sum(dim=-1)).mean()
        loss = loss + CONTACT_WEIGHT * l_contact + STILL_WEIGHT * still
        terms["L_contact"] = l_contact.item()
    return loss, terms


@torch.no_grad()
def _own_states(model: HumorNet, batch: Batch, own: float, rng: Rng) -> State:
    """Return the states (B, T) from which steps start: the model's previous output with probability ``own``."""
    states = [batch.states[:, 0]]
    count, steps = batch.contacts.shape[:2]
    for t in range(steps - 1):
        before, true = states[-1], batch.states[:, t]
        origin = canonical(before, before)
        inputs = model.standardise(features(origin))
        next_inputs = model.standardise(features(canonical(batch.states[:, t + 1], true)))
        made = model.step(before, model.posterior_latent(inputs, next_inputs).sample(), batch.offsets)[0]
        states.append(choose(torch.from_numpy(rng.random(count) < own), made, batch.states[:, t + 1]))
    return stack(states, 1)


def evaluate_humor(model: HumorNet, unseen: Sequences) -> dict[str, float]:
    """Evaluate reconstruction and prediction on unseen people, over the seconds with the longest travel. Returns ``val
    reconstruction mm``, the mean joint error at the end of a one-second rollout with the posterior's means; ``val
    prediction mm``, the error after half a second with the prior's means; ``val rest F1`` of heels and toes in the
    first."""
    steps = int(FPS)
    rows = unseen.motion.all_windows(steps + 2, steps)
    path = unseen.motion.positions[rows[:, -1], 0] - unseen.motion.positions[rows[:, 0], 0]
    batch = unseen.at(rows[np.argsort(-path.norm(dim=-1).numpy(), kind="stable")[:128]])
    posterior, _ = transitions(model, batch.states)
    first = batch.states[:, 0]
    reconstructed = roll_out(model, first, posterior.mean, batch.offsets)
    future = sample(model, first, steps // 2, batch.offsets, None)

    def error(predicted: State, step: int) -> float:
        return float((predicted.joints[:, step - 1] - batch.states.joints[:, step]).norm(dim=-1).mean()) * 1e3

    found = {
        "val reconstruction mm": error(reconstructed.states, steps),
        "val prediction mm": error(future.states, steps // 2),
    }
    if model.config.contacts:
        feet = slice(len(CONTACT_JOINTS) + 2, len(CONTACT_JOINTS) + 6)
        predicted, true = reconstructed.contacts[..., feet] > 0, batch.contacts[..., feet] > 0.5
        found["val rest F1"] = float(2 * (predicted & true).sum() / (predicted.sum() + true.sum()).clamp(min=1))
    return found
