"""A small stand-in for the networks: convolutions in space, attention over time, any size, any number of frames."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from turbnet.deploy.card import ModelCard
from turbnet.deploy.export import export_onnx


class StandIn(nn.Module):
    size_multiple = 4

    def __init__(self, width: int = 8):
        super().__init__()
        self.head = nn.Conv2d(48, width, 3, padding=1)
        self.norm = nn.LayerNorm(width)
        self.mix = nn.Linear(width, 3 * width)
        self.tail = nn.Conv2d(width, 48, 3, padding=1)

    def forward(self, frames_BTCHW):
        batch, frames, _, height, width = frames_BTCHW.shape
        y = self.head(F.pixel_unshuffle(frames_BTCHW.flatten(0, 1), 4)).unflatten(0, (batch, frames))
        y = y.permute(0, 3, 4, 1, 2)
        query, key, value = self.mix(self.norm(y)).chunk(3, -1)
        y = y + torch.softmax(query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5, -1) @ value
        y = self.tail(y.permute(0, 3, 4, 1, 2).flatten(0, 1))
        return frames_BTCHW + F.pixel_shuffle(y, 4).unflatten(0, (batch, frames))


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def stand_in() -> type[StandIn]:
    return StandIn


@pytest.fixture(scope="session")
def network() -> StandIn:
    torch.manual_seed(1)
    return StandIn().eval()


@pytest.fixture(scope="session")
def card() -> ModelCard:
    return ModelCard("stand-in", {"width": 8}, size_multiple=4, frames=6, seed=1, notes={"data": "none"})


@pytest.fixture(scope="session")
def model_file(network, card, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "stand-in.onnx"
    export_onnx(network, card, path)
    return path
