"""Captures on a local cluster of two one-core nodes, whose workers, nodes and driver are killed
midway."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest
import zipsplat

pytest.importorskip("ray")
from zipsplat.ray import Options, Store, Worker, captures, run  # noqa: E402

SIZE = (126, 126)


@pytest.fixture()
def places(tmp_path: Path) -> Path:
    """Creates a folder of captures of three photos each."""
    rng = np.random.default_rng(1)
    for name in range(8):
        folder = tmp_path / "places" / str(name)
        folder.mkdir(parents=True)
        for photo in range(3):
            small = rng.integers(0, 255, (9, 12, 3), dtype=np.uint8)
            zipsplat.save_image(folder / f"{photo}.png", np.kron(small, np.ones((16, 16, 1), np.uint8)))
    return tmp_path / "places"


def names(out: Path) -> list[str]:
    return sorted(path.stem for path in out.glob("*.json") if path.stem != "report")


def wait(until: Callable[[], bool], seconds: float = 240) -> None:
    last = time.time() + seconds
    while not until():
        assert time.time() < last, "it takes too long"
        time.sleep(0.05)


def test_captures_finish_once_despite_killed_processes(places: Path, tmp_path: Path) -> None:
    from ray.cluster_utils import Cluster

    out = tmp_path / "out"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        node = cluster.add_node(num_cpus=1)
        program = [
            sys.executable,
            "-m",
            "zipsplat.ray",
            places,
            "-o",
            out,
            "--address",
            cluster.address,
            "--input-size",
            "126x126",
        ]
        log = (tmp_path / "log").open("w")

        def start() -> subprocess.Popen[Any]:
            return subprocess.Popen([str(word) for word in program], stdout=log, stderr=log)

        driver = start()
        wait(lambda: len(names(out)) >= 1 or driver.poll() is not None)
        assert driver.poll() is None, (tmp_path / "log").read_text()
        worker = json.loads((out / f"{names(out)[0]}.json").read_text())["process"]
        os.kill(worker, signal.SIGKILL)
        wait(lambda: len(names(out)) >= 3)
        cluster.remove_node(node, allow_graceful=False)
        wait(lambda: len(names(out)) >= 4)
        driver.kill()
        driver.wait()
        before = {name: (out / f"{name}.ply").stat().st_mtime_ns for name in names(out)}
        cluster.add_node(num_cpus=1)
        again = start()
        assert again.wait(300) == 0, (tmp_path / "log").read_text()
    finally:
        cluster.shutdown()
    assert names(out) == [str(name) for name in range(8)]
    # A worker may have outlived its driver.
    assert all((out / f"{name}.ply").stat().st_mtime_ns == when for name, when in before.items()), (
        "nothing is made twice"
    )
    report = json.loads((out / "report.json").read_text())
    assert report["captures"] == 8 and report["failed"] == 0 and report["skipped"] >= len(before)
    assert not list(out.glob("*.unfinished")) and not (out / "failures.csv").exists()
    model = zipsplat.Model.load()
    for name in range(8):
        assert (out / f"{name}.ply").read_bytes() == model.reconstruct(places / str(name), input_size=SIZE).to_bytes(
            "ply"
        )


def worker(out: Path, tries: int = 3) -> Worker:
    return Worker(str(out), Options(input_size=SIZE), tries)


def test_failing_captures_are_rows_and_tries_are_limited(places: Path, tmp_path: Path) -> None:
    (places / "3" / "1.png").write_bytes(b"no picture")
    rows = {row.name: row for row in captures([str(places)], Options(input_size=SIZE))}
    assert sorted(rows) == [str(name) for name in range(8)]
    one = worker(tmp_path / "out")
    # Failures of living workers do not count.
    for _ in range(4):
        assert "PNG" in one.one(rows["3"])["error"]
    # Workers may die up to the limit.
    for tries in (1, 2, 3):
        one.store.try_again(rows["5"], tries)
    assert "3 attempts" in one.one(rows["5"])["error"] and not (tmp_path / "out" / "5.ply").exists()
    assert one.one(rows["4"])["gaussians"] > 0
    made = (tmp_path / "out" / "4.ply").stat().st_mtime_ns
    assert one.one(rows["4"])["hash"] == rows["4"].hash and (tmp_path / "out" / "4.ply").stat().st_mtime_ns == made
    # Another hash runs and counts the capture again.
    zipsplat.save_image(places / "5" / "1.png", np.zeros((20, 20, 3), np.uint8))
    again = {row.name: row for row in captures([str(places)], Options(input_size=SIZE))}
    assert again["5"].hash != rows["5"].hash and one.one(again["5"])["gaussians"] > 0
    assert captures([str(places)], Options(ratio=0.5))[0].hash != rows["0"].hash


def test_inputs_and_outputs_use_fsspec(places: Path) -> None:
    import fsspec

    memory = fsspec.filesystem("memory")
    for photo in (places / "1").iterdir():
        memory.pipe_file(f"/in/1/{photo.name}", photo.read_bytes())
    [row] = captures(["memory://in"], Options(input_size=SIZE))
    one = Worker("memory://out", Options(input_size=SIZE), 3)
    assert one.one(row)["photos"] == 3
    data = memory.cat_file("/out/1.ply")
    assert data == zipsplat.Model.load().reconstruct(places / "1", input_size=SIZE).to_bytes("ply")
    record = Store("memory://out").record(row)
    assert record is not None and record["bytes"] == len(data)


def test_captures_and_scenes_use_an_object_store(places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    import fsspec
    from ray.cluster_utils import Cluster

    server.start()
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://{}:{}".format(*server.get_host_and_port()))
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "nobody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "nothing")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    for proxy in ("http_proxy", "HTTP_PROXY"):
        monkeypatch.delenv(proxy, raising=False)
    store = fsspec.filesystem("s3", skip_instance_cache=True, use_listings_cache=False)
    store.mkdir("captures")
    for place in places.iterdir():
        for photo in place.iterdir():
            store.pipe_file(f"captures/places/{place.name}/{photo.name}", photo.read_bytes())
    store.pipe_file("captures/places/2/1.png", b"no picture")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})

    def start() -> subprocess.Popen[Any]:
        program = [sys.executable, "-m", "zipsplat.ray", "s3://captures/places", "-o", "s3://captures/out"]
        log = (tmp_path / "log").open("a")
        return subprocess.Popen(
            [*program, "--address", cluster.address, "--input-size", "126x126"], stdout=log, stderr=log
        )

    def scenes() -> dict[str, str]:
        listed = store.ls("captures/out", detail=True) if store.exists("captures/out") else []
        return {Path(file["name"]).stem: file["LastModified"] for file in listed if file["name"].endswith(".ply")}

    try:
        driver = start()
        wait(lambda: len(scenes()) >= 2 or driver.poll() is not None)
        record = next(name for name in scenes() if store.exists(f"captures/out/{name}.json"))
        os.kill(json.loads(store.cat_file(f"captures/out/{record}.json"))["process"], signal.SIGKILL)
        assert driver.wait(300) == 1, (tmp_path / "log").read_text()
        first = scenes()
        assert sorted(first) == [str(name) for name in range(8) if name != 2]
        assert b"PNG" in store.cat_file("captures/out/failures.csv")
        store.pipe_file("captures/places/2/1.png", (places / "2" / "1.png").read_bytes())
        assert start().wait(300) == 0, (tmp_path / "log").read_text()
    finally:
        cluster.shutdown()
    second = scenes()
    assert {name: second[name] for name in first} == first and len(second) == 8, "what is finished stays as it is"
    report = json.loads(store.cat_file("captures/out/report.json"))
    assert report["reconstructed"] == 1 and report["skipped"] == 7 and report["failed"] == 0
    model = zipsplat.Model.load()
    for name in second:
        expected = model.reconstruct(places / name, input_size=SIZE).to_bytes("ply")
        assert store.cat_file(f"captures/out/{name}.ply") == expected
    server.stop()


def test_invalid_inputs_raise(places: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(ValueError, match="found no photos"):
        captures([str(empty)], Options())
    (places / "1").rename(places / "report")
    with pytest.raises(ValueError, match="a capture called report"):
        captures([str(places)], Options())
    (places / "report").rename(places / "1")
    with pytest.raises(ValueError, match="second capture called 1"):
        run([str(places), str(places / "1")], str(tmp_path / "out"))
