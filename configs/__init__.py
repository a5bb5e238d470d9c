"""Hydra configuration of `turbnet train`, installed as the package turbnet.configs."""
