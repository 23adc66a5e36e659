import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from steadypose.training.distributed import share
from steadypose.training.loop import TrainingRun

STEPS, BATCH, RATE, DECAY, SEED = 6, 8, 0.1, 0.8, 3

# What each process does: it trains to STEPS - 2, is killed so to say, and resumes in the folder that is its argument.
SCRIPT = f"""
import sys
from pathlib import Path

import torch

from steadypose.training.distributed import join, rank, writes
from steadypose.training.loop import TrainingRun


def train(steps):
    torch.manual_seed({SEED})
    model = torch.nn.Linear(2, 1)
    if rank():
        torch.nn.init.zeros_(model.weight)  # another machine's idea of the start
    optimiser = torch.optim.SGD(model.parameters(), lr={RATE}, momentum=0.9)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, {DECAY})
    run = TrainingRun(folder / "run", model, schedule, steps, evaluations=steps // 2)

    def loss_of(count, done, rng):
        x = torch.from_numpy(rng.normal(size=(count, 2))).float()
        drawn.append(x)
        return (model(x) - x.sum(dim=1, keepdim=True)).square().mean(), {{"done": done}}

    run.minimise(loss_of, lambda: {{"by": float(rank())}}, {BATCH}, {SEED})
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
    done = {2: 1 / 4, 4: 3 / 4, 6: 5 / 6}  # of the training as each process was told it, before that step
    assert first["curves"] == second["curves"] == [{"step": k, "done": d, "by": 0.0} for k, d in done.items()]
    assert not torch.equal(first["noise"], second["noise"])

    torch.manual_seed(SEED)
    model = torch.nn.Linear(2, 1)
    optimiser = torch.optim.SGD(model.parameters(), lr=RATE, momentum=0.9)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, DECAY)
    for step in range(STEPS):
        shares = [np.random.default_rng((SEED, step, rank)).normal(size=(BATCH // 2, 2)) for rank in range(2)]
        x = torch.from_numpy(np.concatenate(shares)).float()
        optimiser.zero_grad()
        (model(x) - x.sum(dim=1, keepdim=True)).square().mean().backward()
        optimiser.step()
        schedule.step()
        for ended, mine in zip((first, second), shares, strict=True):
            torch.testing.assert_close(ended["drawn"][step], torch.from_numpy(mine).float())
    torch.testing.assert_close(first["model"], model.state_dict())


def test_alone_nothing_changes(tmp_path: Path):
    model = torch.nn.Linear(2, 1)
    optimiser = torch.optim.SGD(model.parameters(), lr=RATE)
    steps = iter(range(2))

    def loss_of(count: int, done: float, rng: np.random.Generator) -> tuple[torch.Tensor, dict[str, float]]:
        step = next(steps)
        expected = np.random.default_rng((SEED, step)).normal(size=5)
        np.testing.assert_array_equal(rng.normal(size=5), expected)
        assert (count, done) == (7, step / 2)
        assert model.training
        return model(torch.ones(count, 2)).mean(), {}

    def evaluate() -> dict[str, float]:
        assert not model.training
        assert not torch.is_grad_enabled()
        return {"loss": 1.0}

    schedule = torch.optim.lr_scheduler.ConstantLR(optimiser, 1.0)
    TrainingRun(tmp_path, model, schedule, 2, evaluations=2).minimise(loss_of, evaluate, 7, SEED)
    assert next(steps, None) is None
    assert not model.training
    assert not optimiser._optimizer_step_pre_hooks


def test_a_gradient_is_clipped_and_what_lies_beside_the_network_is_resumed(tmp_path: Path):
    """Averaged weights, kept up by a hook of the optimiser, as a model beside the network."""

    def train(steps: int) -> tuple[torch.nn.Linear, torch.nn.Linear]:
        network, mean = torch.nn.Linear(1, 1, bias=False), torch.nn.Linear(1, 1, bias=False)
        torch.nn.init.zeros_(network.weight)
        torch.nn.init.zeros_(mean.weight)
        optimiser = torch.optim.SGD(network.parameters(), lr=1.0)

        def average(*_: object) -> None:
            mean.weight.data.lerp_(network.weight.data, 0.5)

        optimiser.register_step_post_hook(average)
        schedule = torch.optim.lr_scheduler.ConstantLR(optimiser, 1.0)
        both = torch.nn.ModuleDict({"network": network, "mean": mean})
        run = TrainingRun(tmp_path, both, schedule, steps, evaluations=1)
        run.minimise(lambda *_: (-100 * network.weight.sum(), {"loss": 1.0}), dict, 1, SEED, clip=0.25)
        return network, mean

    train(2)
    network, mean = train(3)
    assert network.weight.item() == pytest.approx(0.75, rel=1e-5)
    assert mean.weight.item() == pytest.approx(0.25 / 8 + 0.5 / 4 + 0.75 / 2, rel=1e-5)


def test_a_batch_that_cannot_be_shared_out_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("steadypose.training.distributed.processes", lambda: 3)
    with pytest.raises(ValueError, match="multiple of the 3 processes"):
        share(64)
