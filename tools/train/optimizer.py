"""Muon for the matrices between layers, AdamW for the rest, or AdamW for all."""

import torch

from parallel import distributed_like, full

# First layer of the camera encoder, last of the head: Muon's steps, equally long in all
# directions, do not suit these.
ENDS = ("pose_branch.fc1.weight", "gaussian_head.1.weight")
# Relative to the base rate, by setting and prefix of names.
SHARES = {"camera_rate": "backbone.cam_enc.", "backbone_rate": "backbone."}


class Optimizer:
    """Both optimizers. A share of 0 freezes its parameters."""

    def __init__(self, model, config):
        matrices, rest, shares = [], [], {}
        for name, p in model.named_parameters():
            (matrices if config["muon"] and p.ndim == 2 and not name.endswith(ENDS) else rest).append(p)
            shares[p] = next((config[setting] for setting, prefix in SHARES.items() if name.startswith(prefix)), 1.0)
        self.parameters = list(shares)
        self.trained = [p for p in shares if shares[p]]

        def groups(parameters, decay):
            """One group per share of the rate."""
            of_shares = [(share, [p for p in parameters if shares[p] == share]) for share in sorted(set(shares.values()))]
            return [{"params": chosen, "weight_decay": decay, "share": share} for share, chosen in of_shares if chosen]

        wide, narrow = ([p for p in rest if (p.ndim > 1) == is_wide] for is_wide in (True, False))
        decayed = groups(wide, config["weight_decay"]) + groups(narrow, 0.0)
        self.adamw = torch.optim.AdamW(decayed, lr=0.0, betas=config["betas"], fused=True)
        # RMS matched to AdamW: both use the same rate.
        decayed = groups(matrices, config["weight_decay"])
        self.muon = torch.optim.Muon(decayed, lr=0.0, adjust_lr_fn="match_rms_adamw") if matrices else None

    @torch.no_grad()
    def step(self, rate, clip):
        """Clips gradients to the norm `clip`, updates the weights and returns the norm."""
        norm = full(torch.nn.utils.clip_grad_norm_(self.trained, clip))
        for p in self.parameters:
            p.grad.nan_to_num_(0, 0, 0)  # skips a non-finite step without a readback
        for optimizer in filter(None, (self.adamw, self.muon)):
            for group in optimizer.param_groups:
                group["lr"] = rate * group["share"]
            optimizer.step()
        for p in self.parameters:
            p.grad = None
        return norm

    def state_dict(self):
        """Collects AdamW's state from all processes. Muon's spans about 20 steps: omitted."""
        state = self.adamw.state_dict()
        rows = {i: {name: full(value).cpu() for name, value in row.items()} for i, row in state["state"].items()}
        return {**state, "state": rows}

    def load_state_dict(self, state):
        self.adamw.load_state_dict(state)
        for p, row in self.adamw.state.items():
            row.update({name: distributed_like(value, p) for name, value in row.items() if value.ndim})
