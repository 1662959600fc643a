#!/usr/bin/env bash
# Kernels and pictures at every subgroup size that lavapipe has: 4, 8 and 16 of the 4 to 128 that devices have.
set -euo pipefail
for width in 128 256 512; do
  LP_NATIVE_VECTOR_WIDTH=$width "$(dirname "${BASH_SOURCE[0]}")/test.sh" -p zipsplat-tests --test kernels --test images
done
