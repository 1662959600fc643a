"""Runs zipsplat: the command line in $ZIPSPLAT, by default the checkout's script."""

import json
import os
import resource
import shlex
import subprocess
from pathlib import Path

COMMAND = shlex.split(os.environ.get("ZIPSPLAT", "")) or [str(Path(__file__).parent.parent / "zipsplat")]


def zipsplat(*words):
    """Returns a command's JSON result. RuntimeError has its error message."""
    run = subprocess.run([*COMMAND, *map(str, words), "--json"], capture_output=True, text=True, check=False)
    if run.returncode:
        line = run.stderr.strip().splitlines()[-1]
        raise RuntimeError(json.loads(line)["error"] if line.startswith("{") else line)
    return json.loads(run.stdout)["result"]


def timed(*words):
    """Returns a command's JSON result and its CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    said = zipsplat(*words)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return said, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
