"""The published training, setting by setting: ZipSplat, arXiv 2606.05102."""

# Setting: (value, section). "A" is appendix A. The reference code wins over the text.
PAPER = {
    "architecture.family": ("da3", "4.1"),
    "architecture.width": (1536, "A"),
    "architecture.depth": (40, "A"),
    "architecture.heads": (24, "A"),
    "architecture.patch": (14, "A"),
    "architecture.out_layers": ([19, 29, 39], "A"),
    "architecture.camera_depth": (4, "A"),
    "architecture.fusion_heads": (24, "A"),
    "architecture.fusion_hidden": (4 * 1536, "A"),
    "architecture.color_width": (128, "A"),
    "architecture.head_hidden": (2 * (1536 + 128), "A, text: 3072"),
    "architecture.gaussians_per_token": (32, "4.1"),
    "architecture.sh_degree": (1, "A"),
    "initial.coupled": (True, "3.3"),
    "initial.jitter": (0, "3.3"),
    "initial.colors": (False, "3.3"),
    "initial.depth": (0.5, "A"),
    "initial.opacity": (-1.5, "A"),
    "losses.l1": (1, "3.3"),
    "losses.perceptual": (0.05, "4.1"),
    "losses.chamfer": (0.1, "4.1"),
    "losses.depth": (0.01, "4.1"),
    **{f"losses.{name}": (0, "3.3") for name in ("mse", "ssim", "gradient", "anchor", "ray", "color", "position")},
    "hinges.scale": (0.1, "A"),
    "losses.scale": (1, "code"),
    "losses.faint": (1, "code, text: opacities above the hinge"),
    "losses.far": (1, "code"),
    "losses.opacity": (0, "code"),
    "hinges.opacity": (0.01, "A"),
    "hinges.far": (10, "code"),
    "robust": (False, "3.3"),
    "chamfer_gaussians": (0, "3.3"),
    "queries": (0, "3.1"),
    "size": (252, "4.1"),
    "steps": (450_000, "4.1"),
    "views": ([2, 24], "3.3"),
    "ratio": (0.5, "3.3"),
    "ratio_step": (0, "3.3"),
    "progressive": (0.5, "4.1"),
    "targets": (4, "A"),
    "priors": (0.2, "A"),
    "batch_scenes": (16 * 24, "4.1"),
    "learning_rate": (3e-4, "4.1"),
    "backbone_rate": (0.1, "4.1"),
    "camera_rate": (0, "code"),
    "muon": (False, "4.1"),
    "betas": ([0.9, 0.95], "A"),
    "warmup": (0.05, "4.1"),
    "weight_decay": (0.05, "4.1"),
    "clip": (1, "A"),
    "bf16": (True, "A"),
    # Single stage: no steps without rendering, no extra losses or cameras, no weight averaging.
    **{name: (0, "A") for name in ("geometry_until", "geometry_after", "loose", "anchor_until", "ema")},
}
# Tables 4b and 4c (section 4.5).
ABLATIONS = {**PAPER, "views": ([2, 2], "4.5"), "steps": (115_000, "4.5")}
SMALL_NETWORK = {
    "width": 384, "depth": 12, "heads": 6, "out_layers": [5, 7, 11], "fusion_heads": 6, "fusion_hidden": 1536, "head_hidden": 1024,
}  # fmt: skip
ABLATIONS |= {f"architecture.{name}": (value, "4.5, DA3-S") for name, value in SMALL_NETWORK.items()}

# Statements that no setting expresses.
ELSEWHERE = {
    "backbone from DA3-Giant (4.1)": "--backbone",
    "equal mixture of RealEstate10K and DL3DV (4.1)": "--data re10k:DIR --data dl3dv:DIR",
    "depth of DA3-Giant at given cameras (4.1)": "--depths, by `zipsplat depth PHOTOS --cameras FILE`",
    "LPIPS (3.3)": "--lpips",
    "16 GPUs (4.1)": "torchrun",
    "cosine decay to 0 (4.1), cosine schedule of the ratio (3.3)": "schedule.py",
    "poses relative to the first view, unit median distance (A)": "data.batch",
    "no geometric gradient for Gaussians that targets show (3.3)": "losses.chamfer",
    "activations of Gaussians and their bounds (A)": "model.activate",
}


def flat(config, prefix=""):
    """Returns {"section.name": value}."""
    rows = {}
    for name, value in config.items():
        rows |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return rows


def differences(config, published):
    """Returns {setting: (value, published value)} where they differ."""
    settings = flat(config)
    return {name: (settings.get(name), value) for name, (value, _) in published.items() if settings.get(name) != value}


def comparison(config):
    """Describes a configuration against the closer of the two published ones."""
    published = min((PAPER, ABLATIONS), key=lambda values: len(differences(config, values)))
    differing, lines = differences(config, published), []
    for name, value in flat(config).items():
        stated, section = published.get(name, ("not stated", ""))
        mark = "!" if name in differing else "=" if section else " "
        lines.append(f"{mark} {name:34} {value!s:14} {stated if mark != '=' else ''} {section and f'({section})'}".rstrip())
    lines += [f"> {statement}: {place}" for statement, place in ELSEWHERE.items()]
    return "\n".join([*lines, f"{len(differing)} of {len(published)} published settings differ"])
