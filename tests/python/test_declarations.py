"""The cffi declarations match the header."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from zipsplat._header import DECLARATIONS, NUMBERS
from zipsplat._native import ffi, lib

HEADER = Path(os.environ["ZIPSPLAT_HEADER"])


def test_is_generated_from_the_header() -> None:
    script = Path(os.environ["ZIPSPLAT_CHECKOUT"]) / "engine/bindings/python/declarations.py"
    made = subprocess.run([sys.executable, script, HEADER], capture_output=True, text=True, check=True).stdout
    found: dict[str, object] = {}
    exec(made, found)
    assert (found["DECLARATIONS"], found["NUMBERS"]) == (DECLARATIONS, NUMBERS)


def test_every_function_is_declared_and_exported() -> None:
    code = re.sub(r"//[^\n]*|/\*.*?\*/", "", HEADER.read_text(), flags=re.DOTALL)
    functions = set(re.findall(r"^(?:zs_status|void|const char \*|uint32_t) ?(zs_\w+)\(", code, flags=re.MULTILINE))
    assert len(functions) > 50
    assert [name for name in functions if not callable(getattr(lib, name, None))] == []


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_c_compiler_has_the_same_structures_and_numbers(tmp_path: Path) -> None:
    structures = [name for name in ffi.list_types()[0] if name.startswith("zs_") and _is_structure(name)]
    assert len(structures) > 15
    expected, lines = [], []
    for name in structures:
        expected.append(ffi.sizeof(name))
        lines.append(f"sizeof({name})")
        for field, _ in ffi.typeof(name).fields:
            expected.append(ffi.offsetof(name, field))
            lines.append(f"offsetof({name}, {field})")
    for name in dir(lib):
        if name.startswith("ZS_"):
            expected.append(getattr(lib, name))
            lines.append(name)
    prints = "\n".join(f'    printf("%lld\\n", (long long)({line}));' for line in lines)
    source = tmp_path / "layout.c"
    source.write_text(f"#include <stdio.h>\n#include <zipsplat.h>\nint main(void) {{\n{prints}\n    return 0;\n}}\n")
    subprocess.run(["cc", "-I", HEADER.parent, source, "-o", tmp_path / "layout"], check=True)
    found = subprocess.run([tmp_path / "layout"], capture_output=True, text=True, check=True).stdout
    assert [int(number) for number in found.split()] == expected


def _is_structure(name: str) -> bool:
    kind = ffi.typeof(name)
    return bool(kind.kind == "struct" and kind.fields)
