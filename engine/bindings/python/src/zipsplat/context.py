"""Vulkan devices."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any, Optional, Union

from ._native import Handle, call, ffi, lib, options, structure, text


@dataclass(frozen=True)
class Device:
    """Description of a Vulkan device.

    Attributes:
        index: Device number for Context.
        name: Device name.
        driver: Driver name and version.
        kind: "discrete", "cpu" (lavapipe) or "other".
        memory_bytes: Bytes of device-local memory.
        usable: Whether the engine can use the device.
        missing: Missing requirements; "" if usable.
        uuid: Device UUID as 32 hexadecimal digits, as in CUDA and nvidia-smi.
    """

    index: int
    name: str
    driver: str
    kind: str
    memory_bytes: int
    usable: bool
    missing: str
    uuid: str


def devices() -> list[Device]:
    """Lists the Vulkan devices, usable or not.

    Raises:
        NoDeviceError: there is no Vulkan loader or driver.
    """
    count = ffi.new("uint32_t *")
    call("zs_device_count", count)
    found = []
    for index in range(count[0]):
        info = structure("device_info")
        call("zs_device_get", index, info)
        found.append(_device(info))
    return found


class Context:
    """An open Vulkan device. Threads can share it.

    Args:
        device: Device number, part of its name, or UUID; None selects the best.
        max_memory_bytes: Device memory budget; None is unlimited.
        validation: Enables the Khronos validation layer; None follows the environment.

    Raises:
        NoDeviceError: no usable device matches.
    """

    def __init__(
        self,
        device: Union[int, str, None] = None,
        *,
        max_memory_bytes: Optional[int] = None,
        validation: Optional[bool] = None,
    ) -> None:
        name = ffi.NULL if device is None else ffi.new("char[]", str(device).encode())
        made = options("context", device=name, max_memory_bytes=max_memory_bytes or 0)
        if validation is not None:
            made.validation = int(validation)
        self._handle = Handle("context", "zs_context_create", made)

    @property
    def device(self) -> Device:
        """Description of the context's device."""
        info = structure("device_info")
        call("zs_context_get_info", self._handle.pointer, info)
        return _device(info)

    def __repr__(self) -> str:
        return f"<zipsplat.Context on {self.device.name}>"


_lock = threading.Lock()
_default: Optional[Context] = None


def default_context() -> Context:
    """Returns the shared context on the best device."""
    global _default
    with _lock:
        if _default is None:
            _default = Context()
        return _default


def _device(info: Any) -> Device:
    return Device(
        index=info.index,
        name=text(info.name),
        driver=text(info.driver),
        kind={lib.ZS_DEVICE_DISCRETE: "discrete", lib.ZS_DEVICE_CPU: "cpu"}.get(info.kind, "other"),
        memory_bytes=info.memory_bytes,
        usable=bool(info.usable),
        missing=text(info.missing),
        uuid=text(info.uuid),
    )
