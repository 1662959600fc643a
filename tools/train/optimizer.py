"""Muon for the matrices between layers, AdamW for the rest, or AdamW for all."""

import torch
import torch.distributed as dist

# First layer of the camera encoder, last of the head: Muon's steps, equally long in all
# directions, do not suit these.
ENDS = ("pose_branch.fc1.weight", "gaussian_head.1.weight")


class Optimizer:
    """Both optimizers. Processes split Muon's matrices and broadcast the results.

    The backbone's rate is `backbone_rate` times the others'; 0 freezes it.
    """

    def __init__(self, model, weight_decay, rank, processes, backbone_rate=1.0, muon=True):
        matrices, rest, shares = [], [], {}
        for name, p in model.named_parameters():
            (matrices if muon and p.ndim == 2 and not name.endswith(ENDS) else rest).append(p)
            shares[p] = backbone_rate if name.startswith("backbone.") else 1.0
        matrices.sort(key=torch.numel, reverse=True)
        self.shares = [matrices[i::processes] for i in range(processes)]
        self.parameters = list(model.parameters())

        def groups(parameters, decay):
            """One group per rate factor."""
            of_shares = [(share, [p for p in parameters if shares[p] == share]) for share in sorted(set(shares.values()))]
            return [{"params": chosen, "weight_decay": decay, "share": share} for share, chosen in of_shares if chosen]

        wide, narrow = ([p for p in rest if (p.ndim > 1) == is_wide] for is_wide in (True, False))
        self.adamw = torch.optim.AdamW(groups(wide, weight_decay) + groups(narrow, 0.0), lr=0.0, betas=(0.9, 0.95), fused=True)
        # RMS matched to AdamW, so both use the same rate.
        shared = groups(self.shares[rank], weight_decay)
        self.muon = torch.optim.Muon(shared, lr=0.0, adjust_lr_fn="match_rms_adamw") if shared else None

    @torch.no_grad()
    def step(self, rate, clip):
        """Clips gradients to the norm `clip`, updates the weights and returns the norm."""
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, clip)
        for p in self.parameters:
            p.grad.nan_to_num_(0, 0, 0)  # skips a non-finite step without a readback
        for optimizer in filter(None, (self.adamw, self.muon)):
            for group in optimizer.param_groups:
                group["lr"] = rate * group["share"]
            optimizer.step()
        for rank, share in enumerate(self.shares if len(self.shares) > 1 else []):
            for p in share:
                dist.broadcast(p, rank)
        for p in self.parameters:
            p.grad = None
        return norm

    def state_dict(self):
        """Omits Muon's state: processes differ, and it spans about 20 steps."""
        return self.adamw.state_dict()

    def load_state_dict(self, state):
        self.adamw.load_state_dict(state)
