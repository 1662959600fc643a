"""What changes the weights: Muon for the matrices between layers, AdamW for the rest."""

import torch
import torch.distributed as dist

# They read cameras and write Gaussians; a step of Muon, which is as long in every direction, does not suit those.
ENDS = ("pose_branch.fc1.weight", "gaussian_head.1.weight")


class Optimiser:
    """Processes share Muon's work: each changes some of the matrices and sends them to the others."""

    def __init__(self, model, weight_decay, rank, processes):
        matrices, rest = [], []
        for name, p in model.named_parameters():
            (matrices if p.ndim == 2 and not name.endswith(ENDS) else rest).append(p)
        groups = [
            {"params": [p for p in rest if p.ndim > 1], "weight_decay": weight_decay},
            {"params": [p for p in rest if p.ndim <= 1], "weight_decay": 0.0},
        ]
        matrices.sort(key=torch.numel, reverse=True)
        self.shares = [matrices[i::processes] for i in range(processes)]
        self.parameters = list(model.parameters())
        self.adamw = torch.optim.AdamW(groups, lr=0.0, betas=(0.9, 0.95), fused=True)
        # Steps as long as AdamW's, so that both take the same rate.
        share = self.shares[rank]
        self.muon = torch.optim.Muon(share, lr=0.0, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")

    @torch.no_grad()
    def step(self, rate, clip):
        """Clips the gradients to a norm of `clip`, changes the weights, and gives the norm that was found."""
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, clip)
        for p in self.parameters:
            p.grad.nan_to_num_(0, 0, 0)  # of steps whose gradients are not finite, without asking the device
        for optimiser in (self.adamw, self.muon):
            for group in optimiser.param_groups:
                group["lr"] = rate
            optimiser.step()
        for rank, share in enumerate(self.shares if len(self.shares) > 1 else []):
            for p in share:
                dist.broadcast(p, rank)
        for p in self.parameters:
            p.grad = None
        return norm

    def state_dict(self):
        """Muon's is left out: each process has its own, and it is 20 steps long."""
        return self.adamw.state_dict()

    def load_state_dict(self, state):
        self.adamw.load_state_dict(state)
