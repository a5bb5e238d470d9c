"""An exponential average of the weights beside those that learn."""

from lightning.pytorch.callbacks import WeightAveraging
from torch.optim.swa_utils import get_ema_multi_avg_fn

from turbnet.errors import check_range


class WeightAverage(WeightAveraging):
    """What is validated, kept as the best and exported: w <- w + (1 - decay)(w_learning - w) after every step.

    Unlike lightning's `EMAWeightAveraging` it leaves frozen weights as they are, to the last bit.

    Args:
        decay: the average looks back over about 1 / (1 - decay) steps.

    Raises:
        ParameterError: decay is out of range.
    """

    def __init__(self, decay: float = 0.99) -> None:
        super().__init__(multi_avg_fn=get_ema_multi_avg_fn(check_range("decay", decay, 0, 1)))
