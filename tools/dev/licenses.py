"""Collects the licenses of every crate in a release, and writes a CycloneDX SBOM.

usage: python3 tools/dev/licenses.py PACKAGE TARGET LICENSES.txt SBOM.json      PACKAGE such as zipsplat-cli

Covers normal dependencies from `cargo metadata`. A crate without a license text, or with a
disallowed license, is an error.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Licenses that allow distribution with their text.
ALLOWED = {
    "0BSD",
    "Apache-2.0",
    "Apache-2.0 WITH LLVM-exception",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "BSL-1.0",
    "CC0-1.0",
    "CDLA-Permissive-2.0",
    "ISC",
    "MIT",
    "MIT-0",
    "MPL-2.0",
    "Unicode-3.0",
    "Unlicense",
    "Zlib",
}
TEXTS = re.compile(r"(LICEN[CS]E|COPYING|NOTICE|COPYRIGHT)", re.IGNORECASE)


def packages(package: str, target: str) -> list[dict]:
    """Returns the external packages in a package's build, by name and version."""
    command = ["cargo", "metadata", "--locked", "--format-version", "1", "--filter-platform", target]
    found = json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout)
    nodes = {node["id"]: node for node in found["resolve"]["nodes"]}
    by_id = {entry["id"]: entry for entry in found["packages"]}
    own = set(found["workspace_members"])
    todo = [name for name in own if by_id[name]["name"] == package]
    if not todo:
        sys.exit(f"licenses.py: {package}: found no such package in the workspace")
    reached = set(todo)
    while todo:
        for dependency in nodes[todo.pop()]["deps"]:
            normal = any(kind["kind"] is None for kind in dependency["dep_kinds"])
            if normal and dependency["pkg"] not in reached:
                reached.add(dependency["pkg"])
                todo.append(dependency["pkg"])
    return sorted((by_id[name] for name in reached - own), key=lambda entry: (entry["name"], entry["version"]))


def is_allowed(expression: str) -> bool:
    """Whether allowed licenses satisfy an SPDX expression: all of an AND, one of an OR."""
    operators = {"AND": "and", "OR": "or"}
    term = r"[^\s()]+(?: WITH [^\s()]+)?"
    met = re.sub(term, lambda name: operators.get(name[0], str(name[0] in ALLOWED)), expression.replace("/", " OR "))
    # Only True, False, and, or, parentheses, which bind as in SPDX.
    return bool(eval(met))


def checksums() -> dict[tuple[str, str], str]:
    """Returns the SHA-256 of each crate's archive from Cargo.lock."""
    text = (ROOT / "Cargo.lock").read_text()
    entries = re.findall(r'name = "([^"]+)"\nversion = "([^"]+)"\nsource = [^\n]+\nchecksum = "([0-9a-f]+)"', text)
    return {(name, version): checksum for name, version, checksum in entries}


def texts(entry: dict) -> dict[str, str]:
    """Returns a crate's license texts. A crate without texts gets Apache-2.0 if it offers that."""
    folder = Path(entry["manifest_path"]).parent
    files = sorted(path for path in folder.iterdir() if path.is_file() and TEXTS.match(path.name))
    if not files and "Apache-2.0" in (entry["license"] or ""):
        files = [ROOT / "LICENSE"]
    return {path.name: path.read_text(encoding="utf-8", errors="replace") for path in files}


def main(package: str, target: str, licenses: str, sbom: str) -> None:
    found, sums = packages(package, target), checksums()
    refused = [
        f"{e['name']} {e['version']}: {e['license']}, {len(texts(e))} texts"
        for e in found
        if not is_allowed(e["license"] or "none") or not texts(e)
    ]
    if refused:
        sys.exit("licenses.py: found " + ", ".join(refused) + "; expected texts, and one of " + ", ".join(sorted(ALLOWED)))
    version = re.search(r'(?m)^version = "([^"]+)"', (ROOT / "Cargo.toml").read_text())[1]
    parts = [f"Software of others in zipsplat {version} for {target}: {len(found)} crates.\n"]
    components = []
    for entry in found:
        title = f"{entry['name']} {entry['version']} ({entry['license']})"
        parts.append(f"{'=' * 100}\n{title}\n{entry['repository'] or ''}\n")
        parts += [f"{'-' * 100}\n{name}\n\n{text.strip()}\n" for name, text in texts(entry).items()]
        component = {
            "type": "library",
            "name": entry["name"],
            "version": entry["version"],
            "purl": f"pkg:cargo/{entry['name']}@{entry['version']}",
            "licenses": [{"expression": entry["license"].replace("/", " OR ")}],
        }
        checksum = sums.get((entry["name"], entry["version"]))
        if checksum:
            component["hashes"] = [{"alg": "SHA-256", "content": checksum}]
        components.append(component)
    Path(licenses).write_text("\n".join(parts), encoding="utf-8")
    main_component = {
        "type": "application",
        "name": package,
        "version": version,
        "licenses": [{"expression": "Apache-2.0"}],
    }
    document = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": main_component, "properties": [{"name": "target", "value": target}]},
        "components": components,
    }
    Path(sbom).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    print(f"{len(found)} crates", file=sys.stderr)


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit(__doc__)
    main(*sys.argv[1:])
