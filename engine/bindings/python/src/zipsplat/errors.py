"""Failures of the library, an exception for each status of the C interface."""

from __future__ import annotations


class Error(Exception):
    """A call of the library failed.

    Attributes:
        status: The number of the C interface's zs_status.
        name: Its name, such as "ZS_ERROR_ARGUMENT".
    """

    status: int = 0
    name: str = ""


class ArgumentError(Error, ValueError):
    """A value cannot be used; the message names it, what was found and what is expected."""


class IoError(Error, OSError):
    """A file could not be opened, read or written."""


class FormatError(Error, ValueError):
    """A file's or buffer's bytes are not what its format allows."""


class WeightsError(Error, ValueError):
    """A checkpoint's tensors are not those of its network."""


class NoDeviceError(Error, RuntimeError):
    """There is no Vulkan loader, no driver, or none whose device can run this."""


class OutOfMemoryError(Error, MemoryError):
    """The device or the host has too little memory; nothing was submitted."""


class DriverError(Error, RuntimeError):
    """The driver refused a call that should have worked."""


class DeviceLostError(Error, RuntimeError):
    """The device was reset or removed: make a new Context. Scenes survive."""


class CancelledError(Error):
    """The progress function asked to stop."""


class UnsupportedError(Error, NotImplementedError):
    """This build of the library does not have it."""


class InternalError(Error, RuntimeError):
    """A bug of the library."""


class ForkError(RuntimeError):
    """The process was forked after the library had been used: a device does not survive that."""


class CommandError(RuntimeError):
    """The command `zipsplat` failed, or is not installed."""


# In the order of zs_status.
BY_STATUS: tuple[type[Error], ...] = (
    Error,
    ArgumentError,
    IoError,
    FormatError,
    WeightsError,
    NoDeviceError,
    OutOfMemoryError,
    DriverError,
    DeviceLostError,
    CancelledError,
    UnsupportedError,
    InternalError,
)
