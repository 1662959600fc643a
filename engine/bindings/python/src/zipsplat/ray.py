"""Reconstructs many captures on a cluster with Ray Data: one actor and model per device.

usage: python -m zipsplat.ray INPUTS... -o OUT [--address ADDRESS] [--actors N] [--tries K]
                              [--ratio R] [--format ply]

INPUTS are photo folders, or folders of them; they and OUT may be on any fsspec file system. Each
capture becomes OUT/NAME.FORMAT and a record OUT/NAME.json. Run the command again to resume: a
capture is finished if its record matches the hash of its photos' names, sizes and times and of the
options. Failed captures, and those whose worker died K times, are rows of OUT/failures.csv.
OUT/report.json has throughput and time shares.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import os
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any, Iterator, Literal, Optional, Union, get_args

import fsspec

from .errors import ArgumentError
from .scene import Format

EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp")
REPORT = "report"


@dataclass(frozen=True)
class Options:
    """Options that determine a scene."""

    ratio: Union[float, Literal["auto"]] = 1.0
    weights: str = "builtin"
    input_size: Optional[tuple[int, int]] = None
    format: Format = "ply"


@dataclass(frozen=True)
class Row:
    """A capture: its name, photo folder, and input hash."""

    name: str
    photos: list[str]
    hash: str


def captures(inputs: list[str], options: Options) -> list[Row]:
    """Finds captures in folders and names them uniquely.

    Raises:
        ArgumentError: an input has none, or a name is taken.
    """
    found: dict[str, Row] = {}
    for place in inputs:
        system, root = fsspec.core.url_to_fs(place)
        rows = list(_captures(system, root, options))
        if not rows:
            raise ArgumentError(f"{place}: found no photos, expected a folder of photos, or a folder of such folders")
        for row in rows:
            if row.name == REPORT:
                raise ArgumentError(
                    f"{place}: found a capture called {REPORT}, expected another name than the report's"
                )
            if row.name in found:
                raise ArgumentError(
                    f"{place}: found a second capture called {row.name}, expected a name of its own for each"
                )
            found[row.name] = row
    return list(found.values())


def _captures(system: Any, root: str, options: Options) -> Iterator[Row]:
    entries = system.ls(root, detail=True)
    if any(_is_photo(entry) for entry in entries):
        yield _row(system, root, entries, options)
        return
    for entry in sorted(entries, key=lambda entry: str(entry["name"])):
        if entry["type"] == "directory":
            below = system.ls(entry["name"], detail=True)
            if any(_is_photo(file) for file in below):
                yield _row(system, entry["name"], below, options)


def _is_photo(entry: dict[str, Any]) -> bool:
    name = entry["name"].rsplit("/", 1)[-1]
    return entry["type"] == "file" and not name.startswith(".") and name.lower().endswith(EXTENSIONS)


def _row(system: Any, root: str, entries: list[dict[str, Any]], options: Options) -> Row:
    from .images import _natural

    photos = sorted((entry for entry in entries if _is_photo(entry)), key=lambda entry: _natural(entry["name"]))
    hashed = hashlib.sha256(json.dumps(asdict(options), sort_keys=True).encode())
    for photo in photos:
        when = photo.get("mtime") or photo.get("ETag") or photo.get("LastModified") or photo.get("created") or ""
        hashed.update(f"{photo['name']} {photo['size']} {when}\n".encode())
    name = root.rstrip("/").rsplit("/", 1)[-1]
    return Row(name, [system.unstrip_protocol(photo["name"]) for photo in photos], hashed.hexdigest())


class Store:
    """Storage of scenes and records. Files are written atomically, by rename or a single put."""

    def __init__(self, out: str) -> None:
        self.system, self.root = fsspec.core.url_to_fs(out)
        self.local = "file" in self.system.protocol or self.system.protocol == "file"
        if self.local:
            self.system.makedirs(self.root, exist_ok=True)

    def path(self, name: str) -> str:
        return f"{self.root.rstrip('/')}/{name}"

    def read(self, name: str) -> Optional[bytes]:
        """Returns a file's contents; None if it does not exist."""
        try:
            return bytes(self.system.cat_file(self.path(name)))
        except FileNotFoundError:
            return None

    def write(self, name: str, data: bytes) -> None:
        path = self.path(name)
        if not self.local:
            self.system.pipe_file(path, data)
            return
        beside = f"{path}.{os.getpid()}.unfinished"
        with open(beside, "wb") as file:
            file.write(data)
        os.replace(beside, path)

    def record(self, row: Row) -> Optional[dict[str, Any]]:
        """Returns the record of a finished capture; None if unfinished or outdated."""
        data = self.read(f"{row.name}.json")
        record: dict[str, Any] = json.loads(data) if data else {}
        return record if record.get("hash") == row.hash else None

    def tries(self, row: Row) -> int:
        """Returns the number of started but unfinished attempts."""
        return len(self.read(f".tries/{row.name}.{row.hash[:16]}") or b"")

    def try_again(self, row: Row, tries: int) -> None:
        """Records the start of an attempt."""
        if self.local:
            self.system.makedirs(self.path(".tries"), exist_ok=True)
        self.write(f".tries/{row.name}.{row.hash[:16]}", b"x" * tries)


