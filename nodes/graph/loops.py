"""``python -m steadypose.nodes.graph.loops``: compiles the loops of prior and trajectory, once, for all later starts.

Two processes do it at once, one from the beginning of a frame's way through the prior and one from its end; what one
has compiled, the other finds on disk.
"""

from __future__ import annotations

import multiprocessing

import numpy as np


def compile_from_the_beginning() -> None:
    """Clean a few frames with the settings that ship."""
    from steadypose.prior.clean.pipeline import load_loops
    from steadypose.prior.clean.settings import PriorSettings

    load_loops(PriorSettings())


def compile_from_the_end() -> None:
    """Ask each network and the pose solver, then import the trajectory, whose loops are compiled as that is done."""
    from steadypose.prior.body.inverse_kinematics import fit_lengths, solve_pose
    from steadypose.prior.body.skeleton import REST_OFFSETS, REST_POSITIONS
    from steadypose.prior.clean.settings import JITTER_SIGMA
    from steadypose.prior.models.hgvae.fault_inference import LiveFaultNet
    from steadypose.prior.models.hgvae.features import body_size, from_tracks, to_tracks
    from steadypose.prior.models.hgvae.inference import LiveHGVAE

    size, sigma = body_size(REST_OFFSETS[None]), np.array([JITTER_SIGMA])
    hgvae = LiveHGVAE.load("default", JITTER_SIGMA, max_batch=1)
    windows = np.tile(REST_POSITIONS, (1, hgvae.frames, 1, 1))
    windows[:, -5:, -1] = np.nan
    tracks = to_tracks(windows, size)
    found = hgvae.reconstruct(tracks.x, tracks.observed, sigma)
    LiveFaultNet.load("default", max_batch=1)(tracks.x, found.mean, found.sigma, tracks.observed, sigma)
    from_tracks(found.mean, tracks, size)
    _, placed = solve_pose(REST_POSITIONS, REST_OFFSETS)
    fit_lengths(placed, REST_OFFSETS, np.ones(22))
    import steadypose.nodes.graph.trajectory_node  # noqa: F401


def compile_all() -> None:
    """Both; returns when all is compiled."""
    other = multiprocessing.get_context("spawn").Process(target=compile_from_the_end)
    other.start()
    compile_from_the_beginning()
    other.join()
    if other.exitcode:
        raise SystemExit(other.exitcode)


if __name__ == "__main__":
    compile_all()
