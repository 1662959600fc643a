"""Exceptions: one per status of the C interface, and those of the package."""

from __future__ import annotations


class Error(Exception):
    """A failure in zipsplat: the base class of all its exceptions.

    Attributes:
        status: Value of the zs_status; 0 if the library was not called.
        name: Name of the status, such as "ZS_ERROR_ARGUMENT"; "" if the library was not called.
    """

    status: int = 0
    name: str = ""


class ArgumentError(Error, ValueError):
    """An invalid argument; the message names it, the value found and the value expected."""


class ArgumentTypeError(ArgumentError, TypeError):
    """An argument of the wrong type."""


class FileError(Error, OSError):
    """A file could not be opened, read or written."""


class FormatError(Error, ValueError):
    """A file or buffer violates its format."""


class WeightsError(Error, ValueError):
    """A checkpoint's tensors do not match its network."""


class NoDeviceError(Error, RuntimeError):
    """No Vulkan loader, driver or suitable device."""


class OutOfMemoryError(Error, MemoryError):
    """Too little device or host memory; nothing was submitted."""


class DriverError(Error, RuntimeError):
    """The driver reported an error."""


class DeviceLostError(Error, RuntimeError):
    """The device was reset or removed: create a new Device. Scenes survive."""


class CancelledError(Error):
    """The progress function canceled."""


class UnsupportedError(Error, NotImplementedError):
    """Not available in this build of the library."""


class InternalError(Error, RuntimeError):
    """A bug in the library."""


class ForkError(Error, RuntimeError):
    """The process was forked after using the library; devices do not survive a fork."""


class CommandError(Error, RuntimeError):
    """The `zipsplat` command is missing or failed."""


# In the order of zs_status.
BY_STATUS: tuple[type[Error], ...] = (
    Error,
    ArgumentError,
    FileError,
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
