#!/usr/bin/env python3
"""Makes a picture like the paper's figures 3, 4, 9 and 13: a scene at several compression ratios.

usage: figures.py OUT      needs Pillow

Reconstructs a procedural scene with the built-in model. Writes figures.jpg, a column per ratio:
a held-out view, the Gaussians' centers, and a color per token. Prints PSNR of all held-out photos.
"""

import json
import sys
from pathlib import Path

from command import zipsplat
from PIL import Image

SEED = 2199023255552 + 6  # unused in training
VIEWS, SIDE, SHOWN = 24, 126, 26
RATIOS = ["1", "0.5", "0.25", "0.1", "0.01"]


def main():
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        sys.exit(__doc__)
    out = Path(sys.argv[1])
    place, camera = out / "place", out / "camera.json"
    zipsplat("scene", "--seed", SEED, "--views", VIEWS + 8, "--size", f"{SIDE}x{SIDE}", "-o", place)
    cameras = json.loads((place / "transforms.json").read_text())
    camera.write_text(json.dumps(cameras | {"frames": [cameras["frames"][SHOWN]]}))
    columns = [[place / "images" / f"{SHOWN:03}.png"]]
    for ratio in RATIOS:
        folder = out / ratio
        scene = folder / "scene.ply"
        said = zipsplat("eval", place, "--views", VIEWS, "--ratio", ratio, "--lpips", "none", "-o", folder)
        print(f"ratio {ratio}: {said['gaussians']:,} Gaussians, {said['mean']['psnr']:.2f} dB", flush=True)
        tokens = ["--gaussians-per-token", said["gaussians"] // said["tokens"]]
        for name, options in {"view": tokens, "centers": ["--point-size", 0.003]}.items():
            zipsplat("render", scene, "--cameras", camera, "-o", folder / name, *options)
        columns.append([folder / "view/000.png", folder / "centers/000.png", folder / "view/000.tokens.png"])
    sheet = Image.new("RGB", (SIDE * len(columns), SIDE * 3), "white")
    for x, column in enumerate(columns):
        for y, picture in enumerate(column):
            sheet.paste(Image.open(picture).convert("RGB"), (SIDE * x, SIDE * y))
    sheet.save(out / "figures.jpg", quality=85)


if __name__ == "__main__":
    main()
