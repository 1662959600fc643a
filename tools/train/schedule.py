"""A run's settings, and those that change while it goes on."""

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
    return config


class Schedule:
    """What changes with the share of the time box that has passed."""

    def __init__(self, config, minutes):
        self.config, self.seconds = config, 60 * minutes

    def rate(self, elapsed):
        """Linear warm-up, then a cosine to zero."""
        warmup, done = self.config["warmup"], min(elapsed / self.seconds, 1)
        falling = 0.5 * (1 + math.cos(math.pi * max(done - warmup, 0) / (1 - warmup)))
        return self.config["learning_rate"] * min(done / warmup, falling)

    def draw(self, elapsed, rng):
        """Views and ratio of a step: from the least views and ratio 1 to their full ranges over the first half."""
        grown = min(2 * elapsed / self.seconds, 1) if self.config["progressive"] else 1
        low, high = self.config["views"]
        views = rng.randint(low, round(low + (high - low) * grown))
        least = min(self.config["ratio"] * math.sqrt(2 / views), 1)
        least = 1 - (1 - least) * 0.5 * (1 - math.cos(math.pi * grown))
        return views, max(round(rng.uniform(least, 1) * 20) / 20, 0.05)

    def draws_pictures(self, elapsed, rng):
        """Geometry comes first, and now and then later; such a step takes half the time."""
        return elapsed >= self.seconds * self.config["geometry_until"] and rng.random() >= self.config["geometry_after"]

    def weights(self, elapsed):
        """Of the losses: the anchors' fades out."""
        fade = max(1 - elapsed / self.seconds / self.config["anchor_until"], 0)
        return {**self.config["losses"], "anchor": self.config["losses"]["anchor"] * fade}
