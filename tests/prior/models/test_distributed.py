"""Training by torchrun: two real processes, against the sum done by hand in this one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from steadypose.prior.models.distributed import share
from steadypose.prior.models.training import TrainingRun

STEPS, BATCH, RATE, SEED = 6, 8, 0.1, 3

# What each process does: it trains to STEPS - 2, is killed so to say, and resumes in the folder that is its argument.
SCRIPT = f"""
import sys
from pathlib import Path

import torch

from steadypose.prior.models.distributed import join, rank, share, writes
from steadypose.prior.models.training import TrainingRun


def train(steps):
    torch.manual_seed({SEED})
    model = torch.nn.Linear(2, 1)
    if rank():
        torch.nn.init.zeros_(model.weight)  # another machine's idea of the start
    optimiser = torch.optim.SGD(model.parameters(), lr={RATE}, momentum=0.9)
    run = TrainingRun(folder / "run", {{"model": model, "optimiser": optimiser}}, steps, every=2)
    for _ in run.steps(lambda: {{"by": float(rank())}}):
        x = torch.from_numpy(run.random({SEED}).normal(size=(share({BATCH}), 2))).float()
        drawn.append(x)
        loss = (model(x) - x.sum(dim=1, keepdim=True)).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return model, run


join()
folder, drawn = Path(sys.argv[1]), []
train({STEPS} - 2)
model, run = train({STEPS})
torch.save({{"model": model.state_dict(), "drawn": drawn, "curves": run.curves, "noise": torch.randn(3),
            "writes": writes()}}, folder / f"rank{{rank()}}.pt")
"""


def torchrun(folder: Path, processes: int) -> list[dict]:
    """Run the script; what each process ends with."""
    script = folder / "script.py"
    script.write_text(SCRIPT)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3] / "src"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, str(script), str(folder)], env=environment, capture_output=True, text=True, timeout=180
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [torch.load(folder / f"rank{rank}.pt", weights_only=True) for rank in range(processes)]


def test_two_processes_train_one_model_and_resume(tmp_path: Path):
    first, second = torchrun(tmp_path, processes=2)

    torch.testing.assert_close(first["model"], second["model"], rtol=0, atol=0)
    assert first["writes"]
    assert not second["writes"]
    assert first["curves"] == second["curves"] == [{"step": step, "by": 0.0} for step in (2, 4, 6)]
    assert not torch.equal(first["noise"], second["noise"])

    torch.manual_seed(SEED)
    model = torch.nn.Linear(2, 1)
    optimiser = torch.optim.SGD(model.parameters(), lr=RATE, momentum=0.9)
    for step in range(STEPS):
        shares = [np.random.default_rng((SEED, step, rank)).normal(size=(BATCH // 2, 2)) for rank in range(2)]
        x = torch.from_numpy(np.concatenate(shares)).float()
        optimiser.zero_grad()
        (model(x) - x.sum(dim=1, keepdim=True)).square().mean().backward()
        optimiser.step()
        for ended, mine in zip((first, second), shares, strict=True):
            torch.testing.assert_close(ended["drawn"][step], torch.from_numpy(mine).float())
    torch.testing.assert_close(first["model"], model.state_dict())


def test_alone_nothing_changes(tmp_path: Path):
    model = torch.nn.Linear(2, 1)
    optimiser = torch.optim.SGD(model.parameters(), lr=RATE)
    run = TrainingRun(tmp_path, {"model": model, "optimiser": optimiser}, 2, every=1)
    for step in run.steps(lambda: {"loss": 1.0}):
        expected = np.random.default_rng((SEED, step)).normal(size=5)
        np.testing.assert_array_equal(run.random(SEED).normal(size=5), expected)
    assert share(7) == 7
    assert not optimiser._optimizer_step_pre_hooks


def test_a_batch_that_cannot_be_shared_out_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("steadypose.prior.models.distributed.processes", lambda: 3)
    with pytest.raises(ValueError, match="multiple of the 3 processes"):
        share(64)
