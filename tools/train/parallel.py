"""Several processes: PyTorch's fully sharded data parallelism (FSDP)."""

import os

import torch
import torch.distributed as dist
from torch.distributed.device_mesh import init_device_mesh
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


def distribute(model, split=True):
    """Splits parameters, gradients and optimizer state among the processes, block by block.

    Without `split` each process has all of them, and Muon no communication.
    """
    if dist.is_initialized():
        kind, shape = next(model.parameters()).device.type, (1, dist.get_world_size())
        mesh = init_device_mesh(kind, shape if split else shape[::-1], mesh_dim_names=("replicas", "shards"))
        for module in model.modules():
            if isinstance(module, Recomputed):
                fully_shard(module, mesh=mesh)
        # By default, the outermost module would keep whole weights after an evaluation.
        fully_shard(model, mesh=mesh, reshard_after_forward=True)
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
