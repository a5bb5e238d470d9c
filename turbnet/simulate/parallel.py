"""Independent pieces of work on all cores at once: one thread each, so that a piece's result does not depend on how many.

Torch spreads every single operation over the cores, and between operations they wait for each other; pieces that have
nothing to do with one another need not. Torch lets go of Python's lock while it computes.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def on_all_cores(function: Callable[[Item], Result], items: Iterable[Item], cores: int) -> Iterator[Result]:
    """Yield `function(item)` for each item, in order, computed `cores` at a time; nothing more is begun after an error."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    pool = ThreadPoolExecutor(cores, initializer=torch.set_num_threads, initargs=(1,))
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)
