"""Collects the parts that report.sh wrote to a folder: results.json, and their tables in tables.md.

usage: tables.py FOLDER
"""

import json
import sys
from pathlib import Path


def part(folder, name):
    """Returns a part's result, or the last line of its messages as {"failed": LINE}."""
    if (file := folder / f"{name}.json").exists():
        return json.loads(file.read_text())["result"]
    lines = (folder / f"{name}.log").read_text().strip().splitlines() or ["timeout"]
    return {"failed": lines[-1]}


def table(head, rows):
    lines = [f"| {' | '.join(cells)} |" for cells in [head, ["---"] * len(head), *rows]]
    return "\n".join(lines) if rows else ""


def percent(part):
    return "" if part is None else f"{part:.0%}"


def forward(rows):
    head = ["photos", "kept tokens", "pool", "precision", "time", "work", "share of peak", "memory"]
    cells = []
    for row in rows:
        system = row["stage"]
        if system and not system.startswith("PyTorch"):
            continue
        case = [str(row["views"]), f"{row['tokens']:,}", str(row["pool"]), system or row["precision"]]
        rate = [f"{row['gflop'] / 1000:.3g} TFLOP", percent(row["peak_share"])]
        cells.append([*case, f"{row['ms']['median']:.1f} ms", *rate, f"{row['peak_bytes'] / 2**30:.2f} GiB"])
    return table(head, cells)


def renders(rows):
    rows = [row for row in rows if row["what"] == "device" or row["what"].startswith("gsplat")]
    cells = [
        [row["what"], f"{row['gaussians']:,}", f"{row['width']} x {row['height']}",
         f"{row['ms']['median']:.2f} ms", percent(row["bandwidth_share"])]
        for row in rows
    ]
    return table(["renderer", "Gaussians", "pixels", "time", "share of copy bandwidth"], cells)


def refinement(rows):
    times = {}
    for row in rows:
        times.setdefault((row["gaussians"], row["width"], row["height"]), {})[row["what"]] = row
    cells = [
        [f"{count:,}", *(f"{of[what]['ms']['median']:.2f} ms" for what in ("picture", "step", "host")),
         f"{of['step']['pictures']:.2f}", f"{of['step']['peak_bytes'] / 2**20:.1f} MiB"]
        for (count, _, _), of in times.items()
    ]
    head = ["Gaussians", "picture", "step", "step, as the host sees it", "step / picture", "memory"]
    return table(head, cells)


def main():
    folder = Path(sys.argv[1])
    results = {name: part(folder, name) for name in sorted(log.stem for log in folder.glob("*.log"))}
    done = {name: result for name, result in results.items() if "failed" not in result}
    (folder / "results.json").write_text(json.dumps(results, indent=1))
    joined = lambda prefix: [row for name, rows in done.items() if name.startswith(prefix) for row in rows]  # noqa: E731
    tables = []
    if device := done.get("device"):
        tables.append(", ".join(f"{each['limits']['name']} ({each['limits']['driver']})" for each in device))
    if peak := done.get("peak"):
        tables.append("; ".join(f"{row['what']}: {row['per_s']:.1f} {row['unit']}" for row in peak))
    if doctor := done.get("doctor"):
        tables.append(f"doctor: {len(doctor['findings'])} results, {doctor['outside']} outside their bounds")
    tables += [forward(joined("forward") + joined("pytorch")), renders(joined("render") + joined("gsplat"))]
    tables.append(refinement(joined("refine")))
    tables.append(table(["part", "failed"], [[name, results[name]["failed"]] for name in results if name not in done]))
    (folder / "tables.md").write_text("\n\n".join(filter(None, tables)) + "\n")


main()
