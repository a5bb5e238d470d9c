"""Tasks and training runs that take seconds."""

import csv

import pytest
import skimage.data
import torch
from hydra import compose, initialize_config_module

NET = {
    "name": "restorer",
    "tilt": {"widths": [4, 4, 4]},
    "tcja": {"width": 8, "depth": 1},
    "scene": {"widths": [4, 4, 4], "depths": [1, 1, 1]},
}
SIMULATOR = {"height": 32, "width": 32, "modes": 10, "components": 3, "read_noise": [0.0, 0.0]}

TINY = [
    "threads=1",
    "callbacks=quiet",
    "data.size=32",
    "data.frames=3",
    "data.batch_size=2",
    "data.steps_per_epoch=2",
    "data.val_clips=2",
    "trainer.max_epochs=2",
    "trainer.log_every_n_steps=1",
    "net.tilt.widths=[4,4,4]",
    "net.tcja.width=8",
    "net.tcja.depth=1",
    "net.scene.widths=[4,4,4]",
    "simulator.modes=10",
    "simulator.components=3",
]


@pytest.fixture(scope="session")
def tiny():
    """Builds a configuration of a run of seconds: tiny(folder, overrides...)."""

    def build(folder, *overrides):
        with initialize_config_module("turbnet.configs", version_base="1.3"):
            return compose("train", overrides=[*TINY, f"output={folder}", *overrides])

    return build


@pytest.fixture(scope="session")
def train(tiny):
    """Runs it; returns the folder."""
    from turbnet.tasks.fit import fit

    def run(folder, *overrides):
        fit(tiny(folder, *overrides))
        return folder

    return run


@pytest.fixture(scope="session")
def weights():
    """The network of a checkpoint."""

    def load(path):
        state = torch.load(path, weights_only=True)["state_dict"]
        return {name.removeprefix("net."): value for name, value in state.items() if name.startswith("net.")}

    return load


@pytest.fixture(scope="session")
def curve():
    """Rows of the csv log of a run."""

    def read(folder):
        with (folder / "csv" / "version_0" / "metrics.csv").open() as file:
            # Times are never the same twice.
            return [{k: v for k, v in row.items() if not k.startswith("speed/")} for row in csv.DictReader(file)]

    return read


@pytest.fixture(scope="session")
def stage_one(train, tmp_path_factory):
    """The folder of a run of tilt removal."""
    return train(tmp_path_factory.mktemp("stage_one"), "task=tilt")


@pytest.fixture
def batch():
    """A still scene of four frames."""
    picture = torch.from_numpy(skimage.data.astronaut()[100:132, 200:232].copy()).float().permute(2, 0, 1) / 255
    return {"scene": picture.expand(1, 4, 3, 32, 32), "seed": torch.tensor([3]), "hardness": torch.tensor([1.0])}


@pytest.fixture(scope="session")
def learn():
    """Losses of steps on one batch with a warm-up of ten, as in training."""

    def run(task, batch, steps, rate):
        optimiser = torch.optim.AdamW(list(task.trained()), lr=rate, betas=(0.9, 0.99))
        schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: min(1.0, (step + 1) / 10))
        losses = []
        for _ in range(steps):
            loss = task.training_step(batch, 0)
            losses.append(float(loss.detach()))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        return losses

    return run
