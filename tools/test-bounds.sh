#!/usr/bin/env bash
# Kernels and stages with every access of every invocation held to the tensor that is bound there: the validation layer
# instruments the shaders (GPU-AV). A GPU would read on into the next tensor. The largest networks take too long for it.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
export VK_LAYER_SETTINGS_PATH=$here/../tests/vk_layer_settings_bounds.txt
"$here/test.sh" -p zipsplat-tests --test kernels -- --ignored reading_beyond_what_is_bound
"$here/test.sh" -p zipsplat-tests --test kernels --test stages -- --skip tuning --skip small_is_vits --skip slice_of_the_giant
