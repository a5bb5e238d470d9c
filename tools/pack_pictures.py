"""Pack clean pictures into one file to train on, small enough to carry to another machine.

python tools/pack_pictures.py FOLDER [FOLDER ...] -o pictures.zip [--megabytes 48] [--side 512]
turbnet train experiment=s data.folders=[pictures.zip]
"""

import argparse
import sys
from pathlib import Path

from turbnet.data.pack import write_pack
from turbnet.data.sources import folder_paths
from turbnet.errors import InputError


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="folders of pictures, searched recursively")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the pack to write, .zip")
    parser.add_argument("--megabytes", type=float, default=48.0, help="greatest size, MiB; more is thinned out evenly")
    parser.add_argument("--side", type=int, default=512, help="longer side of a picture, pixels")
    options = parser.parse_args()
    try:
        if options.output.suffix != ".zip":
            raise InputError(f"cannot write {options.output}: the name of a pack ends in .zip")
        paths = [path for path in folder_paths(options.folders) if isinstance(path, Path)]
        count, size = write_pack(paths, options.output, options.side, options.megabytes)
    except InputError as error:
        print(f"pack_pictures: {error}", file=sys.stderr)
        return 2
    print(f"{options.output}: {count} of {len(paths)} pictures, {size / 2**20:.1f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
