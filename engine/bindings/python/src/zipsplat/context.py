"""Vulkan devices."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any, Optional, Union

from ._native import Handle, call, ffi, lib, options, structure, text


@dataclass(frozen=True)
class Device:
    """What a Vulkan device is.

    Attributes:
        index: Its number, as Context takes it.
        name: Its name.
        driver: The driver's name and version.
        kind: "discrete", a graphics card; "cpu", the processor by way of lavapipe; or "other".
        memory_bytes: Bytes of the memory that kernels work in.
        usable: Whether the engine can use it.
        missing: Why it is not usable; "" where it is.
        uuid: Its UUID, 32 hexadecimal digits: those that CUDA and nvidia-smi have for it.
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
    """The Vulkan devices of this machine, usable or not.

    Raises:
        NoDeviceError: there is no Vulkan loader or no driver.
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
    """A Vulkan device at work. Any number of threads may use it at the same time.

    Args:
        device: A device's number, a part of its name, or its UUID; None for the best.
        max_memory_bytes: Most bytes of the device's memory to use; None for all that there is.
        validation: Whether to run under the Khronos validation layer, for development; None where the environment says so.

    Raises:
        NoDeviceError: no device can be used, or none is called so.
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
        """The device that it is on."""
        info = structure("device_info")
        call("zs_context_get_info", self._handle.pointer, info)
        return _device(info)

    def __repr__(self) -> str:
        return f"<zipsplat.Context on {self.device.name}>"


_lock = threading.Lock()
_default: Optional[Context] = None


def default_context() -> Context:
    """The context on the best device that everything shares which is given no other."""
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