class Worker:
    """An actor: a model on its device, reused across captures."""

    def __init__(self, out: str, options: Options, tries: int) -> None:
        import zipsplat

        self.store, self.options, self.tries = Store(out), options, tries
        began = time.time()
        # Vulkan ignores CUDA_VISIBLE_DEVICES, which assigns a GPU in Ray.
        assigned = os.environ.get("CUDA_VISIBLE_DEVICES")
        self.model = zipsplat.Model.load(options.weights, device="cuda" if assigned else None)
        self.loaded = time.time() - began

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Maps a table row to its result."""
        rows = [Row(**json.loads(row)) for row in batch["row"]]
        return {"result": [json.dumps(self.one(row)) for row in rows]}

    def one(self, row: Row) -> dict[str, Any]:
        """Reconstructs a capture, unless finished or tried too often."""
        record = self.store.record(row)
        if record is not None:
            return record
        tries = self.store.tries(row)
        if tries >= self.tries:
            return {"name": row.name, "error": f"skipped: {tries} attempts ended with their worker"}
        self.store.try_again(row, tries + 1)
        try:
            return self._make(row)
        except Exception as error:  # noqa: BLE001 A failed capture must not end the run.
            self.store.try_again(row, tries)  # The worker lives.
            return {"name": row.name, "error": f"{type(error).__name__}: {error}"}

    def _make(self, row: Row) -> dict[str, Any]:
        times = {"model": self.loaded}
        self.loaded, began = 0.0, time.time()
        files = [bytes(file.read()) for file in _open_all(row.photos)]
        times["read"] = time.time() - began
        began = time.time()
        scene = self.model.reconstruct(files, ratio=self.options.ratio, input_size=self.options.input_size)
        times["reconstruct"] = time.time() - began
        began = time.time()
        data = scene.to_bytes(self.options.format)
        self.store.write(f"{row.name}.{self.options.format}", data)
        times["write"] = time.time() - began
        record = {
            "name": row.name,
            "hash": row.hash,
            "bytes": len(data),
            "gaussians": len(scene),
            "photos": len(row.photos),
        }
        record.update(seconds=times, read_bytes=sum(map(len, files)), node=os.uname().nodename, process=os.getpid())
        self.store.write(f"{row.name}.json", json.dumps(record).encode())
        return record


def _open_all(paths: list[str]) -> Iterator[Any]:
    for path in paths:
        with fsspec.open(path, "rb") as file:
            yield file


def run(
    inputs: list[str],
    out: str,
    *,
    options: Options = Options(),
    address: Optional[str] = None,
    actors: Optional[int] = None,
    tries: int = 3,
) -> dict[str, Any]:
    """Reconstructs all captures and returns the report.

    Args:
        inputs: Photo folders, or folders of them, on any fsspec file system.
        out: Output folder on any fsspec file system.
        options: Options that determine a scene.
        address: Address of a cluster; None for a local one.
        actors: Limit of actors; None for one per GPU, or per core without GPUs.
        tries: Limit of attempts per capture.
    """
    import ray.data

    import ray

    rows = captures(inputs, options)
    store, began = Store(out), time.time()
    done = [record for row in rows if (record := store.record(row)) is not None]
    names = {record["name"] for record in done}
    todo = [row for row in rows if row.name not in names]
    results: list[dict[str, Any]] = []
    if todo:
        if not ray.is_initialized():
            ray.init(address=address, log_to_driver=False)
        resources = ray.cluster_resources()
        gpus = int(resources.get("GPU", 0))
        most = max(1, min(actors or gpus or int(resources.get("CPU", 1)), len(todo)))
        table = ray.data.from_items([{"row": json.dumps(asdict(row))} for row in todo], override_num_blocks=len(todo))
        work = table.map_batches(
            Worker,
            fn_constructor_args=(out, options, tries),
            batch_size=1,
            compute=ray.data.ActorPoolStrategy(min_size=1, max_size=most),
            num_gpus=1 if gpus else None,
            num_cpus=None if gpus else 1,
        )
        results = [json.loads(row["result"]) for row in work.iter_rows()]
    report = _report(rows, done, results, time.time() - began)
    failures = [result for result in results if "error" in result]
    _write_failures(store, failures)
    store.write(f"{REPORT}.json", json.dumps(report, indent=2).encode())
    return report


def _report(
    rows: list[Row], done: list[dict[str, Any]], results: list[dict[str, Any]], seconds: float
) -> dict[str, Any]:
    made = [result for result in results if "error" not in result]
    steps: dict[str, float] = {}
    for result in made:
        for step, took in result["seconds"].items():
            steps[step] = steps.get(step, 0.0) + took
    total = sum(steps.values()) or 1.0
    return {
        "captures": len(rows),
        "reconstructed": len(made),
        "skipped": len(done),
        "failed": len(results) - len(made),
        "seconds": seconds,
        "captures_per_second": len(made) / seconds if seconds else 0.0,
        "share_of_time": {step: took / total for step, took in steps.items()},
        "bytes_read": sum(result["read_bytes"] for result in made),
        "bytes_written": sum(result["bytes"] for result in made),
    }


def _write_failures(store: Store, failures: list[dict[str, Any]]) -> None:
    if not failures and store.read("failures.csv") is None:
        return
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(["capture", "error"])
    table.writerows([failure["name"], failure["error"]] for failure in failures)
    store.write("failures.csv", text.getvalue().encode())


def _ratio(text: str) -> Union[float, Literal["auto"]]:
    return "auto" if text == "auto" else float(text)


def main(arguments: Optional[list[str]] = None) -> int:
    """Runs the command line; returns 1 if captures failed."""
    parser = argparse.ArgumentParser(prog="python -m zipsplat.ray", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("inputs", nargs="+", help="folders of photos, or folders of such folders")
    parser.add_argument("-o", "--output", required=True, help="output folder of scenes and records")
    parser.add_argument("--address", help="address of a cluster; default: a local one")
    parser.add_argument("--actors", type=int, help="limit of actors; default: one per GPU, or per core without GPUs")
    parser.add_argument("--tries", type=int, default=3, help="limit of attempts per capture")
    parser.add_argument("--ratio", type=_ratio, default=1.0, help="fraction of tokens that become Gaussians, or auto")
    parser.add_argument("--weights", default="builtin", help="name or path of weights, on every node")
    parser.add_argument("--input-size", help="WIDTHxHEIGHT of the network's input")
    parser.add_argument("--format", default="ply", choices=get_args(Format))
    given = parser.parse_args(arguments)
    width, _, height = (given.input_size or "").partition("x")
    size = (int(width), int(height)) if given.input_size else None
    options = Options(given.ratio, given.weights, size, given.format)
    report = run(
        given.inputs, given.output, options=options, address=given.address, actors=given.actors, tries=given.tries
    )
    print(json.dumps(report, indent=2))
    return 1 if report["failed"] else 0


if __name__ == "__main__":
    # Ray pickles by module name, which must not be __main__.
    from zipsplat.ray import main as _main

    sys.exit(_main())
