#!/usr/bin/env bash
# Tests tools/train: training, growing, captures, settings, steps, memory and renderers. Installs
# PyTorch into the cache the first time. Tests nothing if pip cannot reach it.
# usage: tests/train/run.sh
#   PYTHON            interpreter with PyTorch, safetensors and numba; default the cache's
#   ZIPSPLAT_COMMAND  the command zipsplat; default the checkout's, which is built
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
[[ -e /etc/debian_version ]] && driver=lavapipe || driver=system
export ZIPSPLAT_DRIVER=${ZIPSPLAT_DRIVER:-$driver}
# shellcheck source-path=SCRIPTDIR
source "$here/../../tools/setup.sh"

if [[ -z ${PYTHON:-} ]]; then
  python3 -c 'import ensurepip' 2> /dev/null || apt_install python3 python3-venv
  environment=$cache/python/train
  PYTHON=$environment/bin/python
  if [[ ! -x $PYTHON ]]; then
    python3 -m venv "$environment"
    # The default registry's PyTorch includes CUDA, 5.7 GB.
    { { "$PYTHON" -m pip install -q --retries 1 torch --index-url https://download.pytorch.org/whl/cpu ||
      "$PYTHON" -m pip install -q torch; } &&
      "$PYTHON" -m pip install -q safetensors matplotlib pillow numba 'numpy<2.4'; } || {
      rm -r "$environment"
      echo "skipped: the tests of training need PyTorch, which pip does not reach" >&2
      exit 0
    }
  fi
fi
export PYTHON
goldens=${ZIPSPLAT_GOLDENS:-$root/../shared/golden/data}
[[ -d $goldens ]] || goldens=$root/tests/data
if [[ -e $goldens/da3_tiny.v2.safetensors ]]; then
  "$PYTHON" "$root/tools/train/check.py" goldens "$goldens"
  "$PYTHON" "$here/settings.py" "$goldens"
fi
"$PYTHON" "$here/rasterize.py" "$goldens"
"$PYTHON" "$here/steps.py"
"$PYTHON" "$here/memory.py"
"$here/smoke.sh" "${ZIPSPLAT_COMMAND:-$root/tools/zipsplat}"
