"""Several processes: PyTorch's fully sharded data parallelism (FSDP)."""

import os

import torch
import torch.distributed as dist
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

from layers import Recomputed


def rank_and_processes():
    """As set by torchrun; (0, 1) without it."""
    return int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))


def device_of_process():
    """Returns this process's device and joins its group."""
    if torch.cuda.is_available():
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.cuda.set_device(device)
    else:
        device = torch.device("cpu")
    if rank_and_processes()[1] > 1:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return device


def shard(model):
    """Splits parameters, gradients and optimizer state among the processes, block by block."""
    if dist.is_initialized():
        for module in model.modules():
            if isinstance(module, Recomputed):
                fully_shard(module)
        fully_shard(model)
    return model


def full(tensor):
    """Collects a sharded tensor: every process must call it."""
    return tensor.full_tensor() if isinstance(tensor, DTensor) else tensor


def full_state(model):
    """Collects a model's parameters on the CPU: every process must call it."""
    return {name: full(value).cpu() for name, value in model.state_dict().items()}


def distributed_like(tensor, parameter):
    """Shards a full tensor like its parameter."""
    if not isinstance(parameter, DTensor) or isinstance(tensor, DTensor):
        return tensor
    return distribute_tensor(tensor, parameter.device_mesh, parameter.placements)
