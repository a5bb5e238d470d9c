"""Means of the weights of several checkpoints."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from turbnet.deploy.checkpoint import load_network
from turbnet.errors import InputError
from turbnet.nets import build
from turbnet.tasks.checkpoint import load_net, mean_of

NET = {"name": "unet", "widths": [4, 8], "depths": [1, 1]}


def saved(path: Path, seed: int, net: dict = NET) -> Path:
    torch.manual_seed(seed)
    state = {f"net.{name}": torch.randn_like(value) for name, value in build(net).state_dict().items()}
    torch.save({"state_dict": state, "hyper_parameters": {"net": net}, "global_step": 5}, path)
    return path


@pytest.fixture
def three(tmp_path) -> list[Path]:
    return [saved(tmp_path / f"{seed}.ckpt", seed) for seed in range(3)]


@pytest.mark.parametrize("weights", [None, [1.0, 2.0, 5.0], [0.0, 0.0, 3.0]])
def test_the_mean_of_every_weight(three, weights):
    shares = torch.tensor(weights or [1.0, 1.0, 1.0], dtype=torch.float64)
    states = [load_net(path) for path in three]
    for name, value in mean_of(three, weights)["state_dict"].items():
        parts = torch.stack([state[name.removeprefix("net.")].double() for state in states], dim=-1)
        assert value.dtype == torch.float32
        torch.testing.assert_close(value.double(), (parts * shares).sum(-1) / shares.sum(), rtol=0, atol=1e-6)


def test_of_one_it_is_that_one(three):
    torch.testing.assert_close(
        mean_of(three[:1])["state_dict"]["net.net.embed.weight"], load_net(three[0])["net.embed.weight"]
    )


def test_released_networks_by_name():
    state = mean_of(["s", "s"])["state_dict"]
    assert all(torch.equal(value, state[f"net.{name}"]) for name, value in load_net("s").items())


@pytest.mark.parametrize("weights", [[1.0], [1.0, -1.0, 1.0], [0.0, 0.0, 0.0], [1.0, float("inf"), 1.0]])
def test_weights_that_make_no_mean(three, weights):
    with pytest.raises(InputError, match="give one for each"):
        mean_of(three, weights)


def test_another_network_is_refused(three, tmp_path):
    other = saved(tmp_path / "other.ckpt", 9, {**NET, "widths": [4, 12]})
    with pytest.raises(InputError, match="holds another network"):
        mean_of([other, *three])


def test_the_command(three, tmp_path):
    """What it writes is a checkpoint like any other; what it cannot do it says in one line."""
    tool = Path(__file__).parents[2] / "tools" / "mean_weights.py"
    command = [sys.executable, str(tool), *map(str, three[:2]), "-o", str(tmp_path / "mean.ckpt")]
    subprocess.run([*command, "--weights", "3", "1"], check=True)
    network, _ = load_network(tmp_path / "mean.ckpt")
    expected = 0.75 * load_net(three[0])["net.embed.weight"] + 0.25 * load_net(three[1])["net.embed.weight"]
    torch.testing.assert_close(network.state_dict()["net.embed.weight"], expected)
    done = subprocess.run([*command, "--weights", "1"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "give one for each" in done.stderr
