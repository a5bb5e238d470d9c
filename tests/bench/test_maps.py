"""`turbnet bench maps` on a network that knows nothing yet."""

import json
import math

import pytest
import torch

from turbnet.cli.bench import main
from turbnet.errors import InputError
from turbnet.nets import build

NET = {"name": "still", "widths": [4, 4, 4], "depths": [1, 1, 1], "maps": {"widths": [4, 4, 4], "depths": [1, 1, 1]}}


def save(path, net):
    torch.manual_seed(0)
    state = {f"net.{name}": x for name, x in build(net).state_dict().items()}
    torch.save({"hyper_parameters": {"net": net}, "state_dict": state}, path)
    return path


def test_figures_of_a_network_without_training(tmp_path, capsys):
    """All maps are e^-3.5 then: they rank nothing, and their temperature is the mean error over that."""
    checkpoint = save(tmp_path / "still.ckpt", NET)
    arguments = ["maps", str(checkpoint), "--suite", "quick", "--json", str(tmp_path / "maps.json")]
    assert main([*arguments, "--figures", str(tmp_path / "figures"), "--quiet"]) == 0
    rows = {row["name"]: row["value"] for row in json.loads((tmp_path / "maps.json").read_text())["rows"]}
    assert rows["one pass: rank correlation with the local error"] == 0
    assert rows["gradient magnitude: rank correlation with the local error"] > 0.3
    assert rows["gradient magnitude: AUSE"] < rows["one pass: AUSE"]
    error = rows["one pass: temperature"] * math.sqrt(2) * math.exp(-3.5)
    assert 0.01 < error < 0.2
    assert rows["one pass: expected calibration error after it"] < 0.3
    assert "AUSE" in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {"maps-reliability.png", "maps-sparsification.png"}


@pytest.mark.parametrize(
    ("net", "says"),
    [({**NET, "maps": None}, "no uncertainty maps"), ({"name": "dncnn", "width": 4, "depth": 2}, "no unc")],
)
def test_networks_without_maps_are_refused(tmp_path, net, says):
    with pytest.raises(InputError, match=says):
        main(["maps", str(save(tmp_path / "other.ckpt", net)), "--suite", "quick"])
