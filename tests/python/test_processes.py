"""Threads, forks and interpreter shutdown."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import zipsplat
from conftest import PHOTOS, SIZE, python, same

START = f"""
import os, signal, sys, threading, time
import zipsplat
photos = zipsplat.list_images({str(PHOTOS)!r})[:3]
"""


def test_threads_share_a_model(model: zipsplat.Model, photos: list[Path], scene: zipsplat.Scene) -> None:
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: model.reconstruct(photos, input_size=SIZE), range(4)))
    assert all(same(other, scene) for other in found)


def test_other_threads_run_during_a_call(model: zipsplat.Model, photos: list[Path]) -> None:
    # Advances only if the GIL is released.
    camera = zipsplat.Camera.from_fov(1600, 1200)
    renderer = zipsplat.Renderer(model.reconstruct(photos, input_size=SIZE))
    renderer.render(camera)
    done, counted = threading.Event(), 0

    def draw() -> None:
        renderer.render(camera)
        done.set()

    thread = threading.Thread(target=draw)
    thread.start()
    while not done.is_set():
        counted += 1
        time.sleep(0.001)
    thread.join()
    assert counted > 3


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_only_forks_after_use_raise() -> None:
    code = (
        START
        + """
def child(work):
    process = os.fork()
    if process == 0:
        try:
            work()
            os._exit(0)
        except zipsplat.ForkError as error:
            print(error, flush=True)
            os._exit(7)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])

def draw():
    camera = zipsplat.Camera.from_fov(32, 32)
    zipsplat.Model.load().reconstruct(photos[:1], input_size=(70, 70)).render(camera)

assert child(draw) == 0
draw()
scene = zipsplat.Model.load().reconstruct(photos[:1], input_size=(70, 70))
total = float(scene.means.sum())
def read():
    global scene
    assert float(scene.means.sum()) == total
    del scene
assert child(read) == 0
assert child(draw) == 7
draw()
"""
    )
    done = python(code)
    assert done.returncode == 0 and "spawn" in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize(
    "work",
    [
        "reconstruct(photos, input_size=(252, 252))",
        "reconstruct(photos, input_size=(252, 252), progress=lambda *_: None)",
    ],
)
def test_the_interpreter_exits_during_a_call(work: str) -> None:
    code = (
        START
        + f"""
model = zipsplat.Model.load()
begun = threading.Event()
def run():
    begun.set()
    model.{work}
threading.Thread(target=run, daemon=True).start()
begun.wait()
time.sleep(0.2)
print("end", flush=True)
"""
    )
    done = python(code)
    assert (done.returncode, done.stdout) == (0, "end\n"), done.stderr
    # The thread may be between two calls.
    last = done.stderr.strip().splitlines()[-1:]
    assert all("CancelledError" in line or "the interpreter ends" in line for line in last), done.stderr


def test_ctrl_c_interrupts_a_call() -> None:
    code = (
        START
        + """
model = zipsplat.Model.load()
threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
try:
    while True:
        model.reconstruct(photos, input_size=(252, 252))
except KeyboardInterrupt:
    print("interrupted")
"""
    )
    done = python(code)
    assert (done.returncode, done.stdout) == (0, "interrupted\n"), done.stderr


def test_the_interpreter_exits_with_live_objects() -> None:
    code = (
        START
        + """
device = zipsplat.Device()
model = zipsplat.Model.load(device=device)
scene = model.reconstruct(photos[:1], input_size=(70, 70))
renderer = zipsplat.Renderer(scene)
del device, model
renderer.render(zipsplat.Camera.from_fov(32, 32))
cycle = [renderer, scene]
cycle.append(cycle)
"""
    )
    done = python(code)
    assert (done.returncode, done.stderr) == (0, "")
