"""Progress of long calls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Callable, Optional

from ._native import calls, ffi, lib, raise_later, text


@dataclass(frozen=True)
class Progress:
    """Progress of a call. Fields from `step` on are those of a refinement, else 0.

    Attributes:
        fraction: Completed fraction, from 0 to 1.
        stage: Name of the current stage.
        step: Completed optimizer steps.
        steps: Total steps.
        loss: Mean loss over the last step's photos.
        psnr: Latest PSNR in dB of the held-out photos; NaN without any.
        eta_seconds: Estimated seconds left.
    """

    fraction: float
    stage: str
    step: int
    steps: int
    loss: float
    psnr: float
    eta_seconds: float


# Returning False stops: a refinement returns its best scene, other calls raise CancelledError.
ProgressFunction = Callable[[Progress], Optional[bool]]


class Callback:
    """A progress function and its fields of options, valid as long as this object."""

    def __init__(self, function: Optional[ProgressFunction]) -> None:
        self.function = function
        self.fields = {"progress": _progress, "user_data": ffi.new_handle(self)}


@ffi.callback(  # type: ignore[untyped-decorator]
    "zs_progress_action(void *, const struct zs_progress *)", error=lib.ZS_CANCEL, onerror=raise_later
)
def _progress(user_data: Any, now: Any) -> int:
    function = ffi.from_handle(user_data).function
    if calls.ending:
        return int(lib.ZS_CANCEL)
    if function is None:
        return int(lib.ZS_CONTINUE)
    state = Progress(now.fraction, text(now.stage), now.step, now.steps, now.loss, now.psnr, now.eta_seconds)
    return int(lib.ZS_STOP if function(state) is False else lib.ZS_CONTINUE)
