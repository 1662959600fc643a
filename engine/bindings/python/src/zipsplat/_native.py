"""The shared library: calls that raise on failure, and owned objects.

cffi releases the GIL during calls.
"""

from __future__ import annotations

import atexit
import logging
import os
import sys
import threading
import weakref
from pathlib import Path
from typing import Any, Callable, Mapping, Optional, TypeVar

import cffi
import numpy as np
import numpy.typing as npt

from . import errors
from ._header import DECLARATIONS

_NAMES = {"darwin": "libzipsplat.dylib", "win32": "zipsplat.dll"}

ffi: Any = cffi.FFI()
ffi.cdef(DECLARATIONS)
lib: Any = ffi.dlopen(
    os.environ.get("ZIPSPLAT_LIBRARY") or str(Path(__file__).with_name(_NAMES.get(sys.platform, "libzipsplat.so")))
)
if lib.zs_abi_version() != lib.ZS_ABI_VERSION:
    raise ImportError(f"zipsplat is for ABI {lib.ZS_ABI_VERSION}, and the library has {lib.zs_abi_version()}")


_log = logging.getLogger("zipsplat")


def text(pointer: Any) -> str:
    """Decodes a C string; NULL is empty."""
    return str(ffi.string(pointer).decode("utf-8", "replace")) if pointer else ""


def warned(lines: list[str]) -> list[str]:
    """Returns warnings, which the logger "zipsplat" gets too."""
    for line in lines:
        _log.warning(line)
    return lines


class Calls:
    """Running calls of all threads. At exit the interpreter waits for them and starts no others."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.running = 0
        self.ending = False
        # Process that uses the library.
        self.process: Optional[int] = None

    def __enter__(self) -> None:
        process = os.getpid()
        with self.changed:
            if self.process not in (None, process):
                raise errors.ForkError(
                    "this process was forked after zipsplat had been used, and devices do not survive a fork: "
                    'use multiprocessing\'s "spawn" or "forkserver", or use zipsplat in the child only'
                )
            if self.ending:
                raise errors.Error("zipsplat cannot be used any more: the interpreter ends")
            self.process = process
            self.running += 1

    def __exit__(self, *_: object) -> None:
        with self.changed:
            self.running -= 1
            self.changed.notify_all()

    def end(self) -> None:
        """Stops interruptible calls and waits for all."""
        with self.changed:
            self.ending = True
            while self.running > 0 and self.process == os.getpid():
                self.changed.wait()


def _after_fork() -> None:
    # The lock may be held by a thread of the parent.
    calls.changed = threading.Condition()


calls = Calls()
# Registers the exit handler after weakref's, so that calls end before finalizers run.
weakref.finalize(calls, int)
atexit.register(calls.end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
_thread = threading.local()
on_device_lost: list[Callable[[], None]] = []
Self = TypeVar("Self", bound="Owner")


def call(function: str, *arguments: Any) -> None:
    """Calls a library function that returns a status. Handles stay alive during the call.

    Raises:
        Error: a subclass by status, or an exception of a progress function.
    """
    with calls:
        pointers = (value.pointer if isinstance(value, Handle) else value for value in arguments)
        status = getattr(lib, function)(*pointers)
        message = text(lib.zs_last_error()) if status else ""
    raised = getattr(_thread, "raised", None)
    if raised is not None:
        _thread.raised = None
        raise raised
    if status:
        kind = errors.BY_STATUS[status] if status < len(errors.BY_STATUS) else errors.Error
        if kind is errors.DeviceLostError:
            for forget in on_device_lost:
                forget()
        error = kind(message)
        error.status, error.name = status, text(lib.zs_status_name(status))
        raise error


class Handle:
    """An object of the library, destroyed with its last reference."""

    def __init__(self, kind: str, make: str, *arguments: Any) -> None:
        out = ffi.new(f"zs_{kind} **")
        call(make, *arguments, out)
        self.pointer = out[0]
        weakref.finalize(self, _destroy, getattr(lib, f"zs_{kind}_destroy"), self.pointer, os.getpid())


class Owner:
    """An object with a handle that can be closed before its last reference goes."""

    def __init__(self, handle: Handle) -> None:
        self._open: Optional[Handle] = handle

    @property
    def _handle(self) -> Handle:
        if self._open is None:
            raise errors.ArgumentError(f"{type(self).__name__}: found a closed one, expected an open one")
        return self._open

    def close(self) -> None:
        """Frees the memory once running calls end. Later calls raise ArgumentError."""
        self._open = None

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _destroy(function: Callable[[Any], None], pointer: Any, process: int) -> None:
    # A forked child cannot use the device.
    if process == os.getpid():
        function(pointer)


def choose(name: str, found: str, names: Mapping[Any, int]) -> int:
    """Returns the library's number of a name."""
    if found not in names:
        raise errors.ArgumentError(f"{name}: found {found!r}, expected one of {', '.join(map(repr, names))}")
    return names[found]


