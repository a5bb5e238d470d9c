"""The mean of the weights of several checkpoints of one network, as a checkpoint to export or to go on from.

    python tools/mean_weights.py s run1/last.ckpt run2/last.ckpt -o mean.ckpt [--weights 1 2 2]

Checkpoints are files of `turbnet train`, or names of released networks; the mean takes each alike unless weighed. See
`turbnet.tasks.checkpoint.mean_of`.
"""

import argparse
import sys
from pathlib import Path

import torch

from turbnet.errors import InputError
from turbnet.media.atomic import atomic_path
from turbnet.tasks.checkpoint import mean_of


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", help="of one network")
    parser.add_argument("--output", "-o", type=Path, required=True)
    parser.add_argument("--weights", nargs="+", type=float, help="one for each checkpoint; default: all alike")
    options = parser.parse_args()
    try:
        mean = mean_of(options.checkpoints, options.weights)
        with atomic_path(options.output) as temporary:
            torch.save(mean, temporary)
    except InputError as error:
        print(f"mean_weights: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
