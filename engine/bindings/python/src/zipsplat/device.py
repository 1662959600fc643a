"""Vulkan devices."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from dataclasses import dataclass
from typing import Any, Literal, Optional, Protocol, Union

from ._native import Handle, Owner, call, ffi, lib, on_device_lost, structure, text
from .cameras import PathLike
from .errors import NoDeviceError

DeviceKind = Literal["discrete", "integrated", "cpu", "other"]
_KINDS: dict[int, DeviceKind] = {
    lib.ZS_DEVICE_DISCRETE: "discrete",
    lib.ZS_DEVICE_INTEGRATED: "integrated",
    lib.ZS_DEVICE_CPU: "cpu",
}


@dataclass(frozen=True)
class DeviceInfo:
    """Description of a Vulkan device.

    Attributes:
        index: Number of the device.
        name: Name, such as "NVIDIA H100 80GB HBM3".
        driver: Driver name and version.
        kind: "discrete", "integrated", "cpu" (lavapipe) or "other".
        memory_bytes: Bytes of device-local memory.
        usable: Whether the engine can use the device.
        unusable_reason: Missing requirements; "" if usable.
        uuid: UUID as 32 hexadecimal digits, as in CUDA and nvidia-smi.
    """

    index: int
    name: str
    driver: str
    kind: DeviceKind
    memory_bytes: int
    usable: bool
    unusable_reason: str
    uuid: str


def list_devices() -> list[DeviceInfo]:
    """Lists the Vulkan devices, usable or not.

    Raises:
        NoDeviceError: there is no Vulkan loader or driver.
    """
    count = ffi.new("size_t *")
    call("zs_device_count", count)
    found = []
    for index in range(count[0]):
        info = structure("device_info")
        call("zs_device_get", index, info)
        found.append(_info(info))
    return found


class Device(Owner):
    """An open Vulkan device. Threads can share it.

    Args:
        device: "cuda:N" or a torch.device for a GPU by its CUDA number, "cpu" for lavapipe, a
            Vulkan device number, part of a name, or a UUID. None selects the best.
        max_memory_bytes: Device memory budget; None is unlimited.
        cache_dir: Folder of self-test results, kernel timings and LPIPS weights; "" keeps none.
            None is the environment's ZIPSPLAT_CACHE, else "zipsplat" in the user's cache.
        validation: Enables the Khronos validation layer; None follows the environment.

    Raises:
        NoDeviceError: no usable device matches.

    Example:
        >>> with Device("cuda:0", max_memory_bytes=8 << 30) as device:
        ...     scene = Model.load(device=device).reconstruct("photos/")
    """

    def __init__(
        self,
        device: Union[int, str, TorchDevice, None] = None,
        *,
        max_memory_bytes: Optional[int] = None,
        cache_dir: Optional[PathLike] = None,
        validation: Optional[bool] = None,
    ) -> None:
        name = ffi.NULL if device is None else ffi.new("char[]", _selector(str(device)).encode())
        folder = ffi.NULL if cache_dir is None else ffi.new("char[]", os.fsencode(cache_dir))
        options = structure("device_options", device=name, max_memory_bytes=max_memory_bytes or 0, cache_dir=folder)
        if validation is not None:
            options.validation = int(validation)
        super().__init__(Handle("device", "zs_device_create", options))

    @property
    def info(self) -> DeviceInfo:
        """Description of the device."""
        info = structure("device_info")
        call("zs_device_get_info", self._handle, info)
        return _info(info)

    def __repr__(self) -> str:
        return f"<zipsplat.Device {self.info.name}>"


class TorchDevice(Protocol):
    """A torch.device."""

    @property
    def type(self) -> str: ...


# A device, or the argument that opens one, such as "cuda:0".
DeviceLike = Union[Device, int, str, TorchDevice, None]

_lock = threading.Lock()
_open: dict[str, Device] = {}
on_device_lost.append(_open.clear)


def default_device() -> Device:
    """Returns the shared device that calls without `device` use, the best one."""
    return opened(None)


def opened(device: DeviceLike) -> Device:
    """Opens a device. Equal names share one."""
    if isinstance(device, Device):
        return device
    with _lock:
        found = _open.get(str(device))
        if found is None or found._open is None:
            found = _open[str(device)] = Device(device)
        return found


def _selector(device: str) -> str:
    """Returns the library's name of a device: a number, part of a name, or a UUID."""
    kind, _, number = device.partition(":")
    if kind == "cpu":
        found = [info for info in list_devices() if info.kind == "cpu"]
        return str(found[0].index) if found else device
    if kind == "cuda" and (number.isdigit() or not number):
        return _cuda_uuid(int(number or 0))
    return device


def _cuda_uuid(number: int) -> str:
    """Returns the UUID of a CUDA device, numbered as in torch: CUDA_VISIBLE_DEVICES applies."""
    try:
        cuda = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError as error:
        raise NoDeviceError(f"device cuda:{number}: found no CUDA driver, expected one ({error})") from error
    device, uuid = ctypes.c_int(), (ctypes.c_uint8 * 16)()
    for status in (
        cuda.cuInit(0),
        cuda.cuDeviceGet(ctypes.byref(device), number),
        cuda.cuDeviceGetUuid(ctypes.byref(uuid), device),
    ):
        if status:
            visible = os.environ.get("CUDA_VISIBLE_DEVICES", "all")
            raise NoDeviceError(
                f"device cuda:{number}: found CUDA error {status}, expected one of the visible devices ({visible})"
            )
    return bytes(uuid).hex()


def _info(info: Any) -> DeviceInfo:
    return DeviceInfo(
        index=info.index,
        name=text(info.name),
        driver=text(info.driver),
        kind=_KINDS.get(info.kind, "other"),
        memory_bytes=info.memory_bytes,
        usable=bool(info.usable),
        unusable_reason=text(info.unusable_reason),
        uuid=text(info.uuid),
    )
