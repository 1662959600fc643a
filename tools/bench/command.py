"""Runs zipsplat: the command line in $ZIPSPLAT, by default the checkout's script."""

import hashlib
import json
import os
import shlex
import subprocess
import time
from pathlib import Path

COMMAND = shlex.split(os.environ.get("ZIPSPLAT", "")) or [str(Path(__file__).parent.parent / "zipsplat")]


def zipsplat(*words):
    """Returns a command's JSON result. RuntimeError has its error message."""
    run = subprocess.run([*COMMAND, *map(str, words), "--json"], capture_output=True, text=True, check=False)
    if run.returncode:
        line = run.stderr.strip().splitlines()[-1]
        raise RuntimeError(json.loads(line)["error"] if line.startswith("{") else line)
    return json.loads(run.stdout)["result"]


def digest(*settings):
    """Names a run's folder by its settings."""
    return hashlib.sha256(repr(settings).encode()).hexdigest()[:8]


def timed(work, *words):
    """Returns the result of a function that runs commands, their seconds and CPU seconds."""
    began, before = time.monotonic(), os.times()
    result = work(*words)
    return result, time.monotonic() - began, sum(os.times()[2:4]) - sum(before[2:4])
