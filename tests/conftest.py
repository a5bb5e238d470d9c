import torch

# One thread a process: tests run in parallel processes, and small tensors gain nothing from more.
torch.set_num_threads(1)
