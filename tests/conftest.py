import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import nn

from turbnet.nets import build

# One thread a process: tests run in parallel processes, and small tensors gain nothing from more.
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def trained() -> Callable[[dict], nn.Module]:
    """Builds a network whose every weight takes part, as after training: none is zero."""

    def build_trained(config: dict) -> nn.Module:
        torch.manual_seed(4)
        network = build(config)
        with torch.no_grad():
            for parameter in network.parameters():
                if not parameter.any():
                    parameter.normal_(std=0.02)
        return network.eval()

    return build_trained


@pytest.fixture(scope="session")
def fuzz() -> ModuleType:
    """tools/fuzz.py, which makes spoiled files and reads them."""
    spec = importlib.util.spec_from_file_location("fuzz", Path(__file__).parents[1] / "tools" / "fuzz.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz"] = module  # for its dataclass
    spec.loader.exec_module(module)
    return module
