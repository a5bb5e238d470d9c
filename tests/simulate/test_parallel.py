import threading
import time

import pytest
import torch

from turbnet.simulate.parallel import on_all_cores


def test_results_come_in_order_from_several_threads_of_one_core_each():
    meeting = threading.Barrier(2, timeout=30)  # passed only if two pieces run at once

    def work(item: int) -> tuple[int, int]:
        meeting.wait()
        return item * item, torch.get_num_threads()

    before = torch.get_num_threads()
    assert list(on_all_cores(work, range(6), cores=2)) == [(n * n, 1) for n in range(6)]
    assert torch.get_num_threads() == before


def test_an_error_ends_the_work():
    begun = []

    def work(item: int) -> None:
        begun.append(item)
        time.sleep(0.001)  # long enough for the news of the error to arrive before all is done
        if item == 1:
            raise ValueError("item 1")

    with pytest.raises(ValueError, match="item 1"):
        list(on_all_cores(work, range(1000), cores=2))
    assert len(begun) < 1000
