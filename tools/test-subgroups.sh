#!/usr/bin/env bash
# Kernels and pictures at every subgroup size that lavapipe has, 4, 8 and 16 of the 4 to 128 that devices have; on a lavapipe
# that was widened also at 32, that of most GPUs, and there whole stages, too.
set -euo pipefail
test=$(dirname "${BASH_SOURCE[0]}")/test.sh
for width in 128 256 512; do
  LP_NATIVE_VECTOR_WIDTH=$width "$test" -p zipsplat-tests --test kernels --test images
done
# Left out is what needs roundEven, which Mesa gets wrong in vectors that wide.
ZIPSPLAT_DRIVER=wide-lavapipe "$test" -p zipsplat-tests --test kernels --test images --test stages -- --skip render::pack
