#!/usr/bin/env python3
"""Compares numbers of photos, ratios and pooling (figures 11 and 12 of the paper).

usage: views.py CAPTURE [options]

Runs `zipsplat eval` for each number of input photos, ratio and pooling (`--pools`) on evenly spaced
held-out photos. Prints PSNR, Gaussians, forward time, measured and planned peak memory as Markdown.
Finished runs are read from --out.
"""

import argparse
import json
import os
import shlex
from pathlib import Path

from command import timed


def arguments():
    parser = argparse.ArgumentParser(usage=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--views", default="8,24,96,176", help="numbers of input photos")
    parser.add_argument("--ratios", default="1,auto,0.1,0.01")
    parser.add_argument("--pools", default="1", help="sides of the patch groups pooled for global attention")
    parser.add_argument("--targets", type=int, default=8)
    parser.add_argument("--size", default="84x84")
    parser.add_argument("--out", type=Path, default=Path("views"), help="folder for the runs")
    parser.add_argument("--options", default="", help="more options of eval and info, such as --weights")
    parser.add_argument("--cpu", action="store_true", help="count CPU time over cores, for a shared machine")
    return parser.parse_args()


def place(args, views, ratio, pool="1"):
    """Returns the folder of a run."""
    return args.out / (f"{args.capture.name}.{views}.{ratio}" + ("" if pool == "1" else f".{pool}"))


def run(args, views, ratio, pool):
    """Returns the result of eval with planned bytes and CPU time."""
    folder = place(args, views, ratio, pool)
    path = folder / "eval.json"
    if path.exists():
        return json.loads(path.read_text())
    shape = ["--views", views, "--ratio", ratio, "--kv-pool", pool, "--input-size", args.size, *shlex.split(args.options)]
    said, cpu = timed("eval", args.capture, *shape, "--targets", args.targets, "--lpips", "none", "-o", folder, "--overwrite")
    planned, _ = timed("reconstruct", "--dry-run", "--cameras", "capture", *shape)
    said |= {"planned_bytes": planned["peak_bytes"], "flops": planned["flops"], "cpu": cpu / os.cpu_count()}
    path.write_text(json.dumps(said))
    return said


def main():
    args = arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    ratios, pools = args.ratios.split(","), args.pools.split(",")
    print("| photos | ratio | pool | tokens | Gaussians | as PLY | dB | SSIM | GFLOP | time | peak | planned |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for views in map(int, args.views.split(",")):
        for ratio, pool in ((ratio, pool) for ratio in ratios for pool in pools):
            said = run(args, views, ratio, pool)
            mean, count = said["mean"], said["gaussians"]
            ply = (place(args, views, ratio, pool) / "scene.ply").stat().st_size
            seconds = said["cpu"] if args.cpu else said["seconds"]
            mib = [f"{said[name] / 2**20:.1f} MiB" for name in ("peak_bytes", "planned_bytes")]
            print(f"| {views} | {ratio} | {pool} | {said['tokens']:,} | {count:,} | {ply / 1e6:.1f} MB | {mean['psnr']:.2f} | {mean['ssim']:.3f} "
                  f"| {said['flops'] / 1e9:.0f} | {seconds:.1f} s | {mib[0]} | {mib[1]} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
