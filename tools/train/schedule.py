"""Settings of a run and their schedules."""

import json
import math
from pathlib import Path


def read_config(path, changes=()):
    config = read_preset(path)
    for change in changes:
        name, value = change.split("=", 1)
        *parents, last = name.split(".")
        section = config
        for parent in parents:
            section = section.get(parent, {})
        if last not in section:
            raise SystemExit(f"--set {name}: found no such setting in {path}")
        section[last] = json.loads(value)
    validate(config)
    return config


def read_preset(path):
    """Returns the settings of a file and, where it omits some, of the file named by its `base`."""
    path = Path(path)
    own = json.loads(path.read_text())
    if "base" not in own:
        return own
    config = read_preset(path.parent / own.pop("base"))
    for name, value in own.items():
        section, value = (config[name], value) if isinstance(value, dict) else (config, {name: value})
        if unknown := value.keys() - section.keys():
            raise SystemExit(f"{path}: found unknown settings {', '.join(sorted(unknown))}, expected those of its base")
        section.update(value)
    return config


# Of the engine: sizes with the numbers that they are multiples of, and heads with their widths.
SIZES = {"width": 8, "ffn_hidden": 8, "patch": 2, "camera_hidden": 8, "camera_pose_hidden": 8, "fusion_hidden": 8, "color_width": 8,
         "color_hidden": 8, "head_hidden": 8}  # fmt: skip
HEADS = {"heads": "width", "camera_heads": "width", "fusion_heads": "width", "color_heads": "color_width"}


def validate(config):
    """Rejects contradictory settings by name."""

    def expect(name, found, good, expected):
        if not good:
            raise SystemExit(f"{name}: found {json.dumps(found)}, expected {expected}")

    a, initial, weights = config["architecture"], config["initial"], config["losses"]
    cells, per_token, queries = config["anchor_cells"], a["gaussians_per_token"], config["queries"]
    count = math.prod(cells)
    expect("architecture.family", a["family"], a["family"] in ("da3", "vggt"), "da3 or vggt")
    camera = a["family"] == "da3"
    for field, of in SIZES.items():
        if camera or not field.startswith("camera_"):
            expect(f"architecture.{field}", a[field], a[field] > 0 and a[field] % of == 0, f"a multiple of {of}")
    for field, width in HEADS.items():
        if camera or not field.startswith("camera_"):
            whole = a[field] > 0 and a[width] % (4 * a[field]) == 0
            expect(f"architecture.{field}", a[field], whole, f"a divisor of {width}, {a[width]}, into heads of a multiple of 4")
    for name in ("coupled", "colors"):
        expect(f"initial.{name}", initial[name], isinstance(initial[name], bool), "true or false")
    expect("anchor_cells", cells, per_token % count == 0, f"rows and columns that divide the {per_token} Gaussians of a token")
    if initial["colors"]:
        width = a["color_width"]
        expect("architecture.color_width", width, width >= 3 * count, f"{3 * count} at least, three channels for each of anchor_cells")
        least = 2 * (a["width"] + width)
        expect("architecture.head_hidden", a["head_hidden"], a["head_hidden"] >= least, f"{least} at least")
    for name in ("backbone_rate", "camera_rate"):
        rate = config[name]
        expect(name, rate, isinstance(rate, int | float) and 0 <= rate <= 1, "a share of the learning rate, 0 to 1")
    if a["family"] == "vggt":
        expect("priors", config["priors"], config["priors"] == 0, "0, since VGGT has no known cameras as input")
    warmup, size, evaluated = config["warmup"], config["size"], config["evaluate"][0]
    expect("warmup", warmup, 0 < warmup < 1, "a fraction between 0 and 1")
    expect("size", size, size % a["patch"] == 0, f"a multiple of the patch size, {a['patch']}")
    expect("evaluate", config["evaluate"], evaluated < config["record_views"], f"fewer views than record_views, {config['record_views']}")
    for name in ("progressive", "ratio_step"):
        expect(name, config[name], 0 <= float(config[name]) <= 1, "a fraction, 0 to 1")
    scenes, views = config["batch_scenes"], config["batch_views"]
    expect("batch_scenes", scenes, (scenes > 0) != (views > 0), f"0 if batch_views is positive, found {views}, else a number of scenes")
    most, highest = config["views_at_once"], config["views"][1]
    expect("views_at_once", most, most == 0 or most >= highest, f"0, or at least the {highest} views of a scene")
    highest += config["targets"]
    expect("record_views", config["record_views"], config["record_views"] >= highest, f"{highest} at least, views and targets")
    gap = config["gap"]
    ordered = isinstance(gap, list) and len(gap) == 2 and 1 <= gap[0] <= gap[1]
    expect("gap", gap, ordered, "the least and the largest number of neighboring frames that a scene's views are of")
    for name in ("muon", "robust", "recompute", "shard", "bf16", "compile"):
        expect(name, config[name], isinstance(config[name], bool), "true or false")
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
        """Draws views and ratio; ranges grow from fewest views and ratio 1 until `progressive`."""
        until, step = self.config["progressive"], self.config["ratio_step"]
        grown = min(done / until, 1) if until else 1
        low, high = self.config["views"]
        views = rng.randint(low, round(low + (high - low) * grown))
        least = min(self.config["ratio"] * math.sqrt(2 / views), 1)
        least = 1 - (1 - least) * 0.5 * (1 - math.cos(math.pi * grown))
        ratio = rng.uniform(least, 1)
        return views, max(round(ratio / step) * step, step) if step else ratio

    def draws_pictures(self, done, rng):
        """Whether a step renders: not in the first phase, later with a fixed probability."""
        return done >= self.config["geometry_until"] and rng.random() >= self.config["geometry_after"]

    def weights(self, done):
        """Loss weights, with anchors fading out until `anchor_until`."""
        until = self.config["anchor_until"]
        fade = max(1 - done / until, 0) if until else 0
        return {**self.config["losses"], "anchor": self.config["losses"]["anchor"] * fade}
