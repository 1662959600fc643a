"""Adds the shared library, its generated declarations and the command to the wheel."""

from __future__ import annotations

import os
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
sys.path.insert(0, str(HERE))
from declarations import module  # noqa: E402

# Library file by platform.
LIBRARIES = {"linux": "libzipsplat.so", "darwin": "libzipsplat.dylib", "win32": "zipsplat.dll"}


class Build(BuildHookInterface):  # type: ignore[type-arg]
    @property
    def generated(self) -> Path:
        """Generated declarations, which exist during the build."""
        return Path(self.directory) / "_header.py"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes the generated file."""
        self.generated.unlink(missing_ok=True)

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Adds the files. The tag covers every Python: the library does not use CPython's ABI."""
        name = LIBRARIES[sys.platform]
        library = Path(
            os.environ.get("ZIPSPLAT_LIBRARY", ROOT / "target" / "release" / name.replace("zipsplat", "zipsplat_c"))
        )
        if not library.is_file():
            raise FileNotFoundError(
                f"{library}: expected the shared library; build.sh makes it, or set ZIPSPLAT_LIBRARY"
            )
        generated = self.generated
        generated.parent.mkdir(parents=True, exist_ok=True)
        generated.write_text(
            module((ROOT / "engine/bindings/c/include/zipsplat.h").read_text(encoding="utf-8")), encoding="utf-8"
        )
        platform = os.environ.get("ZIPSPLAT_PLATFORM") or sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"
        build_data["pure_python"] = False
        build_data["force_include"].update(
            {
                str(library): f"zipsplat/{name}",
                str(generated): "zipsplat/_header.py",
                str(ROOT / "LICENSE"): "zipsplat/LICENSE",
            }
        )
        # Installed in the interpreter's folder.
        command = os.environ.get("ZIPSPLAT_COMMAND")
        if command:
            build_data["shared_scripts"][command] = "zipsplat.exe" if sys.platform == "win32" else "zipsplat"
        # Licenses of the library's crates, from tools/release.sh.
        licenses = os.environ.get("ZIPSPLAT_LICENSES")
        if licenses:
            build_data["force_include"][licenses] = "zipsplat/THIRD-PARTY-LICENSES.txt"
