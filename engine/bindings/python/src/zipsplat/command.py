"""Functions that run the `zipsplat` command: COLMAP cameras, evaluation, HTML viewer."""

from __future__ import annotations

import html
import json
import os
import shutil
import subprocess
import sysconfig
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Optional

from ._native import warned
from .errors import CommandError

if TYPE_CHECKING:
    from .cameras import Capture, PathLike
    from .images import ImagesLike


def estimate_cameras(
    photos: ImagesLike,
    output: Optional[PathLike] = None,
    *,
    views: Optional[int] = None,
    python: Optional[PathLike] = None,
) -> Capture:
    """Estimates cameras by `zipsplat cameras` and COLMAP.

    Args:
        photos: A folder, a video, or paths of photos.
        output: Path of the transforms.json, with points.ply beside it; None for a temporary one.
        views: Limit of photos, evenly spaced.
        python: A Python with pycolmap, if COLMAP is missing.

    Raises:
        CommandError: the command or COLMAP is missing or fails.
    """
    from .cameras import Capture
    from .images import paths_of

    folder = None
    if output is None:
        folder = tempfile.TemporaryDirectory(prefix="zipsplat-")
        output = Path(folder.name) / "transforms.json"
    arguments = ["cameras", *(os.path.abspath(path) for path in paths_of(photos)), "-o", os.fspath(output)]
    arguments += [] if views is None else ["--views", str(views)]
    arguments += [] if python is None else ["--python", os.fspath(python)]
    run(arguments)
    capture = Capture.open(output)
    # The scene scale is computed from its points.
    capture._keeps = folder
    return capture


@dataclass(frozen=True)
class Evaluation:
    """Quality of the predictions of held-out photos.

    Attributes:
        psnr: Mean PSNR in dB over the held-out photos.
        ssim: Mean SSIM.
        nearest_psnr: Mean PSNR of the nearest input photo as a baseline.
        report: Full output of `zipsplat eval --json`.
    """

    psnr: float
    ssim: float
    nearest_psnr: float
    report: dict[str, Any]


def evaluate(folder: PathLike, *, views: int = 8, refine: int = 0, options: tuple[str, ...] = ()) -> Evaluation:
    """Evaluates a reconstruction of a capture on held-out photos, by `zipsplat eval`.

    Args:
        folder: Photos and their cameras: a transforms.json or a COLMAP model.
        views: Number of photos to reconstruct from.
        refine: Refinement steps before the evaluation.
        options: More options of the command, such as ("--ratio", "0.5").

    Raises:
        CommandError: the command is missing or fails.
    """
    arguments = ["eval", os.fspath(folder), "--views", str(views), *options]
    arguments += ["--refine", str(refine)] if refine else []
    report = run(arguments)
    mean = report["mean"]
    return Evaluation(mean["psnr"], mean["ssim"], mean["nearest_psnr"], report)


@dataclass(frozen=True)
class ModelInfo:
    """Named weights of a network.

    Attributes:
        name: Name for Model.load or, of depth networks (da3...), DepthModel.load.
        path: Path in the cache folder; None if built in or not downloaded.
        bytes: Size of the file or of its download.
        license: License of the weights.
        description: Network and authors.
    """

    name: str
    path: Optional[Path]
    bytes: int
    license: str
    description: str


def list_models() -> list[ModelInfo]:
    """Lists named weights, by `zipsplat weights list`; `zipsplat weights get NAME` downloads them.

    Raises:
        CommandError: the command is missing or fails.
    """
    return [
        ModelInfo(
            row["name"],
            None if row["path"] is None else Path(row["path"]),
            row["bytes"],
            row["license"],
            row["what"],
        )
        for row in run(["weights", "list"])
    ]


class Page:
    """A self-contained HTML viewer; notebooks show it in a frame."""

    def __init__(self, text: str, height: int) -> None:
        self.text, self.height = text, height

    def save(self, path: PathLike) -> None:
        """Writes the page."""
        Path(path).write_text(self.text, encoding="utf-8")

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe srcdoc="{html.escape(self.text)}" style="{style}" allow="fullscreen"></iframe>'

    def __repr__(self) -> str:
        return f"<zipsplat.Page of {len(self.text):,} characters>"


def view(ply: bytes, height: int, cameras: Optional[PathLike]) -> Page:
    """Returns the viewer page of a scene."""
    with tempfile.TemporaryDirectory(prefix="zipsplat-") as folder:
        scene, page = Path(folder) / "scene.ply", Path(folder) / "scene.html"
        scene.write_bytes(ply)
        poses: list[str] = [] if cameras is None else ["--cameras", os.path.abspath(cameras)]
        run(["view", str(scene), "-o", str(page), *poses])
        return Page(page.read_text(encoding="utf-8"), height)


def run(arguments: list[str]) -> Any:
    """Runs the command and returns its result. Its warnings go to the logger.

    It is ZIPSPLAT_COMMAND, else the wheel's, else one on the PATH.

    Raises:
        CommandError: it is missing or fails, with its message.
    """
    name = os.environ.get("ZIPSPLAT_COMMAND", "zipsplat")
    program = shutil.which(name, path=os.pathsep.join([sysconfig.get_path("scripts"), os.environ.get("PATH", "")]))
    if program is None:
        raise CommandError(
            f"command zipsplat: found no program {name}, expected it beside the interpreter, on the PATH, "
            "or as ZIPSPLAT_COMMAND, such as tools/zipsplat of a checkout"
        )
    done = subprocess.run([program, "--json", "--quiet", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise CommandError(_message(done.stderr) or f"zipsplat {arguments[0]} ended with {done.returncode}")
    report = json.loads(done.stdout)
    warned(report["warnings"])
    return report["result"]


def _message(stderr: str) -> str:
    for line in reversed(stderr.splitlines()):
        try:
            return str(json.loads(line)["error"])
        except (ValueError, KeyError, TypeError):
            continue
    return stderr.strip()
