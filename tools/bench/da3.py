"""Measures Depth Anything 3 on captures.

    da3.py CAPTURE... --weights FILE [--seconds 20] [--views 8] [--size WxH]

A capture is a folder of images with cameras and optionally depth/NAME.npy. The first row of each
capture has the median errors of cameras (position relative to their extent) and depth. The others
refine for equal seconds and score held-out photos: the capture's cameras and points, COLMAP's, and
the network's cameras with points or one Gaussian per pixel. Seeded weights only test the script.
$ZIPSPLAT is the command.
"""

import argparse
import tempfile
from pathlib import Path

from command import zipsplat

# Refinement steps that measure the time of a step.
PROBE = 4


def refined(words, options):
    """Refines for the given seconds; returns table cells."""
    shown = ["--views", options.views, "--eval-size", options.size, "--lpips", "none", *words]
    probe = zipsplat("eval", *shown, "--refine", PROBE)["refined"]
    steps = max(1, round(options.seconds * PROBE / probe["seconds"]))
    scored = zipsplat("eval", *shown, "--refine", steps)
    took = scored["refined"]["seconds"]
    psnr = f"{scored['mean']['psnr']:.2f} dB ({len(scored['views'])})"
    return [psnr, f"{scored['gaussians']:,}", f"{scored['refined']['steps']} steps in {took:.0f} s"]


def errors(photos, capture, folder, options):
    """Returns the network's errors as table cells."""
    words = ["--weights", options.weights, "--ground-truth", capture, "-o", folder / "depth"]
    off = zipsplat("depth", photos, *words)["errors"]
    told = {
        "rotation_error_deg": "turn {:.2f} degrees",
        "translation_error": "position {:.2%}",
        "focal": "focal length {:+.1%}",
        "abs_rel": "depth {:.1%} (AbsRel)",
        "delta_1_25": "{:.1%} of pixels within 1.25",
    }
    return [", ".join(text.format(off[name]) for name, text in told.items() if off[name] is not None)]


def rows(capture, folder, options):
    """Returns {row name: function that computes its cells}."""
    photos = folder / "images"
    photos.symlink_to((capture / "images").resolve())

    def found(name, *words):
        """Estimates cameras with a command; returns the arguments that use them."""
        place = folder / f"{name}.json"
        zipsplat("cameras", photos, *words, "-o", place)
        return [photos, "--cameras", place]

    network = ["--method", "da3", "--weights", options.weights]
    pixels = ["--weights", options.weights, "--input-size", options.size, "--init", "scene"]
    return {
        "off by": lambda: errors(photos, capture, folder, options),
        "its own cameras and points": lambda: refined([capture, "--init", "points"], options),
        "COLMAP's": lambda: refined([*found("colmap"), "--init", "points"], options),
        "the network's cameras, points of its depth": lambda: refined(
            [*found("network", *network), "--init", "points"], options
        ),
        "the network's cameras, a Gaussian a pixel": lambda: refined([*found("pixels", *network), *pixels], options),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--weights", required=True)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--size", default="252x252")
    options = parser.parse_args()
    print("| capture | way | held-out photos | Gaussians | refined |\n|---|---|---|---|---|")
    for capture in options.captures:
        with tempfile.TemporaryDirectory() as folder:
            for way, cells in rows(capture, Path(folder), options).items():
                try:
                    found = cells()
                except RuntimeError as error:
                    found = [str(error)]
                print("|", " | ".join([capture.name, way, *found]), "|", flush=True)


if __name__ == "__main__":
    main()
