#!/usr/bin/env bash
# Runs kernels and pictures at lavapipe's subgroup sizes 4, 8 and 16, and with stages on a widened
# lavapipe at 32, the size on most GPUs.
set -euo pipefail
test=$(dirname "${BASH_SOURCE[0]}")/../test.sh
for width in 128 256 512; do
  LP_NATIVE_VECTOR_WIDTH=$width "$test" -p zipsplat-tests --test kernels --test images
done
# Skips render::pack: Mesa miscompiles roundEven in such wide vectors.
ZIPSPLAT_DRIVER=wide-lavapipe "$test" -p zipsplat-tests --test kernels --test images --test stages -- --skip render::pack