def structure(kind: str, **values: Any) -> Any:
    """Creates a structure with its size set."""
    made = ffi.new(f"zs_{kind} *")
    made.struct_size = ffi.sizeof(f"zs_{kind}")
    fields = dict(ffi.typeof(f"zs_{kind}").fields)
    for name, value in values.items():
        length = getattr(fields[name].type, "length", None)
        try:
            if length is not None and len(value) != length:
                raise errors.ArgumentError(f"{name}: found {len(value)} values, expected {length}")
            setattr(made, name, value)
        except OverflowError as error:
            raise errors.ArgumentError(f"{name}: found {value!r}, expected a number in range ({error})") from error
        except TypeError as error:
            raise errors.ArgumentTypeError(f"{name}: found {value!r} ({error})") from error
    return made


def positive(name: str, value: int) -> int:
    """Returns a number above 0. In the library's options 0 is a default."""
    if value < 1:
        raise errors.ArgumentError(f"{name}: found {value}, expected a number above 0")
    return value


def structures(kind: str, **arrays: Optional[npt.NDArray[Any]]) -> Any:
    """Creates an array of structures, one per row of the arrays, with pointers to the rows."""
    given = {name: array for name, array in arrays.items() if array is not None}
    made = ffi.new(f"zs_{kind}[]", max(map(len, given.values()), default=0))
    for row, structure in enumerate(made):
        structure.struct_size = ffi.sizeof(f"zs_{kind}")
        for name, array in given.items():
            setattr(structure, name, ffi.cast("void *", array[row].ctypes.data))
    return made


class _Memory:
    """Array interface over library memory; the array keeps the owner alive."""

    def __init__(self, owner: object, address: int, shape: tuple[int, ...], kind: str, writable: bool) -> None:
        self.owner = owner
        self.__array_interface__ = {"data": (address, not writable), "shape": shape, "typestr": kind, "version": 3}


def array_at(
    owner: object, pointer: Any, shape: tuple[int, ...], kind: str = "<f4", *, writable: bool = False
) -> npt.NDArray[Any]:
    """Returns an array over library memory that keeps its owner alive."""
    if 0 in shape:
        return np.zeros(shape, kind)
    return np.asarray(_Memory(owner, int(ffi.cast("uintptr_t", pointer)), shape, kind, writable))


def patch_tokens(kind: str, handle: Handle, views: int, channels: int) -> npt.NDArray[np.float32]:
    """Returns [views, rows, columns, channels] patch tokens of a reconstruction or depth result."""
    tokens = []
    for index in range(views):
        found = structure("pixel_values")
        call(f"zs_{kind}_get_patch_tokens", handle, index, found)
        tokens.append(array_at(handle, found.values, (found.height, found.width, channels)))
    return np.stack(tokens)


def raise_later(_kind: object, value: BaseException, _trace: object) -> None:
    """Makes the running call raise an exception of its callback, Ctrl-C included."""
    _thread.raised = value
