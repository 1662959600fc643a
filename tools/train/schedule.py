"""Settings of a run and their schedules."""

import json
import math
from pathlib import Path


def read_config(path, changes):
    config = json.loads(Path(path).read_text())
    for change in changes:
        name, value = change.split("=", 1)
        *parents, last = name.split(".")
        section = config
        for parent in parents:
            section = section[parent]
        if last not in section:
            raise SystemExit(f"--set {name}: found no such setting in {path}")
        section[last] = json.loads(value)
    validate(config)
    return config


def validate(config):
    """Rejects contradictory settings by name."""

    def expect(name, found, good, expected):
        if not good:
            raise SystemExit(f"{name}: found {json.dumps(found)}, expected {expected}")

    a, initial, weights = config["architecture"], config["initial"], config["losses"]
    cells, per_token, rate, queries = (config["anchor_cells"], a["gaussians_per_token"], config["backbone_rate"], config["queries"])
    count = math.prod(cells)
    expect("initial.coupled", initial["coupled"], isinstance(initial["coupled"], bool), "true or false")
    expect("anchor_cells", cells, per_token % count == 0, f"rows and columns that divide the {per_token} Gaussians of a token")
    width = a["color_width"]
    expect("architecture.color_width", width, width >= 3 * count, f"{3 * count} at least, three channels for each of anchor_cells")
    least = 2 * (a["width"] + width)
    expect("architecture.head_hidden", a["head_hidden"], a["head_hidden"] >= least, f"{least} at least")
    expect("backbone_rate", rate, isinstance(rate, int | float) and 0 <= rate <= 1, "a share of the learning rate, 0 to 1")
    gap = config["gap"]
    ordered = isinstance(gap, list) and len(gap) == 2 and 1 <= gap[0] <= gap[1]
    expect("gap", gap, ordered, "the least and the largest number of neighboring frames that a scene's views are of")
    expect("muon", config["muon"], isinstance(config["muon"], bool), "true, or false for AdamW alone")
    expect("queries", queries, isinstance(queries, int) and queries >= 0, "a number of learned queries, 0 for tokens of the scene")
    if queries:
        for name in ("anchor", "ray", "color"):
            expect(f"losses.{name}", weights[name], weights[name] == 0, "0 with learned queries, which have no patch to be held to")
        for name in ("geometry_until", "geometry_after"):
            expect(name, config[name], config[name] == 0, "0 with learned queries, which learn from pictures alone")


class Schedule:
    """Values that depend on the completed fraction of the run, 0 to 1."""

    def __init__(self, config):
        self.config = config

    def rate(self, done):
        """Linear warm-up, then a cosine to zero."""
        warmup, done = self.config["warmup"], min(done, 1)
        falling = 0.5 * (1 + math.cos(math.pi * max(done - warmup, 0) / (1 - warmup)))
        return self.config["learning_rate"] * min(done / warmup, falling)

    def draw(self, done, rng):
        """Draws views and ratio; ranges grow from fewest views and ratio 1 in the first half."""
        grown = min(2 * done, 1) if self.config["progressive"] else 1
        low, high = self.config["views"]
        views = rng.randint(low, round(low + (high - low) * grown))
        least = min(self.config["ratio"] * math.sqrt(2 / views), 1)
        least = 1 - (1 - least) * 0.5 * (1 - math.cos(math.pi * grown))
        return views, max(round(rng.uniform(least, 1) * 20) / 20, 0.05)

    def draws_pictures(self, done, rng):
        """Whether a step renders: not in the first phase, later with a fixed probability."""
        return done >= self.config["geometry_until"] and rng.random() >= self.config["geometry_after"]

    def weights(self, done):
        """Loss weights, with anchors fading out."""
        fade = max(1 - done / self.config["anchor_until"], 0)
        return {**self.config["losses"], "anchor": self.config["losses"]["anchor"] * fade}
