"""Results of refinements."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ._native import lib
from .cameras import Cameras, from_native

StopReason = Literal["finished", "stopped", "diverged", "unsaved"]
_STOP_REASONS: dict[int, StopReason] = {
    lib.ZS_STOP_REASON_FINISHED: "finished",
    lib.ZS_STOP_REASON_STOPPED: "stopped",
    lib.ZS_STOP_REASON_DIVERGED: "diverged",
    lib.ZS_STOP_REASON_UNSAVED: "unsaved",
}


@dataclass(frozen=True)
class RefineResult:
    """Result of a refinement.

    Attributes:
        stop_reason: "finished", "stopped" by the progress function, "diverged", or
            "unsaved" if a checkpoint could not be written or a step's memory allocated.
        steps: Completed steps.
        best_step: Step of the returned scene; 0 if none improved it.
        initial_loss: Mean loss over the first step's photos; NaN without a step.
        final_loss: Mean loss over the last step's photos; NaN without a step.
        initial_psnr: PSNR in dB of the held-out photos before the first step; NaN without any.
        best_psnr: The same with the returned scene.
        seconds: Duration in seconds.
        initial_training_psnr: Mean PSNR in dB of up to 16 full-size training photos before the
            first step.
        best_training_psnr: The same with the returned scene.
        cameras: Cameras of all photos, as optimized.
        exposures: [photos, 3, 4] float32 matrix and offset from the scene's colors to each photo's;
            the identity unless learned.
    """

    stop_reason: StopReason
    steps: int
    best_step: int
    initial_loss: float
    final_loss: float
    initial_psnr: float
    best_psnr: float
    seconds: float
    initial_training_psnr: float
    best_training_psnr: float
    cameras: Cameras
    exposures: npt.NDArray[np.float32] = field(compare=False)


def refine_result(info: Any, cameras: Any, exposures: npt.NDArray[np.float32]) -> RefineResult:
    """Converts a result, cameras and exposures of the library."""
    return RefineResult(
        stop_reason=_STOP_REASONS[info.stop_reason],
        steps=info.steps,
        best_step=info.best_step,
        initial_loss=info.initial_loss,
        final_loss=info.final_loss,
        initial_psnr=info.initial_psnr,
        best_psnr=info.best_psnr,
        seconds=info.seconds,
        initial_training_psnr=info.initial_training_psnr,
        best_training_psnr=info.best_training_psnr,
        cameras=Cameras(map(from_native, cameras)),
        exposures=exposures,
    )
