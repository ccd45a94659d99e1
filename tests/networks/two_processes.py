"""Two learners on a line of points, by one process or several: `python two_processes.py FOLDER`.

Every process draws `POINTS` points a step; alone, it draws as many as `TOGETHER` processes would.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import torch

from lightsim.networks.devices import ALONE, Processes, joined_processes
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim.progress import SilentProgress
from lightsim.store.checkpoint import FolderCheckpointer

POINTS, TOGETHER = 4, 2


def train(folder: Path, processes: Processes = ALONE, minutes: float | None = None) -> int:
    """Train, or go on; the weights of both networks and the steps done go to `final.pt`."""
    torch.manual_seed(3)
    a, b = torch.nn.Linear(3, 1), torch.nn.Linear(1, 1)

    def points(draw: int) -> torch.Tensor:
        return torch.randn(POINTS, 3, generator=torch.Generator().manual_seed(draw))

    def losses(_: int, draw: int) -> Iterator[Loss]:
        draws = range(TOGETHER * draw, TOGETHER * (draw + 1)) if processes.count == 1 else [draw]
        x = torch.cat([points(number) for number in draws])
        y = x.sum(dim=1, keepdim=True) ** 2
        loss = (a(x) - y).square().mean()
        yield "a", loss, {"a": loss}
        yield "b", (b(a(x).detach()) - y).square().mean(), {}

    learners = {
        "a": Learner(a, (torch.optim.AdamW(a.parameters(), lr=1e-2),), is_averaged=True),
        "b": Learner(b, (torch.optim.SGD(b.parameters(), lr=1e-2),)),
    }
    session = Session(FolderCheckpointer(folder), SilentProgress(), minutes, processes=processes)
    done = run_training(learners, losses, LoopConfig(steps=30, warm_up_steps=5), session)
    if processes.is_first:
        torch.save({"a": a.state_dict(), "b": b.state_dict(), "done": done}, folder / "final.pt")
    return done


if __name__ == "__main__":
    torch.set_num_threads(1)
    with joined_processes(torch.device("cpu")) as joined:
        assert joined.count == TOGETHER
        assert train(Path(sys.argv[1]), joined, minutes=0.0) == 1
        assert train(Path(sys.argv[1]), joined) == 30
